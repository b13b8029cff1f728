"""The rules of the house that a program can check."""

from __future__ import annotations

import ast
import importlib.metadata
import json
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import air.__main__
import ground.__main__
import schemas
from air.config import AirConfig
from common.config import load
from ground.config import GroundConfig

ROOT = Path(__file__).parents[1]
ROOMS = ("air", "common", "deploy", "docs", "ground", "schemas", "tests")
SOURCES = sorted(p for room in ROOMS for p in (ROOT / room).rglob("*.py"))
DOCUMENTS = sorted([*ROOT.glob("*.md"), *(p for room in ROOMS for p in (ROOT / room).rglob("*.md"))])
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LONGEST = 400
REASON = re.compile(r"\bone file, because\b")
"""The header of a longer file defends it in these words."""

TOOLS = {"import-linter", "mypy", "pytest-timeout", "pytest-xdist", "ruff", "types-pyyaml"}
READ_BY_OTHERS = {"defusedxml"}
"""Pillow reads XMP only where it is installed."""


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


# Files


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_a_file_is_short_or_says_why_not(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    lines, header = len(text.splitlines()), ast.get_docstring(ast.parse(text)) or ""
    assert lines <= LONGEST or REASON.search(header), f"{lines} lines: split it, or write '… in one file, because …'"


def test_no_file_names_a_folder_of_somebodys_machine() -> None:
    """Home, root and scratch folders differ from machine to machine; /opt, /etc, /var and /usr are the product's."""
    machine = re.compile(r"(?<![\w.-])/(?:home|root|tmp|work|Users)/\w")
    texts = [p for room in (*ROOMS, ".ci") for p in (ROOT / room).rglob("*") if is_text(p)]
    texts += [p for p in ROOT.iterdir() if is_text(p)]
    found = [
        f"{name_of(path)}:{number}: {line.strip()}"
        for path in texts
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if machine.search(line)
    ]
    assert not found, "\n".join(found)


def is_text(path: Path) -> bool:
    return path.is_file() and path.suffix in ("", ".md", ".py", ".toml", ".txt", ".json", ".sh", ".service")


def test_every_schema_has_golden_bytes_and_their_content() -> None:
    golden = {p.name for p in (ROOT / "tests" / "golden").iterdir()}
    assert golden == {name + end for name in schemas.names() for end in (".json", ".msgpack")}


# What linters check


def run(*command: str) -> None:
    done = subprocess.run(
        [str(Path(sys.executable).parent / command[0]), *command[1:]], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_imports_keep_their_directions() -> None:
    run("lint-imports", "--no-cache")


def test_everything_public_is_documented_and_only_commands_print() -> None:
    run("ruff", "check", "--no-cache", "--select", "D1,T20", "--ignore", "D105,D107", ".")


# Dependencies


def imported(room: str) -> set[str]:
    """Distributions that the Python files of a room import."""
    owners = importlib.metadata.packages_distributions()
    names = {name for p in SOURCES if p.is_relative_to(ROOT / room) for name in imports_of(p)}
    return {canonicalize_name(dist) for name in names for dist in owners.get(name, ())} - {"luojia"}


def imports_of(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield (node.module or "").split(".")[0]
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "importorskip":
            yield ast.literal_eval(node.args[0]).split(".")[0]


def requirements(*extras: str) -> list[Requirement]:
    lists = [PROJECT["dependencies"], *(PROJECT["optional-dependencies"][extra] for extra in extras)]
    return [Requirement(text) for texts in lists for text in texts]


def declared(*extras: str) -> set[str]:
    return {canonicalize_name(requirement.name) for requirement in requirements(*extras)}


def test_every_import_is_declared_where_it_is_needed() -> None:
    assert imported("common") | imported("schemas") <= declared()
    assert imported("air") <= declared() | declared("air") | declared("realsense")
    assert imported("ground") <= declared() | declared("ground")
    assert imported("tests") <= declared("air", "ground", "dev")


def test_every_declared_dependency_is_imported() -> None:
    base, rooms = declared(), imported("air") | imported("ground")
    assert base <= imported("common") | rooms
    assert declared("air") - base - READ_BY_OTHERS <= imported("air")
    assert declared("ground") - base <= imported("ground")
    assert declared("dev") - base - TOOLS <= imported("tests")


def test_constraints_pin_everything_that_is_installed_with_luojia() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", line) for line in lines)
    pinned = {canonicalize_name(line.split("==")[0]) for line in lines}
    assert closure(requirements("air", "ground", "dev")) <= pinned


def closure(waiting: list[Requirement]) -> set[str]:
    """Distributions that requirements bring along here, directly or by another."""
    seen: set[tuple[str, str]] = set()
    while waiting:
        requirement = waiting.pop()
        for one in {(canonicalize_name(requirement.name), extra) for extra in (*requirement.extras, "")} - seen:
            seen.add(one)
            wanted = map(Requirement, importlib.metadata.requires(one[0]) or ())
            waiting += [r for r in wanted if r.marker is None or r.marker.evaluate({"extra": one[1]})]
    return {name for name, _ in seen}


# Settings


def keys_of(settings: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    """Every key of a configuration with its value, as TOML would give it."""
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value):
            yield from keys_of(value, f"{at}{field.name}.")
        else:
            yield at + field.name, json.loads(json.dumps(value, default=str))


def documented_keys(text: str) -> Iterator[tuple[str, Any, str]]:
    """Every key of a TOML text, its value, and the comment right above it."""
    table, comment = "", ""
    for line in text.splitlines():
        if line.startswith("["):
            table, comment = line.strip("[]") + ".", ""
        elif line.startswith("#"):
            comment += line[1:]
        elif "=" in line:
            name, _, value = line.partition(" = ")
            yield table + name, tomllib.loads(f"value = {value}")["value"], comment.strip()
            comment = ""
        else:
            comment = ""


@pytest.mark.parametrize(("name", "settings"), [("air.toml", AirConfig), ("ground.toml", GroundConfig)])
def test_the_deployed_settings_load_and_list_every_key_with_its_default(name: str, settings: type[Any]) -> None:
    path = ROOT / "deploy" / name
    load(path, settings)
    written = {key: (value, comment) for key, value, comment in documented_keys(path.read_text(encoding="utf-8"))}
    expected = dict(keys_of(settings()))
    assert list(written) == list(expected)
    for key, default in expected.items():
        value, comment = written[key]
        assert comment, f"{key} has no comment"
        assert value == default or comment.endswith(f"Default: {json.dumps(default)}"), f"{key}: it is {default!r}"


@pytest.mark.parametrize("unit", sorted((ROOT / "deploy").glob("*.service")), ids=name_of)
def test_a_service_starts_a_command_that_exists_with_settings_that_exist(unit: Path) -> None:
    (line,) = re.findall(r"^ExecStart=(.*)$", unit.read_text(encoding="utf-8"), re.MULTILINE)
    program, *arguments = shlex.split(line)
    assert Path(program).parent == Path("/opt/luojia/bin")
    assert (ROOT / "deploy" / Path(parsed(Path(program).name, arguments).config).name).exists()


# Documents


def parsed(program: str, arguments: list[str]) -> Any:
    """The arguments as the program itself reads them."""
    parser = {"luojia-air": air.__main__, "luojia-ground": ground.__main__}[program]._parser()
    return parser.parse_args(arguments)


def commands_of(path: Path) -> Iterator[list[str]]:
    """The words of every command in a document's shell blocks."""
    for block in re.findall(r"```sh\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            if words := shlex.split(line, comments=True):
                yield words


def targets() -> dict[str, bool]:
    """Targets of the Makefile, and whether `make help` tells of them."""
    lines = (ROOT / "Makefile").read_text(encoding="utf-8").splitlines()
    return {m[1]: "## " in line for line in lines if (m := re.match(r"([a-z][a-z-]*):(?!=)", line))}


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_the_commands_of_a_document_exist(path: Path) -> None:
    for program, *arguments in commands_of(path):
        if Path(program).name in ("luojia-air", "luojia-ground"):
            parsed(Path(program).name, arguments)
        elif program == "make":
            assert set(arguments) <= targets().keys()
        elif Path(program).name == "python" and arguments[0] != "-m":
            assert (ROOT / arguments[0]).exists(), arguments[0]


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_the_links_of_a_document_lead_somewhere(path: Path) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)", path.read_text(encoding="utf-8"))
    missing = [link for link in links if not (path.parent / link).exists()]
    assert not missing


def test_make_alone_lists_every_command() -> None:
    assert next(iter(targets())) == "help"
    assert all(targets().values())


def test_benchmarks_md_has_a_section_for_every_benchmark() -> None:
    sections = re.findall(r"python (tests/benchmarks/bench_\w+\.py)", (ROOT / "BENCHMARKS.md").read_text("utf-8"))
    assert set(sections) == {name_of(p) for p in (ROOT / "tests" / "benchmarks").glob("bench_*.py")}
