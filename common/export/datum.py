"""The datum of a flight as a file: `datum.json`."""

from __future__ import annotations

import json
from pathlib import Path

from common.errors import EvaluationError
from common.geo import utm_epsg
from common.messages import Datum

_FIELDS = ("flight", "latitude_deg", "longitude_deg", "height")


def datum_as_json(datum: Datum) -> dict[str, str | float | int]:
    """The fields of the datum, with the EPSG code of the UTM zone of the georeferenced products."""
    fields: dict[str, str | float | int] = {name: getattr(datum, name) for name in _FIELDS}
    return fields | {"epsg": utm_epsg(datum.latitude_deg, datum.longitude_deg)}


def write_datum(path: Path, datum: Datum) -> None:
    """Write the datum as JSON: flight, latitude_deg, longitude_deg, height (m above the ellipsoid), epsg (UTM)."""
    path.write_text(json.dumps(datum_as_json(datum), indent=2) + "\n", encoding="utf-8")


def read_datum(path: Path) -> Datum:
    """The datum that `write_datum` wrote. Raises EvaluationError when the file is not such a datum."""
    try:
        fields = json.loads(path.read_text(encoding="utf-8"))
        return Datum(str(fields["flight"]), *(float(fields[name]) for name in _FIELDS[1:]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise EvaluationError(f"{path}: not a datum ({error!r}): needs JSON with {', '.join(_FIELDS)}") from error
