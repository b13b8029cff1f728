"""From the store of a station to the products of one flight."""

from __future__ import annotations

from pathlib import Path

from common.errors import ExportError
from common.export.products import write_products
from ground.cloud import Cloud, FlightId
from ground.store import read_store


def export(store: Path, folder: Path, min_views: int, vehicle: str | None, flight: str | None) -> dict[str, Path]:
    """Write the products of a flight that a store holds; path of each by name.

    Without a choice it is the flight that started last. Raises StoreError and ExportError, which name the file or
    what there is to choose from.
    """
    cloud, _ = read_store(store)
    chosen = choose_flight(cloud, vehicle, flight)
    datum = cloud.datum(chosen)
    if datum is None:
        raise ExportError(f"{store}: the datum of flight {chosen.flight!r} of {chosen.vehicle} has not arrived")
    tiles = (held.decoded() for held in cloud.tiles(chosen))
    keyframes = [kept.keyframe for kept in cloud.keyframes(chosen)]
    return write_products(folder, datum.datum, tiles, keyframes, min_views)


def choose_flight(cloud: Cloud, vehicle: str | None, flight: str | None) -> FlightId:
    """The flight that fits, the latest of several. Raises ExportError, which lists what there is, when none does."""
    flights = cloud.flights()
    fitting = [f for f in flights if vehicle in (None, f.vehicle) and flight in (None, f.flight)]
    if not fitting:
        there = ", ".join(f"{f.vehicle} {f.flight}" for f in flights) or "nothing yet"
        wanted = " ".join(part for part in (vehicle, flight) if part) or "a flight"
        raise ExportError(f"the store does not hold {wanted}; it holds: {there}")
    return max(fitting, key=lambda f: f.flight)
