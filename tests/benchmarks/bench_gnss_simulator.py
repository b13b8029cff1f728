"""The simulated GNSS: what RTKLIB finds in it, which error does what, and how long a second takes.

A rover flies circles at 3 m/s, 40 m up, some 190 m from a base station. RTKLIB's rnx2rtkp gets the exported RINEX:
single points with one band, broadcast ionosphere and Saastamoinen, elevation mask 10°, all systems; carrier phase
(GPS, Galileo, GLONASS in two bands, mask 15°) epoch by epoch, without holding ambiguities. Of the wet delay between
rover and base, 40 m apart in height, RTKLIB knows nothing: 6 mm. "Ours" are our own single points of the same epochs.

python tests/benchmarks/bench_gnss_simulator.py
"""

import shutil
import sys
import tempfile
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import rtklib
from gnss_scene import (
    BASE_ECEF,
    DATUM,
    T_ECEF_WORLD,
    circling,
    circling_low,
    correlation_time,
    exported,
    rover,
)

from air.gnss.ephemerides import Ephemerides
from air.gnss.positioning import PointPosition, find_position
from air.gnss.settings import PositioningSettings
from air.sensors.gnss_ublox import UbloxReceiver
from air.sources.rinex import open_rinex
from air.sources.simulated.gnss.gnss_options import GnssOptions
from air.sources.simulated.survey import START_NS
from common.geo import geodetic_to_enu
from common.measurements import ReceiverSolution

SEEDS = (1, 2, 3)
RTK_S = 600.0
MANY_SEEDS, SINGLE_S, SINGLE_STEP_S = range(1, 17), 600.0, 10.0
OWN_SEEDS, OWN_S = range(1, 13), 60.0
PERFECT, DEFAULT = GnssOptions.perfect(), GnssOptions()
ALONE = {
    "none": (),
    "multipath of the code": ("multipath",),
    "ionosphere beyond the model": ("ionosphere_residual", "ionosphere_gradient", "ionosphere_ripples"),
    "troposphere beyond the model": ("troposphere_residual",),
    "orbits and satellite clocks": ("orbit", "satellite_clock"),
    "noise of the code": ("code",),
    "all": tuple(field.name for field in fields(GnssOptions)),
}


def main():
    """Print the tables."""
    speed()
    own_solutions()
    if shutil.which("rnx2rtkp") is None:
        print("\nskipped: RTKLIB's rnx2rtkp is not installed (Debian: apt install rtklib)")
        return
    with tempfile.TemporaryDirectory() as folder:
        single_points(Path(folder))
        carrier_phases(Path(folder))


def speed():
    """The time of this processor for a second of flight."""
    print("| a second of flight | CPU, ms | target |\n|---|---|---|")
    receiver, duration_s = rover(replace(DEFAULT, missing=0.0), 60.0), 60.0
    for name, run in (
        ("raw measurements at 10 Hz", receiver.observations),
        ("all UBX bytes, own solution and navigation messages", receiver.packets),
    ):
        begun = time.process_time()
        count = sum(1 for _ in run())
        spent = (time.process_time() - begun) / duration_s * 1e3
        print(f"| {name} ({count / duration_s:.0f} a second) | {spent:.1f} | < 50 |", flush=True)


def own_solutions():
    """Errors of what the receiver itself says, in its NAV-PVT."""
    print("\n| the receiver's own solution | horizontal, median, m | vertical RMS, m | target |\n|---|---|---|---|")
    first, later = [], []
    for seed in tqdm(OWN_SEEDS, leave=False, disable=None):
        driver, errors = UbloxReceiver(), []
        for _, data in rover(replace(DEFAULT, rate_hz=5.0), OWN_S, seed).packets():
            for told in driver.feed(data, 0):
                if isinstance(told, ReceiverSolution):
                    p_world = geodetic_to_enu(DATUM, told.latitude_deg, told.longitude_deg, told.height)
                    truth, _ = circling(np.array([(told.t_ns - START_NS) / 1e9]))
                    errors.append(p_world - T_ECEF_WORLD.inverse().apply(truth[0]))
        first.append(errors[0])
        later += errors
    for name, found in (("first fix", first), (f"{OWN_S:.0f} s", later)):
        east, north, up = np.array(found).T
        middle, rms = np.median(np.hypot(east, north)), np.sqrt(np.mean(up**2))
        print(
            f"| {name}, seeds {OWN_SEEDS[0]} to {OWN_SEEDS[-1]} | {middle:.2f} | {rms:.2f} | 1.5 m class |", flush=True
        )


def single_points(folder):
    """Errors of RTKLIB's single points and of ours, with one error at a time."""
    print("\n| errors that are on | horizontal RMS, m | vertical RMS, m | correlated over, s | positions | ours, m |")
    print("|---|---|---|---|---|---|")
    for name, on in tqdm(ALONE.items(), leave=False, disable=None):
        options = replace(
            PERFECT, **{key: getattr(DEFAULT, key) for key in on} | {"rate_hz": 1 / SINGLE_STEP_S, "missing": 0.0}
        )
        errors, ours, epochs = [], [], 0
        for seed in MANY_SEEDS:
            flight = exported(folder, options, None, SINGLE_S, seed)
            known = Ephemerides(open_rinex(f"rinex:{flight.nav}", str(flight.nav)))
            fixes = [find_position(o.epoch, known, PositioningSettings()) for o in flight.observed]
            fixes = [fix for fix in fixes if isinstance(fix, PointPosition)]
            true_ns = (fix.t_ns - round(next(iter(fix.clocks.values())) * 1e9) for fix in fixes)
            ours.append(flight.errors(true_ns, (fix.position for fix in fixes)))
            found = rtklib.single_point(folder, flight.rover, flight.nav, "GREC", 10.0)
            errors.append(flight.errors((s.t_ns for s in found), (s.position for s in found)))
            epochs += len(flight.observed)
        rms = np.sqrt(np.mean(np.square(np.concatenate(errors)), axis=0))
        own = np.sqrt(np.mean(np.square(np.concatenate(ours)), axis=0))
        seconds = np.median([correlation_time(e[:, axis], SINGLE_STEP_S) for e in errors for axis in range(3)])
        given = sum(map(len, errors)) / epochs
        cells = f"{np.hypot(*rms[:2]):.2f} | {rms[2]:.2f} | {seconds:.0f} | {given:.1%}"
        print(f"| {name} | {cells} | {np.hypot(*own[:2]):.2f}, {own[2]:.2f} |", flush=True)


def carrier_phases(folder):
    """RTKLIB's carrier-phase solutions against the base."""
    print("\n| carrier phase against the base | fixed | error of fixed, median, m | 95 % | most | target |")
    print("|---|---|---|---|---|---|")
    base = GnssOptions.base()
    quiet = replace(PERFECT, code=base.code, phase=base.phase)
    for name, options, ground, antenna in (
        ("no errors, at the base's height", PERFECT, PERFECT, circling_low),
        ("no errors", PERFECT, PERFECT, circling),
        ("noise alone", quiet, quiet, circling),
        ("all errors", DEFAULT, base, circling),
    ):
        errors, epochs = [], 0
        for seed in SEEDS:
            flying, standing = replace(options, rate_hz=1.0, missing=0.0), replace(ground, rate_hz=1.0)
            flight = exported(folder, flying, standing, RTK_S, seed, antenna)
            found = rtklib.kinematic(folder, flight.rover, flight.base, flight.nav, BASE_ECEF)
            fixed = [s for s in found if s.fixed]
            offset = flight.errors((s.t_ns for s in fixed), (s.position for s in fixed))
            errors.append(np.linalg.norm(offset, axis=1))
            epochs += len(flight.observed)
        apart = np.concatenate(errors)
        median, most95, most = np.percentile(apart, (50, 95, 100))
        print(f"| {name} | {len(apart) / epochs:.0%} | {median:.4f} | {most95:.4f} | {most:.4f} | ≤ 0.03 |", flush=True)


if __name__ == "__main__":
    main()
