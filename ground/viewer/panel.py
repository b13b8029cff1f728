"""The operator's panel in one browser: what can be chosen, and how the service is doing."""

from __future__ import annotations

from collections.abc import Callable
from html import escape

import viser

from common.messages import Level
from ground.viewer.drone import drone_lines
from ground.viewer.points import SIGMA_RANGE, VIEWS_RANGE, Colouring, Style
from ground.viewer.scene import Scene, StreamRow

_DOT = {Level.OK: "#2f9e44", Level.DEGRADED: "#f08c00", Level.FAILED: "#e03131"}
_RAMPS = {
    Colouring.HEIGHT: "#30123b,#4662d7,#36aaf9,#1ae4b6,#72fe5e,#c7ef34,#faba39,#f66b19,#ca2a04,#7a0403",
    Colouring.ACCURACY: "#0d0887,#5c01a6,#9c179e,#cc4778,#ed7953,#fdb42f,#f0f921",
    Colouring.VIEWS: "#440154,#443983,#31688e,#21918c,#35b779,#90d743,#fde725",
}
_TEXT = "font-size:12px;line-height:1.45;padding:0 0.9em 0.4em"
_NUMBER = "text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap;padding:1px 0 1px 8px"


class Panel:
    """The controls of one browser and the texts above and below them."""

    def __init__(self, gui: viser.GuiApi, station: str, min_views: int, go_home: Callable[[], None]) -> None:
        gui.set_panel_label(f"Luojia · {station}")
        self._summary = gui.add_html("")
        home = gui.add_button("Home", icon=viser.Icon.HOME, hint="Look at the whole map from the south")
        home.on_click(lambda _: go_home())
        self._follow = gui.add_checkbox("Follow aircraft", False)
        with gui.add_folder("Map"):
            self._colouring = gui.add_dropdown("Colour", [str(c) for c in Colouring], initial_value=Colouring.PHOTO)
            self._legend = gui.add_html("", visible=False)
            self._point_size = gui.add_slider("Point size", 0.5, 4.0, 0.1, 1.3, hint="In cells of the map")
            self._min_views = gui.add_slider("Min views", 1, 8, 1, min_views, hint="Photos that agree on a cell")
            self._uncertain = gui.add_checkbox("Uncertain cells", False, hint="Show what too few photos agree on")
            self._photos = gui.add_checkbox("Photos", True, hint="Where photos were taken")
        with gui.add_folder("Streams"):
            self._streams = gui.add_html("")

    @property
    def follow(self) -> bool:
        """Whether the camera moves with the aircraft."""
        return bool(self._follow.value)

    @property
    def photos(self) -> bool:
        """Whether the places of the photos are drawn."""
        return bool(self._photos.value)

    @property
    def point_size(self) -> float:
        """Diameter of a point in cells."""
        return float(self._point_size.value)

    def style(self, z_range: tuple[float, float]) -> Style:
        """How the operator wants points chosen and coloured; `z_range` m in the scene spans the colours of heights."""
        colouring = Colouring(self._colouring.value)
        # A range that colours nothing must not make a tile look changed.
        z_range = z_range if colouring is Colouring.HEIGHT else (0.0, 0.0)
        return Style(colouring, int(self._min_views.value), bool(self._uncertain.value), z_range)

    def update(self, scene: Scene, style: Style, drawn_points: int) -> None:
        """Write the state of the service and the legend of the colours."""
        _write(self._summary, _summary(scene, drawn_points))
        _write(self._streams, _streams(scene))
        _write(self._legend, _legend(style))
        if self._legend.visible != (style.colouring in _RAMPS):
            self._legend.visible = style.colouring in _RAMPS


def _write(handle: viser.GuiHtmlHandle, html: str) -> None:
    """Send a text only when it changed."""
    if handle.content != html:
        handle.content = html


def _summary(scene: Scene, drawn_points: int) -> str:
    lines = [_line(*_link(vehicle, alive, scene)) for vehicle, alive in sorted(scene.alive.items())]
    lines += [_line(colour, text) for row in scene.vehicles for colour, text in drone_lines(row)]
    lines += [
        _line(_DOT[row.level], f"{row.vehicle} {row.role}: {row.text or row.level}")
        for row in scene.health
        if row.text or row.level != Level.OK
    ]
    if not scene.alive and not scene.tiles and not scene.vehicles:
        lines = [_line("#868e96", "Waiting for an aircraft: nothing has arrived yet.")]
    elif not scene.tiles:
        lines.append(_line("#868e96", "No map yet: tiles appear as soon as the first photos match."))
    elif scene.origin is None:
        lines.append(_line("#f08c00", "Tiles wait for the datum of their flight."))
    numbers = {
        "Mapped": f"{scene.area / 1e4:.2f} ha",
        "Tiles": f"{len(scene.tiles):,}",
        "Points": f"{_short(scene.points)} · {_short(drawn_points)} drawn",
        "Photos": f"{len(scene.keyframes):,}",
        "Faults": f"{scene.faults:,}",
    }
    rows = "".join(f"<tr><td>{name}</td><td style='{_NUMBER}'>{value}</td></tr>" for name, value in numbers.items())
    return f"<div style='{_TEXT}'>{''.join(lines)}{_table(rows)}</div>"


def _link(vehicle: str, alive: bool, scene: Scene) -> tuple[str, str]:
    state = next((a for a in scene.aircraft if a.flight.vehicle == vehicle), None)
    if not alive:
        return _DOT[Level.FAILED], f"{vehicle}: not connected"
    if state is None:
        return _DOT[Level.OK], f"{vehicle}: connected, no pose yet"
    height = state.pose.T_world_body.t[2]
    return _DOT[Level.OK], f"{vehicle}: {state.pose.mode} · {height:.1f} m · {_age(state.pose_age_s)}"


def _line(colour: str, text: str) -> str:
    dot = f"<span style='display:inline-block;width:9px;height:9px;border-radius:50%;background:{colour}'></span>"
    return f"<div style='margin-bottom:3px'>{dot} {escape(text)}</div>"


def _streams(scene: Scene) -> str:
    if not scene.streams:
        return f"<div style='{_TEXT}'>No stream has arrived yet.</div>"
    head = "".join(f"<th style='{_NUMBER};font-weight:600'>{title}</th>" for title in ("Hz", "kB/s", "Age", "Faults"))
    rows = "".join(_stream(row) for row in scene.streams)
    titles = f"<tr><th style='text-align:left;font-weight:600'>Stream</th>{head}</tr>"
    return f"<div style='{_TEXT}'>{_table(titles + rows)}</div>"


def _stream(row: StreamRow) -> str:
    colour = "color:#e03131" if row.stale else ""
    cells = (f"{row.rate_hz:.1f}", f"{row.bytes_per_s / 1e3:.1f}", _age(row.age_s), f"{row.faults}")
    numbers = "".join(f"<td style='{_NUMBER}'>{cell}</td>" for cell in cells)
    name = f"{row.vehicle} · {row.stream}"
    return f"<tr style='{colour}' title='{escape(row.fault, quote=True)}'><td>{escape(name)}</td>{numbers}</tr>"


def _legend(style: Style) -> str:
    if style.colouring not in _RAMPS:
        return ""
    low, high = {
        Colouring.HEIGHT: (f"{style.z_range[0]:.1f} m", f"{style.z_range[1]:.1f} m"),
        Colouring.ACCURACY: (f"σ {SIGMA_RANGE[0] * 100:.0f} cm", f"{SIGMA_RANGE[1] * 100:.0f} cm"),
        Colouring.VIEWS: (f"{VIEWS_RANGE[0]} photos", f"{VIEWS_RANGE[1]}"),
    }[style.colouring]
    ramp = f"height:10px;border-radius:3px;background:linear-gradient(to right,{_RAMPS[style.colouring]})"
    ends = "display:flex;justify-content:space-between"
    texts = f"<div style='{ends}'><span>{low}</span><span>{high}</span></div>"
    return f"<div style='{_TEXT}'><div style='{ramp}'></div>{texts}</div>"


def _table(rows: str) -> str:
    return f"<table style='width:100%;border-collapse:collapse'>{rows}</table>"


def _age(age_s: float | None) -> str:
    if age_s is None:
        return "–"
    if age_s < 10:
        return f"{age_s:.1f} s"
    return f"{age_s:.0f} s" if age_s < 120 else f"{age_s / 60:.0f} min"


def _short(number: int) -> str:
    for limit, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if number >= limit:
            return f"{number / limit:.2f} {unit}" if number < 10 * limit else f"{number / limit:.0f} {unit}"
    return str(number)
