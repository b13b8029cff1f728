"""The assembled simulator: options by URL, devices on the host's clock, a recording, and the truth out of reach."""

from __future__ import annotations

import hashlib
import io
import subprocess
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path

import cv2
import laspy
import numpy as np
import pytest
import rasterio

from air.__main__ import main
from air.config import AirConfig
from air.conversion.convert import convert
from air.info import summarize
from air.sensors.h264 import image_of
from air.simulate import record_flight, simulate
from air.sources.known import ENDING, read_known
from air.sources.simulated.aircraft import READ_BYTES
from air.sources.simulated.clocks import Device
from air.sources.simulated.flown import SimulatedFlight
from air.sources.simulated.imu import ImuOptions
from air.sources.source import open_source
from common.errors import ExportError, SourceError
from common.export.projection import UtmProjection
from common.export.trajectory import read_tum
from common.measurements import (
    CameraFrame,
    ClockState,
    GnssEpoch,
    ImuSample,
    KeplerEphemeris,
    Measurement,
    RawBytes,
    ReceiverSolution,
    VehicleState,
)
from common.recording.reader import Recording
from common.se3 import rotation_angle
from common.wire import encode

SHORT = "sim:plain?duration=6&flight.start=air"


def flight(url: str) -> SimulatedFlight:
    found = open_source(url)
    assert isinstance(found, SimulatedFlight)
    return found


def of(kind: type, measurements: list[Measurement]) -> list:
    return [m for m in measurements if isinstance(m, kind)]


# Options


def test_the_url_sets_every_part() -> None:
    options = flight(
        "sim:plain?seed=3&duration=5&imu=perfect&imu.vibration=1&gnss.multipath=0&gnss.outage=1-2&base=off"
        "&flight.mission=stand&clock=perfect&extrinsics.antenna_m=0&mavlink.lost=0.5"
    ).aircraft.options
    assert (options.seed, options.duration, set(options.off)) == (3, 5.0, {"base", "camera"})
    assert (options.imu.vibration, options.imu.accel_noise_ug, options.imu.bits) == (1.0, 0.0, 0)
    assert (options.gnss.multipath, options.gnss.outage, options.base.rate_hz) == (0.0, "1-2", 1.0)
    assert (options.flight.mission, options.clock.drift_ppm) == ("stand", 0.0)
    assert (options.extrinsics.antenna_m, options.mavlink.lost) == (0.0, 0.5)


def test_the_order_of_options_does_not_matter() -> None:
    one, other = flight("sim:plain?imu.vibration=1&imu=perfect"), flight("sim:plain?imu=perfect&imu.vibration=1")
    assert one.aircraft.options == other.aircraft.options
    assert one.aircraft.options.imu == ImuOptions(**{**vars(ImuOptions.perfect()), "vibration": 1.0})


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("sim:race", "there is no site 'race'; there are survey, plain, geotiff, playground"),
        ("sim:plain?gnss.multipaht=0", "gnss.multipaht is not a setting; did you mean multipath?"),
        ("sim:plain?gnss.multipath=-1", "gnss.multipath is -1.0; allowed: 0.0 to 1000.0"),
        ("sim:plain?gnss.multipath=much", "gnss.multipath is 'much'; allowed: a number"),
        ("sim:plain?gnss.multipath=nan", "gnss.multipath is nan; allowed: a number"),
        ("sim:plain?gnss.outage=9-3", "option 'outage' is '9-3', must be seconds of the flight"),
        ("sim:plain?gnss.systems=X", "option 'systems' is 'X', must be some of GREC"),
        ("sim:plain?colour=red", "colour is not a setting"),
        ("sim:plain?ortho=a.tif", "ortho is not a setting"),
        ("sim:plain?duration=0", "duration is 0.0; allowed: 1.0 to 7200.0"),
        ("sim:plain?seed=1.5", "seed is 1.5; allowed: a whole number"),
        ("sim:plain?seed=1&seed=2", "option 'seed' is given twice"),
        ("sim:plain?imu=good", "imu is 'good'; allowed: perfect or off or one of its options"),
        ("sim:plain?flight=off", "flight is 'off'; allowed: one of its options: flight.mission"),
        ("sim:plain?off=imu", "off is 'imu'; allowed: imu=off"),
        ("sim:plain?camera=perfect", "this site has nothing to see; allowed: camera=off"),
        ("sim:plain?flight.mission=dance", "flight.mission is 'dance'; allowed: 'survey', 'hover', 'stand'"),
        ("sim:plain?flight.waypoints=1,2", "waypoints has '1,2'"),
        ("sim:plain?base.jamming=x", "option 'jamming' is 'x'"),
    ],
)
def test_what_cannot_be_is_refused_by_name(url: str, said: str) -> None:
    with pytest.raises(SourceError) as refused:
        open_source(url)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


# Devices


def test_every_device_speaks_through_its_driver() -> None:
    source = flight("sim:plain?duration=40&gnss.missing=0&mavlink.lost=0&flight.start=air")
    measurements = list(source)
    assert source.problems == []
    counts = Counter(type(m).__name__ for m in measurements)
    assert 36 * 200 <= counts["ImuSample"] <= 40 * 200  # the first two seconds find the time
    assert sum(m.receiver == "gnss" for m in of(GnssEpoch, measurements)) == pytest.approx(400, abs=2)
    assert sum(m.receiver == "base" for m in of(GnssEpoch, measurements)) == pytest.approx(40, abs=1)
    assert {m.device for m in of(RawBytes, measurements)} == {"imu", "gnss", "base", "mavlink"}
    assert {m.device for m in of(ClockState, measurements)} == {"gnss", "imu"}
    assert len(of(VehicleState, measurements)) > 250
    assert len({m.satellite for m in of(KeplerEphemeris, measurements)}) > 20
    assert max(len(m.data) for m in of(RawBytes, measurements)) <= READ_BYTES
    # Arrivals run forwards once time is known.
    stamps = [m.t_ns for m in of(RawBytes, measurements)][2000:]
    assert all(later - earlier > -2e6 for earlier, later in pairwise(stamps))


def test_a_device_that_is_off_says_nothing() -> None:
    measurements = list(flight("sim:plain?duration=4&imu=off&base=off&mavlink=off"))
    assert {m.device for m in of(RawBytes, measurements)} == {"gnss"}


def test_without_a_receiver_the_computer_s_clock_stands_in() -> None:
    """It was right when the flight began, and tells itself five times a second: ten times are enough."""
    source = flight(FILMED.replace("=7", "=6", 1) + "&gnss=off&clock.drift_ppm=0")
    measurements = list(source)
    samples, frames = of(ImuSample, measurements), of(CameraFrame, measurements)
    assert len(samples) > 600
    assert len(frames) > 15
    for found in (samples, frames):
        assert [m.t_ns for m in found] == sorted(m.t_ns for m in found)
        assert found[-1].t_ns - source.aircraft.start_ns == pytest.approx(6e9, abs=0.2e9)


def test_stamps_are_true_to_a_millisecond_from_jittery_arrivals() -> None:
    """An epoch arrives 0.35 ms later for each signal that it holds; jamming takes some thirty of them away."""
    source = flight("sim:plain?duration=60&base=off&mavlink=off&gnss.jamming=15-60&gnss.jamming_db=20")
    true_s = np.concatenate([batch.t_s for batch in source.aircraft.imu().batches()])
    measurements = list(source)
    told_s = np.array([m.t_ns - source.aircraft.start_ns for m in of(ImuSample, measurements)]) * 1e-9
    true_s -= source.aircraft.options.imu.delay_s  # of the middle of each sample
    error_s = told_s - true_s[len(true_s) - len(told_s) - 1 : -1]  # the last one is on its way when the flight ends
    signals = [len(m.satellites) for m in of(GnssEpoch, measurements)]
    assert np.ptp(signals) > 20
    assert np.abs(error_s[10 * 200 :]).max() < 0.5e-3


def test_perfect_devices_on_perfect_clocks_tell_the_truth() -> None:
    source = flight("sim:plain?duration=6&imu=perfect&clock=perfect&gnss=perfect&flight.start=air")
    samples = of(ImuSample, list(source))
    t_s = np.array([(m.t_ns - source.aircraft.start_ns) * 1e-9 for m in samples])
    truth = source.aircraft.trajectory.at(t_s)
    # The earth turns by 7e-5 rad/s, and a mean over 5 ms is not the value in its middle.
    np.testing.assert_allclose([m.gyro for m in samples], truth.omega_body, atol=2e-3)


# The truth


def test_the_truth_is_written_and_agrees_with_the_trajectory(tmp_path: Path) -> None:
    source = flight(SHORT)
    source.truth.write(tmp_path / "truth")
    tum = read_tum(tmp_path / "truth" / "trajectory.tum")
    assert len(tum.t_ns) == 6 * 200 + 1
    assert set(np.diff(tum.t_ns).tolist()) == {5_000_000}
    motion = source.aircraft.trajectory.at((tum.t_ns - source.aircraft.start_ns) * 1e-9)
    np.testing.assert_allclose(tum.positions, motion.p_world, atol=1e-8)
    np.testing.assert_allclose([pose.R for pose in tum.poses], motion.R_world_body, atol=1e-7)
    names = {path.name for path in (tmp_path / "truth").iterdir()}
    assert names == {
        *("trajectory.tum", "state.csv", "clocks.csv", "satellites.csv", "flight.json", "datum.json"),
    }
    table = np.genfromtxt(tmp_path / "truth" / "clocks.csv", delimiter=",", names=True)
    assert len(table) == 7
    host_s = source.aircraft.host_ns(6.0) * 1e-9
    assert table["host_s"][-1] == pytest.approx(host_s, abs=1e-6)


def test_the_truth_changes_no_byte_of_what_is_measured() -> None:
    """A source whose truth nobody can ask gives the same bytes; so does the recording without the truth's channels."""

    class Blind(SimulatedFlight):
        @property
        def truth(self) -> None:  # type: ignore[override]
            raise AssertionError("somebody asked for the truth")

    seeing = flight(SHORT)
    blind = Blind(SHORT, seeing.aircraft)
    assert [encode(m) for m in blind] == [encode(m) for m in seeing]


def test_no_reader_of_a_recording_comes_upon_the_truth(tmp_path: Path) -> None:
    paths = {truth: tmp_path / f"truth-{truth}.mcap" for truth in (True, False)}
    for truth, path in paths.items():
        with path.open("wb") as file:
            record_flight(flight(SHORT), file, AirConfig(), truth)
    whole, bare = (list(Recording(path).messages()) for path in paths.values())
    assert whole == bare
    read = [[encode(m) for m in open_source(str(path))] for path in paths.values()]
    assert read[0] == read[1] == [encode(m) for m in flight(SHORT)]
    tables = Counter(r.key for r in Recording(paths[True]).messages(encoding="json") if r.key.startswith("truth/"))
    assert (tables["truth/flight"], tables["truth/state"], tables["truth/clocks"]) == (1, 6 * 200 + 1, 7)
    assert tables["truth/satellites"] > 6 * 30
    assert open_source(str(paths[True])).truth is None


@pytest.mark.slow
def test_no_estimator_finds_anything_else_without_the_truth(tmp_path: Path) -> None:
    """Odometry and positions of a recording, and of the same one whose channels of truth were never written."""
    url = (
        "sim:playground?duration=16&flight.start=air&flight.height=12&flight.length=40&flight.width=12&world.texel=0.1"
        "&camera.rate_hz=10&camera.width=480&camera.height=270"
    )
    found = []
    for truth in (True, False):
        folder = tmp_path / f"truth-{truth}"
        folder.mkdir()
        recording = folder / "flight.mcap"
        with recording.open("wb") as file:
            record_flight(flight(url), file, AirConfig(), truth)
        flight(url).known.write(recording.with_suffix(ENDING))
        assert main(["odometry", str(recording), "--out", str(folder / "odometry"), "--quiet"]) == 0
        assert main(["position", str(recording), "--out", str(folder / "position.csv"), "--quiet"]) == 0
        names = ("odometry/trajectory.tum", "odometry/keyframes.tum", "position.csv")
        found.append([(folder / name).read_bytes() for name in names])
    assert found[0] == found[1]
    assert all(len(file) > 2000 for file in found[0])


# Recordings


def test_the_same_url_gives_the_same_recording() -> None:
    """Written at different times of day, by sources that were opened anew."""

    def digest() -> str:
        file = io.BytesIO()
        record_flight(flight(SHORT), file, AirConfig())
        return hashlib.sha256(file.getvalue()).hexdigest()

    assert digest() == digest()


def test_simulate_records_a_flight_and_never_overwrites(tmp_path: Path) -> None:
    out = tmp_path / "flight.mcap"
    count = simulate(AirConfig(), SHORT, out, tmp_path / "truth")
    assert count == len(list(flight(SHORT)))
    assert Recording(out).about["source"] == SHORT
    summary = summarize(open_source(str(out)), iter(open_source(str(out))))
    rates = {stream.name: stream.rate_hz for stream in summary.streams}
    assert rates["imu"] == pytest.approx(200, rel=0.01)
    assert (tmp_path / "flight.calibration" / "aircraft.toml").exists()
    assert (tmp_path / "truth" / "trajectory.tum").exists()
    with pytest.raises(ExportError, match="is there already"):
        simulate(AirConfig(), SHORT, out)
    with pytest.raises(SourceError, match="no simulated flight"):
        simulate(AirConfig(), "sim:survey", tmp_path / "other.mcap")


def test_the_receiver_finds_its_place() -> None:
    source = flight("sim:plain?duration=20&flight.mission=stand")
    last = [m for m in source if isinstance(m, ReceiverSolution) and m.receiver == "gnss"][-1]
    datum = source.aircraft.datum
    assert last.latitude_deg == pytest.approx(datum.latitude_deg, abs=1e-4)
    assert last.height == pytest.approx(datum.height, abs=15)


# A long flight, and one with a camera

MEMORY = """
import os, sys
from pathlib import Path
from air.sources.source import open_source

def resident_mb():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 1e6

early = None
for heard in open_source(sys.argv[1]).heard():
    if early is None and heard.t_s > float(sys.argv[2]):
        early = resident_mb()
    if heard.t_s > float(sys.argv[3]):
        break
print(early, resident_mb())
"""


def memory_mb(url: str, early_s: float, late_s: float) -> tuple[float, float]:
    """Memory of a program that reads a flight, at two times of the flight."""
    done = subprocess.run(
        [sys.executable, "-c", MEMORY, url, str(early_s), str(late_s)], capture_output=True, text=True, check=True
    )
    early, late = map(float, done.stdout.split())
    return early, late


def test_half_an_hour_takes_no_more_memory_than_a_minute() -> None:
    """What is drawn in advance for the whole flight is there from the start; the rest must not grow."""
    early, late = memory_mb("sim:plain?duration=1800", 20.0, 90.0)
    assert early < 400
    assert late - early < 5  # 2 MB by which allocators breathe, and 1 kB for every second


@pytest.mark.slow
def test_half_an_hour_with_a_camera_stays_within_memory() -> None:
    url = "sim:playground?duration=1800&camera.rate_hz=0.2"
    early, late = memory_mb(url, 60.0, 1790.0)
    assert early < 2500
    assert late - early < 50


@pytest.fixture(scope="module")
def filmed() -> list[Measurement]:
    return list(flight(FILMED))


FILMED = (
    "sim:playground?duration=7&flight.mission=hover&flight.height=12&flight.start=air&world.texel=0.1"
    "&camera.rate_hz=6&camera.width=320&camera.height=180"
)


def test_frames_are_stamped_in_their_middle(filmed: list[Measurement]) -> None:
    source = flight(FILMED)
    clock, start_ns = source.aircraft.clocks[Device.CAMERA], source.aircraft.start_ns
    taken = {f.index: float(clock.true_s(np.array(f.t_ns * 1e-9))) for _, f in source.aircraft.camera().frames()}
    frames = of(CameraFrame, filmed)
    assert len(frames) > 15
    for frame in frames:
        assert (frame.t_ns - start_ns) * 1e-9 == pytest.approx(taken[frame.index], abs=3e-3)  # the first seconds


def test_a_filmed_flight_is_the_same_every_time_and_has_calibration_and_surface(
    filmed: list[Measurement], tmp_path: Path
) -> None:
    simulate(AirConfig(), FILMED, tmp_path / "flight.mcap", tmp_path / "truth")
    assert [encode(m) for m in open_source(str(tmp_path / "flight.mcap"))] == [encode(m) for m in filmed]
    known, true = read_known(tmp_path / "flight.calibration"), flight(FILMED).aircraft
    camera = known.cameras["down"]
    assert camera.camera == true.nominal_lens
    assert 0 < abs(camera.camera.fx - true.lens.fx) < 2
    assert 0 < rotation_angle(camera.T_body_cam.R.T @ true.extrinsics.T_body_cam.R) < np.radians(1)
    cloud = laspy.read(tmp_path / "truth" / "surface.laz")
    p = UtmProjection(true.datum).to_world(np.asarray(cloud.xyz)[::1000])
    assert np.median(np.abs(true.site.height(p[:, :2]) - p[:, 2])) < 0.005
    with rasterio.open(tmp_path / "truth" / "dsm.tif") as dsm:
        assert dsm.res == pytest.approx((0.125, 0.125), rel=1e-3)


def test_a_flight_takes_place_over_files_of_a_real_place(tmp_path: Path) -> None:
    """100 m × 100 m in UTM zone 50: a plane that rises by 1 m in 20 m to the east, 37.5 m high in its middle."""
    grid = {"crs": "EPSG:32650", "transform": rasterio.Affine(0.5, 0.0, 247_000, 0.0, -0.5, 3_380_100)}
    height = np.tile(35 + (np.arange(200) + 0.5) / 40, (200, 1)).astype(np.float32)
    colour = np.random.default_rng(1).integers(60, 200, (3, 200, 200), np.uint8)
    for name, bands in (("ortho", colour), ("dsm", height[None])):
        shape = {"count": len(bands), "height": 200, "width": 200, "dtype": bands.dtype}
        with rasterio.open(tmp_path / f"{name}.tif", "w", driver="GTiff", **shape, **grid) as raster:
            raster.write(bands)
    files, small = f"ortho={tmp_path}/ortho.tif&dsm={tmp_path}/dsm.tif", "camera.width=64&camera.height=48"
    source = flight(f"sim:geotiff?{files}&duration=2&flight.mission=stand&camera.rate_hz=2&{small}")
    assert source.aircraft.datum.latitude_deg == pytest.approx(30.528, abs=0.01)
    assert source.aircraft.datum.height == pytest.approx(37.5, abs=0.1)
    slope = source.aircraft.ground.height(np.array([[-20.0, 0.0], [20.0, 0.0]]))
    assert slope[1] - slope[0] == pytest.approx(2.0, abs=0.05)
    assert {m.device for m in of(RawBytes, list(source))} == {"imu", "gnss", "base", "mavlink"}
    with pytest.raises(SourceError, match=r"ortho=nothing\.tif cannot be read"):
        open_source(f"sim:geotiff?ortho=nothing.tif&dsm={tmp_path}/dsm.tif")


@pytest.mark.slow
def test_frames_come_back_from_a_euroc_folder(tmp_path: Path) -> None:
    url = FILMED + "&camera.encoding=mono8"
    convert(url, "euroc", tmp_path)
    frames, back = of(CameraFrame, list(flight(url))), of(CameraFrame, list(open_source(f"euroc:{tmp_path}")))
    assert len(frames) == len(back) > 15
    for before, after in zip(frames, back, strict=True):
        assert before.t_ns == after.t_ns
        np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(after.data, np.uint8), -1), image_of(before))
