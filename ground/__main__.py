"""The `luojia-ground` command: serve, export, spy, evaluate."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
import time
from pathlib import Path

from common import log
from common.config import load
from common.errors import LuojiaError
from ground.config import GroundConfig
from ground.evaluation import command as evaluation


def main(arguments: list[str] | None = None) -> int:
    """Exit code: 0 done, 1 an error that one line on stderr explains, 2 wrong usage."""
    args = _parser().parse_args(arguments)
    try:
        code: int = args.run(args)
    except LuojiaError as error:
        print(f"luojia-ground: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="luojia-ground", description="Merge, keep, show and hand out the map.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    serve = commands.add_parser("serve", help="run the ground station")
    serve.set_defaults(run=_serve)

    export = commands.add_parser("export", help="write the map of a flight as standard files")
    export.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the files")
    export.add_argument("--vehicle", help="default: any")
    export.add_argument("--flight", help="default: the one that started last")
    export.set_defaults(run=_export)

    spy = commands.add_parser("spy", help="list every stream with rate, bytes, age and faults")
    spy.add_argument("--seconds", type=float, metavar="N", help="listen so long, then print once")
    spy.add_argument("--json", action="store_true", help="print JSON, one list a report")
    spy.set_defaults(run=_spy)

    for command in (serve, export, spy):
        command.add_argument("--config", type=Path, metavar="FILE", help="TOML file; without it the defaults hold")

    evaluate = commands.add_parser("evaluate", help="compare a cloud or a trajectory with a reference")
    evaluation.add_arguments(evaluate)
    evaluate.set_defaults(run=evaluation.run)
    return parser


def _serve(args: argparse.Namespace) -> int:
    from ground.serve import running  # viser and its parts take a second to import; the other commands do without

    config = load(args.config, GroundConfig)
    log.setup()
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with running(config) as viewer:
        if viewer is not None:
            print(f"viewer: {viewer.url}", flush=True)
        stop.wait()
    return 0


def _export(args: argparse.Namespace) -> int:
    from ground.export import export

    config = load(args.config, GroundConfig)
    for name, path in export(config.store.path, args.out, config.min_views, args.vehicle, args.flight).items():
        print(f"{name}: {path}")
    return 0


def _spy(args: argparse.Namespace) -> int:
    from common.bus import ZenohBus
    from ground.spy import Spy, as_json, as_table

    bus = ZenohBus(load(args.config, GroundConfig).bus.of_guest)
    spy = Spy(bus)
    try:
        while True:
            time.sleep(1.0 if args.seconds is None else args.seconds)
            reports = spy.report()
            if args.json:
                print(json.dumps(as_json(reports)), flush=True)
            else:
                clear = "\033[2J\033[H" if args.seconds is None and sys.stdout.isatty() else ""
                print(clear + as_table(reports), flush=True)
            if args.seconds is not None:
                return 0
    finally:
        spy.close()
        bus.close()


if __name__ == "__main__":
    sys.exit(main())
