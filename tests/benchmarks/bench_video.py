"""The simulated video camera: CPU time a frame of 1280×720 with all effects, by its parts, and what a site takes.

python tests/benchmarks/bench_video.py [--frames 20] [--sheet docs/simulator.jpg]
"""

import argparse
import resource
import statistics
import time
from pathlib import Path

import cv2
import numpy as np
from figures import Figure, print_table
from tqdm import tqdm

from air.sources.simulated.camera import film
from air.sources.simulated.camera.video import CameraOptions, Exposure, SimulatedCamera, draw_lens
from air.sources.simulated.clocks import ClockOptions, Device, DeviceClock
from air.sources.simulated.extrinsics import ExtrinsicsOptions, draw_extrinsics
from air.sources.simulated.motion.mission import FlightOptions
from air.sources.simulated.motion.multirotor import fly
from air.sources.simulated.sites.layout import Bounds
from air.sources.simulated.sites.sites import SITES, WorldOptions, generate_site

SEED, FLIGHT_S, HALF = 1, 120.0, 100.0
SURVEY = FlightOptions(start="air")
VIEWS = (
    ("playground", -25.0, 0.0, 40.0), ("playground", 40.0, 0.0, 40.0), ("playground", -30.0, 45.0, 40.0),
    ("playground", -48.0, 5.0, 15.0), ("playground", 62.0, 20.0, 10.0), ("playground", 0.0, 0.0, 0.0),
    ("town", 15.0, 0.0, 40.0), ("town", -30.0, 10.0, 40.0), ("town", 5.0, 5.0, 12.0),
    ("field", 20.0, 0.0, 40.0), ("forest", 0.0, 0.0, 40.0), ("forest", 20.0, 30.0, 60.0),
)  # fmt: skip
"""Site, east, north and height m of the pictures of the sheet."""
COLUMNS, THUMBNAIL = 3, (480, 270)


def cpu_s(work):
    """CPU time that some work takes, s."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def camera(site, flight, options):
    """A camera on a flight."""
    home = np.array([0.0, 0.0, float(site.terrain([[0.0, 0.0]])[0]) + 0.3])
    trajectory, _ = fly(flight, SEED, FLIGHT_S, home)
    clock = DeviceClock.draw(ClockOptions.perfect(), SEED, Device.CAMERA, FLIGHT_S)
    mount = draw_extrinsics(ExtrinsicsOptions(), SEED)[0].T_body_cam
    return SimulatedCamera(site, trajectory, mount, draw_lens(options, SEED)[0], options, SEED, clock)


def parts(cam, options, frames):
    """Median CPU time ms of a whole frame, of its poses, of rendering, smearing, developing and JPEG; longest frame."""
    exposure, rng, rows = Exposure(options), np.random.default_rng(0), []
    for t_s in np.linspace(5, FLIGHT_S - 40, frames):
        poses = cam.poses(t_s)
        light = cam.look(poses)
        image = np.empty(light.shape, np.uint8)
        flat = (len(light), -1)
        rows.append(
            [
                cpu_s(lambda t=t_s: cam._encoded(cam.expose(t, exposure, rng)[0])),
                cpu_s(lambda t=t_s: cam.poses(t)),
                cpu_s(lambda p=poses: cam.look(p)),
                cpu_s(
                    lambda p=poses, v=light: film.smear(
                        v, cam._depth, cam._rays, p.v_cam, p.omega_cam, cam.model.fx, 0.004, cam._smeared
                    )
                ),
                cpu_s(
                    lambda v=light, to=image, f=flat: film.develop(
                        v.reshape(f), cam._transmission.reshape(f), 1.0, 9e3, 1.0, 6.0, cam._normals,
                        np.zeros(len(v), np.int64), to.reshape(f),
                    )
                ),
                cpu_s(lambda v=image: cv2.imencode(".jpg", v, [cv2.IMWRITE_JPEG_QUALITY, options.jpeg_quality])),
            ]
        )  # fmt: skip
    times = 1e3 * np.array(rows)
    return [float(statistics.median(column)) for column in times.T], float(times[:, 0].max())


def picture(site, east, north, height):
    """A small picture a second after a place, m from home, on a way to the north-east; at height 0 on the ground."""
    options, way = CameraOptions(), f"{east},{north},{height};{east + 50},{north + 40},{height}"
    flight = FlightOptions(start="air", height=height, waypoints=way) if height else FlightOptions(mission="stand")
    image, *_ = camera(site, flight, options).expose(1.0, Exposure(options), np.random.default_rng(0))
    return cv2.resize(image, THUMBNAIL, interpolation=cv2.INTER_AREA)


def main():
    """Runs the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--sheet", type=Path)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    options, columns, pictures = CameraOptions(), {}, {}
    bounds = Bounds(-HALF, -HALF, HALF, HALF)
    small = generate_site(WorldOptions(site="field", texel=0.5), SEED, Bounds(-9.0, -9.0, 9.0, 9.0))
    camera(small, SURVEY, options).expose(1.0, Exposure(options), np.random.default_rng(0))  # compiles
    for name in tqdm(SITES, disable=None):
        begun = time.process_time()
        site = generate_site(WorldOptions(site=name), SEED, bounds)
        made_s = time.process_time() - begun
        (whole, poses, look, smear, develop, jpeg), longest = parts(
            camera(site, SURVEY, options), options, arguments.frames
        )
        rest = whole - poses - look - smear - develop - jpeg
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        columns[name] = (1e3 / whole, whole, longest, poses, look, smear, develop, jpeg, rest, made_s, memory)
        if arguments.sheet:
            pictures |= {view: picture(site, *view[1:]) for view in VIEWS if view[0] == name}
        del site
    figures = (
        Figure("frames a second of one core", "", 1, least=12.0),
        Figure("CPU time a frame of 1280×720, median", "ms", 1),
        Figure("the longest frame", "ms", 1),
        Figure("of it: poses of the rows", "ms", 1),
        Figure("tracing and shading", "ms", 1),
        Figure("motion blur", "ms", 1),
        Figure("exposure and noise", "ms", 1),
        Figure("JPEG", "ms", 1),
        Figure("the rest: lens blur, metering", "ms", 1),
        Figure("CPU time for a site of 200 m × 200 m at 2 cm", "s", 1, most=20.0),
        Figure("memory of the process so far", "GB", 2, most=1.5),
    )
    print_table(figures, columns)
    if arguments.sheet:
        tiles = [pictures[view] for view in VIEWS]
        rows = [np.hstack(tiles[i : i + COLUMNS]) for i in range(0, len(tiles), COLUMNS)]
        cv2.imwrite(str(arguments.sheet), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, 82])


if __name__ == "__main__":
    main()
