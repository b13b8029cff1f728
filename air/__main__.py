"""The `luojia-air` command: process, run, info."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from common import log
from common.config import load
from common.errors import LuojiaError

# Photos and pairs are worked on in threads of our own; threads of libraries within them only get in each other's way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")


def command() -> int:
    """Entry of the installed command: `main`, undisturbed by what gtsam writes to standard output by itself."""
    sys.stdout = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return main()


def main(arguments: list[str] | None = None) -> int:
    """Exit code: 0 done, 1 an error that one line on stderr explains, 2 wrong usage."""
    args = _parser().parse_args(arguments)
    try:
        code: int = args.run(args)
    except LuojiaError as error:
        print(f"luojia-air: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="luojia-air", description="Turn a flight into a georeferenced 3D map.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    process = commands.add_parser("process", help="map a recorded or simulated flight in one go and write files")
    process.add_argument("source", metavar="SOURCE", help="photos:DIR or sim:survey?seed=1&photos=60")
    process.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the files")
    process.set_defaults(run=_process)

    run = commands.add_parser("run", help="fly: map a source as it comes and send the map to the ground")
    run.add_argument("--source", metavar="SOURCE", help="instead of the configuration's")
    run.set_defaults(run=_run)

    info = commands.add_parser("info", help="tell what is in a source: streams, counts, rates, gaps, faults")
    info.add_argument("source", metavar="SOURCE", help="e.g. ubx:F, euroc:DIR, gopro:F, ulog:F, bag:F or F.mcap")
    info.add_argument("--json", action="store_true", help="for programs, instead of a table")
    info.set_defaults(run=_info)

    position = commands.add_parser("position", help="position and velocity of each GNSS epoch of a source, as a table")
    position.add_argument("source", metavar="SOURCE", help="with raw measurements: ubx:F, rinex:OBS,NAV or F.mcap")
    position.add_argument("--out", type=Path, required=True, metavar="F.csv", help="the table")
    position.add_argument("--systems", default="GREJC", metavar="GREJC", help="GNSS to use, letters as in RINEX")
    position.add_argument("--mask", type=float, default=10.0, metavar="DEG", help="least elevation of a satellite")
    position.add_argument("--dual", action="store_true", help="remove the ionosphere by a second band")
    position.add_argument("--smooth", action="store_true", help="join the positions by carrier phase, looking back")
    position.set_defaults(run=_position)

    odometry = commands.add_parser("odometry", help="trajectory by IMU, camera and GNSS, as files")
    odometry.add_argument("source", metavar="SOURCE", help="with IMU samples and frames or raw GNSS: F.mcap, euroc:DIR")
    odometry.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the files")
    odometry.add_argument("--calibration", type=Path, metavar="F", help="of the camera, where the source has none")
    odometry.add_argument("--smooth", action="store_true", help="also the path as the whole flight tells it afterwards")
    odometry.set_defaults(run=_odometry)

    record = commands.add_parser("record", help="record everything on the bus into a file until it is stopped")
    record.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the recording")
    record.set_defaults(run=_record)

    replay = commands.add_parser("replay", help="publish what was recorded, at the pace at which it came")
    replay.add_argument("recording", type=Path, metavar="F.mcap")
    replay.add_argument("--speed", type=float, default=1.0, metavar="S", help="2 is twice as fast, inf all at once")
    replay.add_argument("--start", type=float, default=0.0, metavar="s", help="seconds from the start of the recording")
    replay.add_argument("--end", type=float, default=float("inf"), metavar="s", help="seconds from its start")
    replay.add_argument("--loop", action="store_true", help="begin again after the end")
    replay.set_defaults(run=_replay)

    simulate = commands.add_parser("simulate", help="record a simulated flight as fast as it computes")
    simulate.add_argument("source", metavar="URL", help="e.g. sim:playground?seed=1&duration=300&gnss.multipath=0")
    simulate.add_argument("--out", type=Path, required=True, metavar="F.mcap", help="the recording")
    simulate.add_argument("--truth", type=Path, metavar="DIR", help="folder for the truth as files")
    simulate.set_defaults(run=_simulate)

    convert = commands.add_parser("convert", help="write a flight in the formats of other programs")
    convert.add_argument("source", metavar="SOURCE", help="with IMU, camera or GNSS: F.mcap, sim:playground, bag:F")
    convert.add_argument("--to", required=True, metavar="euroc+rinex", help="formats: euroc, rinex, or both")
    convert.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the files")
    convert.add_argument("--calibration", type=Path, metavar="DIR", help="what simulate wrote beside its recording")
    convert.set_defaults(run=_convert)

    check = commands.add_parser("check", help="find the devices and show how each is doing")
    check.add_argument("--once", action="store_true", help="print once and end, for scripts")
    check.add_argument("--json", action="store_true", help="for programs; implies --once")
    check.set_defaults(run=_check)

    _add_calibrate(commands.add_parser("calibrate", help="calibrate a camera, or a camera against the IMU"))

    for command in (process, info, position, odometry, replay, simulate, convert):
        command.add_argument("--quiet", action="store_true", help="no progress bar")
    for command in (check, process, odometry, run, record, replay, simulate):
        command.add_argument("--config", type=Path, metavar="FILE", help="TOML file; without it the defaults hold")
    return parser


def _add_calibrate(parser: argparse.ArgumentParser) -> None:
    kinds = parser.add_subparsers(required=True, metavar="WHAT")
    camera = kinds.add_parser("camera", help="intrinsics and distortion from images of a chessboard")
    camera.add_argument("images", type=Path, metavar="IMAGES_DIR", help="folder of JPEG or PNG images")
    camera.add_argument("--board", required=True, metavar="9x6", help="inner corners of the board, columns x rows")
    camera.add_argument("--square", type=float, required=True, metavar="M", help="side of a square, m")
    camera.set_defaults(run=_calibrate_camera)
    imu = kinds.add_parser("imu-camera", help="rotation and time offset between camera and IMU, from a recording")
    imu.add_argument("source", metavar="SOURCE", help="with camera frames and IMU samples, e.g. euroc:DIR or F.mcap")
    imu.add_argument("--calibration", type=Path, required=True, metavar="F", help="intrinsics: our TOML, Kalibr, EuRoC")
    imu.set_defaults(run=_calibrate_imu_camera)
    flight = kinds.add_parser("flight", help="all of that from an ordinary flight that turns: no board, no known lens")
    flight.add_argument("source", metavar="SOURCE", help="with camera frames and IMU samples, e.g. gopro:F or F.mcap")
    flight.set_defaults(run=_calibrate_flight)
    for kind in (camera, imu, flight):
        kind.add_argument("--out", type=Path, metavar="F.toml", help="write the calibration here")
        kind.add_argument("--quiet", action="store_true", help="no progress bar")


def _process(args: argparse.Namespace) -> int:
    from air.config import AirConfig
    from air.process import process  # gtsam and numba take seconds to import; wrong usage is told at once

    report = process(load(args.config, AirConfig), args.source, args.out, args.quiet)
    for problem in report.problems:
        print(f"{problem['photo']}: {problem['state']}: {problem['reason']}", file=sys.stderr)
    placed, read = report.photos["placed"], report.photos["read"]
    print(f"{placed} of {read} photos, {report.area_m2:.0f} m² in {report.wall_s:.1f} s: {args.out}")
    return 0


def _run(args: argparse.Namespace) -> int:
    from air.config import AirConfig

    log.setup()
    config = load(args.config, AirConfig)
    url = args.source or config.source
    if url.startswith(("photos:", "sim:survey")):
        from air.nodes import fly

        return fly(config, url)
    from air.sensing import sense

    return sense(config, url)


def _position(args: argparse.Namespace) -> int:
    from tqdm import tqdm

    from air.gnss.settings import PositioningSettings
    from air.positions import find_positions, find_smooth_positions, in_words, write_positions
    from air.sources.source import open_source

    settings = PositioningSettings(args.systems, args.mask, ionosphere_free=args.dual)
    source = open_source(args.source)
    passing = tqdm(source, unit=" items", leave=False, disable=True if args.quiet else None)
    find = find_smooth_positions if args.smooth else find_positions
    for line in in_words(write_positions(args.out, find(passing, settings))):
        print(line)
    for problem in source.problems:
        print(f"{problem.name}: {problem.text}", file=sys.stderr)
    return 0


def _odometry(args: argparse.Namespace) -> int:
    from air.config import AirConfig
    from air.trajectory import find_trajectory, in_words

    settings = load(args.config, AirConfig).odometry
    report = find_trajectory(args.source, args.out, args.calibration, settings, args.quiet, args.smooth)
    for problem in report.problems:
        print(f"{problem['name']}: {problem['text']}", file=sys.stderr)
    for line in in_words(report):
        print(line)
    return 0


def _info(args: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table
    from tqdm import tqdm

    from air.info import as_dict, summarize, table
    from air.sources.source import open_source

    source = open_source(args.source)
    # `disable=None` shows the bar on terminals only.
    passing = tqdm(source, unit=" items", leave=False, disable=True if args.quiet else None)
    summary = summarize(source, passing)
    if args.json:
        print(json.dumps(as_dict(summary), ensure_ascii=False, indent=2))
        return 0
    heading, *rows = table(summary)
    shown = Table(box=None, pad_edge=False)
    for i, name in enumerate(heading):
        shown.add_column(name, justify="right" if i else "left", no_wrap=True)
    for row in rows:
        shown.add_row(*row)
    print(f"{summary.url}: {summary.duration_s:.1f} s")
    Console(markup=False, highlight=False).print(shown)
    if summary.counts is not None:
        seen = summary.counts
        print(f"{seen.received_bytes} bytes, {seen.dropped_bytes} dropped in {seen.bursts} bursts; ", end="")
        print(f"{seen.frames.total()} frames, {seen.refused} refused, {seen.missing} missing")
    for problem in summary.problems:
        print(f"{problem.name}: {problem.text}")
    return 0


def _record(args: argparse.Namespace) -> int:
    from air.config import AirConfig
    from air.recorder import record

    log.setup()
    return record(load(args.config, AirConfig), args.out)


def _simulate(args: argparse.Namespace) -> int:
    from air.config import AirConfig
    from air.simulate import simulate

    count = simulate(load(args.config, AirConfig), args.source, args.out, args.truth, args.quiet)
    print(f"{count} messages: {args.out}")
    return 0


def _convert(args: argparse.Namespace) -> int:
    from air.conversion.convert import convert

    done = convert(args.source, args.to, args.out, args.calibration, args.quiet)
    print(f"{', '.join(f'{count} {kind}' for kind, count in done.counts.items() if count)}: {args.out}")
    for problem in done.problems:
        print(f"{problem.name}: {problem.text}", file=sys.stderr)
    return 0


def _replay(args: argparse.Namespace) -> int:
    from tqdm import tqdm

    from air.config import AirConfig
    from air.replay import Passage, await_listener, paced, publish
    from common.bus import ZenohBus
    from common.clock import SystemClock
    from common.recording.reader import Recording

    recording = Recording(args.recording)
    messages = paced(recording, Passage(args.speed, args.start, args.end, args.loop), SystemClock())
    bus = ZenohBus(load(args.config, AirConfig).bus)
    try:
        await_listener(bus)
        count = publish(tqdm(messages, unit=" messages", leave=False, disable=True if args.quiet else None), bus)
    finally:
        bus.close()
    print(f"{count} messages of {args.recording}")
    for problem in recording.problems:
        print(f"{args.recording}: {problem}", file=sys.stderr)
    return 0


def _check(args: argparse.Namespace) -> int:
    from rich.console import Console

    from air.check import check
    from air.config import AirConfig

    return check(load(args.config, AirConfig), args.once, args.json, Console(file=sys.stdout))


def _calibrate_camera(args: argparse.Namespace) -> int:
    from air.calibration.command import calibrate_from_images

    print(calibrate_from_images(args.images, args.board, args.square, args.out, args.quiet))
    return 0


def _calibrate_imu_camera(args: argparse.Namespace) -> int:
    from air.calibration.command import calibrate_from_recording

    print(calibrate_from_recording(args.source, args.calibration, args.out, args.quiet))
    return 0


def _calibrate_flight(args: argparse.Namespace) -> int:
    from air.calibration.recorded_flight import calibrate_from_flight

    print(calibrate_from_flight(args.source, args.out, args.quiet))
    return 0


if __name__ == "__main__":
    sys.exit(command())
