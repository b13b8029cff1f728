"""What the drone's own telemetry says, as lines of the panel."""

from __future__ import annotations

from common.measurements import FixKind, Severity, VehicleState
from common.streams import VEHICLE
from ground.viewer.scene import VehicleRow

GOOD, FAIR, BAD, PLAIN = "#2f9e44", "#f08c00", "#e03131", "#868e96"
LOW_BATTERY, EMPTY_BATTERY = 0.3, 0.15

_LOST = (FixKind.NONE, FixKind.DEAD_RECKONING, FixKind.TIME_ONLY)
_GRAVE = (Severity.EMERGENCY, Severity.ALERT, Severity.CRITICAL, Severity.ERROR)


def drone_lines(row: VehicleRow) -> list[tuple[str, str]]:
    """Colour of the dot and text of each line: the state, and the autopilot's latest text if there is one."""
    state = row.state
    stale = row.age_s > VEHICLE.stale_after_s
    parts = [*_state(state), *([f"silent for {row.age_s:.0f} s"] if stale else [])]
    lines = [(BAD if stale else _colour(state), f"{row.vehicle} drone: {' · '.join(parts)}")]
    if state.text:
        grave = BAD if state.severity in _GRAVE else FAIR if state.severity is Severity.WARNING else PLAIN
        lines.append((grave, f"{row.vehicle} drone: {state.text}"))
    return lines


def _state(state: VehicleState) -> list[str]:
    """What is known, most urgent first."""
    parts = [] if state.armed is None else ["armed" if state.armed else "disarmed"]
    if state.mode:
        parts.append(state.mode)
    if state.height_home is not None:
        parts.append(f"{state.height_home:.0f} m above home")
    if state.battery is not None:
        voltage = "" if state.voltage_v is None else f" ({state.voltage_v:.1f} V)"
        parts.append(f"battery {100 * state.battery:.0f} %{voltage}")
    if state.fix is not None:
        satellites = "" if state.satellites is None else f" ({state.satellites} satellites)"
        parts.append(f"GPS {state.fix}{satellites}")
    if state.radio_rssi is not None:
        parts.append(f"radio {100 * state.radio_rssi:.0f} %")
    return parts or ["nothing known"]


def _colour(state: VehicleState) -> str:
    if state.battery is not None and state.battery < EMPTY_BATTERY:
        return BAD
    if state.fix in _LOST or (state.battery is not None and state.battery < LOW_BATTERY):
        return FAIR
    return GOOD
