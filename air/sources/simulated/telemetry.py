"""DJI's telemetry as MAVLink: what the drone's own autopilot knows, as the bridge RosettaDrone sends it.

The bridge's habits are kept: its ATTITUDE has no time, its heights are all relative to home, its currents are in mA
where the protocol wants 10 mA, its home has the height to return at, in m, and much is left at zero.

Source: RosettaDrone, DroneModel.java (rates and fields); the MAVLink message set common.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from air.sources.simulated.clocks import DeviceClock
from air.sources.simulated.motion.gauss_markov import GaussMarkov
from air.sources.simulated.motion.mission import Mission, Phase
from air.sources.simulated.motion.rotations import exponential
from air.sources.simulated.motion.trajectory import Trajectory
from common.arrays import F64
from common.config import Range
from common.geo import enu_to_geodetic
from common.mavlink import PacketWriter
from common.messages import Datum

TICK_S = 0.1
_GAP_S = 0.5e-3
"""Between the messages of one tick."""
_ERRORS, _LOST = 90, 91
_POSITION_TIME_S, _HEIGHT_TIME_S, _ATTITUDE_TIME_S = 60.0, 120.0, 20.0
_QUADROTOR, _ARDUPILOT, _ACTIVE, _VERSION = 2, 3, 4, 3
_CUSTOM_MODE, _GUIDED, _ARMED = 1, 8, 128
_AUTO_MODE, _GUIDED_MODE, _LOITER_MODE, _RTL_MODE, _LAND_MODE = 3, 4, 5, 6, 9
_MODES = {
    Phase.STAND: _LOITER_MODE,
    Phase.TAKE_OFF: _GUIDED_MODE,
    Phase.SURVEY: _AUTO_MODE,
    Phase.HOVER: _LOITER_MODE,
    Phase.RETURN: _RTL_MODE,
    Phase.LAND: _LAND_MODE,
}
_FIX_3D, _SATELLITES = 3, 17
_ARMED_THRUST = 0.1
_CELLS, _CAPACITY_MAH, _HOVER_MA, _IDLE_MA = 12, 11_870, 19_000, 1_500
_FULL_MV, _FLAT_MV, _UNKNOWN_MV = 4_350, 3_500, 0xFFFF
_RETURN_HEIGHT_M = 50


@dataclass(frozen=True)
class MavlinkOptions:
    """One sigma of the errors of the drone's own navigation, which wander; 0 turns one off. `lost` is the share of
    messages that never leave."""

    position_m: Annotated[float, Range(0, 100)] = 1.0
    height_m: Annotated[float, Range(0, 100)] = 0.4
    velocity: Annotated[float, Range(0, 10)] = 0.05
    attitude_deg: Annotated[float, Range(0, 45)] = 0.4
    heading_deg: Annotated[float, Range(0, 180)] = 2.0
    lost: Annotated[float, Range(0, 1)] = 0.005

    @classmethod
    def perfect(cls) -> MavlinkOptions:
        """A drone that knows all, and a link that loses nothing."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class _Claim:
    """What the autopilot believes at one instant: degrees, m above home, m/s north, east, down, and battery."""

    t_s: float
    phase: Phase
    armed: bool
    latitude_deg: float
    longitude_deg: float
    height: float
    v_ned: tuple[float, float, float]
    attitude: tuple[float, float, float]
    used_mah: float
    current_ma: float


class SimulatedTelemetry:
    """The telemetry of a flight, on the clock of the bridge."""

    def __init__(
        self,
        trajectory: Trajectory,
        mission: Mission,
        datum: Datum,
        options: MavlinkOptions,
        seed: int,
        clock: DeviceClock,
    ):
        self._trajectory, self._mission, self._datum = trajectory, mission, datum
        self._options, self._seed, self._clock = options, seed, clock
        rng, seconds = np.random.default_rng([seed, _ERRORS]), trajectory.duration_s
        self._place = GaussMarkov(rng, 1.0, _POSITION_TIME_S, seconds, 2)
        self._height = GaussMarkov(rng, 1.0, _HEIGHT_TIME_S, seconds)
        self._velocity = GaussMarkov(rng, 1.0, _ATTITUDE_TIME_S, seconds, 3)
        self._attitude = GaussMarkov(rng, 1.0, _ATTITUDE_TIME_S, seconds, 3)
        # Home is where it took off, also for a flight that is joined in the air.
        self._home = trajectory.at(np.zeros(1)).p_world[0] - mission.reference(0.0, 0.01, 1).p[0]
        self._writer = PacketWriter()

    def packets(self) -> Iterator[tuple[float, bytes]]:
        """True time s at which a message leaves, and its bytes."""
        lost = np.random.default_rng([self._seed, _LOST])
        for tick, claim in enumerate(self._claims(), 1):
            for k, data in enumerate(self._tick(tick, claim)):
                if lost.random() >= self._options.lost:
                    yield claim.t_s + k * _GAP_S, data

    def _claims(self) -> Iterator[_Claim]:
        """What the autopilot believes, at each tick of the bridge."""
        ends_s = self._clock.device_s(np.array([0.0, self._trajectory.duration_s]))
        first, last = np.ceil(ends_s / TICK_S).astype(int).tolist()
        used_mah, chunk = 0.0, round(1 / TICK_S)
        for begin in range(first, last, chunk):
            t_s = self._clock.true_s(TICK_S * np.arange(float(begin), min(begin + chunk, last)))
            motion, thrust = self._trajectory.at(t_s), self._trajectory.thrust(t_s)
            place, height = self._believed_place(t_s, motion.p_world)
            v_world = motion.v_world + self._options.velocity * self._velocity.at(t_s)
            angles = self._believed_attitude(t_s, motion.R_world_body)
            for i, t in enumerate(t_s.tolist()):
                current_ma = _IDLE_MA + _HOVER_MA * (thrust[i] / 9.8) ** 1.5  # momentum theory
                used_mah += current_ma * TICK_S / 3600
                armed, (latitude, longitude, _) = bool(thrust[i] > _ARMED_THRUST), place[i].tolist()
                v_ned = (float(v_world[i, 1]), float(v_world[i, 0]), -float(v_world[i, 2]))
                battery = used_mah, float(current_ma)
                phase = self._mission.phase(t)
                yield _Claim(t, phase, armed, latitude, longitude, float(height[i]), v_ned, angles[i], *battery)

    def _believed_place(self, t_s: F64, p_world: F64) -> tuple[F64, F64]:
        """Latitude ° and longitude ° (N, 3; the height there is true), and the barometer's height (N,) m above home."""
        error = np.pad(self._options.position_m * self._place.at(t_s), ((0, 0), (0, 1)))
        height = p_world[:, 2] - self._home[2] + self._options.height_m * self._height.at(t_s)[:, 0]
        return enu_to_geodetic(self._datum, p_world + error), height

    def _believed_attitude(self, t_s: F64, R_world_body: F64) -> list[tuple[float, float, float]]:
        """Roll, pitch, yaw rad of forward-right-down in NED."""
        sigma = np.radians([self._options.attitude_deg, self._options.attitude_deg, self._options.heading_deg])
        R = exponential(sigma * self._attitude.at(t_s)) @ R_world_body
        ahead, left, up = R[:, :, 0], R[:, 2, 1], R[:, 2, 2]
        roll, pitch, yaw = np.arctan2(left, up), np.arcsin(np.clip(ahead[:, 2], -1, 1)), np.arctan2(*ahead[:, :2].T)
        return list(zip(roll.tolist(), pitch.tolist(), yaw.tolist(), strict=True))

    def _tick(self, tick: int, claim: _Claim) -> Iterator[bytes]:
        """The messages of one tick of the bridge."""
        pack, (roll, pitch, yaw) = self._writer.pack, claim.attitude
        yield pack("ATTITUDE", roll=roll, pitch=pitch, yaw=yaw)
        yield pack("ALTITUDE", altitude_relative=claim.height)
        yield pack("VIBRATION")
        yield self._hud(claim)
        if tick % 2 == 0:
            yield self._position(claim)
        if tick % 3 == 0:
            yield self._gps(claim)
            yield pack("RADIO_STATUS")
            yield pack("RC_CHANNELS", chancount=8, rssi=98)
        if tick % 10 == 0:
            yield self._heartbeat(claim)
            yield from self._battery(claim)
        if tick % 50 == 0:
            latitude_deg, longitude_deg, _ = enu_to_geodetic(self._datum, self._home).tolist()
            latitude, longitude = int(latitude_deg * 1e7), int(longitude_deg * 1e7)
            yield pack("HOME_POSITION", latitude=latitude, longitude=longitude, altitude=_RETURN_HEIGHT_M)

    def _heartbeat(self, claim: _Claim) -> bytes:
        guided = _GUIDED if claim.phase not in (Phase.STAND, Phase.HOVER) else 0
        return self._writer.pack(
            "HEARTBEAT",
            type=_QUADROTOR,
            autopilot=_ARDUPILOT,
            base_mode=_CUSTOM_MODE | guided | (_ARMED if claim.armed else 0),
            custom_mode=_MODES[claim.phase],
            system_status=_ACTIVE,
            mavlink_version=_VERSION,
        )

    def _hud(self, claim: _Claim) -> bytes:
        speed, heading_deg = float(np.hypot(*claim.v_ned[:2])), int(np.degrees(claim.attitude[2]) % 360)
        climb = -int(claim.v_ned[2])
        return self._writer.pack(
            "VFR_HUD", airspeed=speed, groundspeed=speed, heading=heading_deg, alt=int(claim.height), climb=climb
        )

    def _position(self, claim: _Claim) -> bytes:
        vx, vy, vz = (int(v * 100) for v in claim.v_ned)
        return self._writer.pack(
            "GLOBAL_POSITION_INT",
            lat=int(claim.latitude_deg * 1e7),
            lon=int(claim.longitude_deg * 1e7),
            alt=int(claim.height * 1000),
            relative_alt=int(claim.height * 1000),
            vx=vx,
            vy=vy,
            vz=vz,
            hdg=int(np.degrees(claim.attitude[2]) % 360 * 100),
        )

    def _gps(self, claim: _Claim) -> bytes:
        return self._writer.pack(
            "GPS_RAW_INT",
            time_usec=int(self._clock.device_s(np.array([claim.t_s]))[0] * 1e6),
            lat=int(claim.latitude_deg * 1e7),
            lon=int(claim.longitude_deg * 1e7),
            fix_type=_FIX_3D,
            satellites_visible=_SATELLITES,
        )

    def _battery(self, claim: _Claim) -> Iterator[bytes]:
        left = max(0.0, 1 - claim.used_mah / _CAPACITY_MAH)
        pack_mv, percent = int(_CELLS * (_FLAT_MV + (_FULL_MV - _FLAT_MV) * left)), int(100 * left)
        yield self._writer.pack(
            "SYS_STATUS",
            voltage_battery=pack_mv,
            current_battery=_int16(claim.current_ma),
            battery_remaining=percent,
        )
        yield self._writer.pack("POWER_STATUS")
        yield self._writer.pack(
            "BATTERY_STATUS",
            current_consumed=int(claim.used_mah),
            temperature=3100,
            voltages=[_UNKNOWN_MV] * 10,
            current_battery=_int16(10 * claim.current_ma),
            battery_remaining=percent,
        )


def _int16(value: float) -> int:
    """A number as Java casts it to 16 bits."""
    return (int(value) + 0x8000) % 0x10000 - 0x8000
