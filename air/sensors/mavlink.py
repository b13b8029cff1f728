"""The drone's own telemetry as a driver: MAVLink bytes → `VehicleState`."""

from __future__ import annotations

from air.sensors.driver import Counts, TimeScale
from common.mavlink import Stamps, Telemetry
from common.measurements import Measurement

_SCALES = {
    Stamps.ARRIVAL: TimeScale.ARRIVAL,
    Stamps.TLOG: TimeScale.GNSS,
    Stamps.BOOT: TimeScale.DEVICE,
}


class MavlinkVehicle:
    """Feeds on the bytes of a MAVLink link or log; `system` is the vehicle's id, None the first that is heard."""

    def __init__(self, device: str = "vehicle", system: int | None = None, stamps: Stamps = Stamps.ARRIVAL) -> None:
        self._device = device
        self._scale = _SCALES[stamps]
        self._telemetry = Telemetry(system, stamps)
        self._sent_ns = 0

    @property
    def device(self) -> str:
        """Name of the device."""
        return self._device

    @property
    def scale(self) -> TimeScale:
        """Arrival for a link, the log's own stamps for a log."""
        return self._scale

    @property
    def counts(self) -> Counts:
        """Bytes and messages so far, of all systems."""
        return self._telemetry.counts

    @property
    def faults(self) -> tuple[str, ...]:
        """None: what is wrong with the drone stands in its state."""
        return ()

    @property
    def sent_ns(self) -> int:
        """The arrival of the latest bytes."""
        return self._sent_ns

    def feed(self, data: bytes, t_ns: int) -> list[Measurement]:
        """States of the vehicle that follow from these bytes, ten a second at most."""
        self._sent_ns = t_ns
        return [*self._telemetry.feed(data, t_ns)]

    def start(self) -> bytes:
        """Nothing: the bridge sends without being asked."""
        return b""
