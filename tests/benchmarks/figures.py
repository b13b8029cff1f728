"""What the benchmarks share: the recordings, the commands, and tables of figures beside their targets."""

import json
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "data"


@dataclass(frozen=True)
class Figure:
    """A row of a table: what is measured, its unit and decimals, and the most or the least that it should be."""

    name: str
    unit: str = "m"
    digits: int = 3
    most: float | None = None
    least: float | None = None

    def cell(self, value):
        """The value as Markdown, bold where it misses its target."""
        text = self._text(value)
        missed = (self.most is not None and not value <= self.most) or (
            self.least is not None and not value >= self.least
        )
        return f"**{text}**" if missed else text

    @property
    def target(self):
        """The target as text, or a dash."""
        if self.most is not None:
            return f"≤ {self._text(self.most, exact=True)}"
        return "–" if self.least is None else f"≥ {self._text(self.least, exact=True)}"

    def _text(self, value, exact=False):
        if self.unit == "%":
            value = 100 * value
        number = f"{value:g}" if exact else f"{value:.{self.digits}f}"
        return f"{number} {self.unit}".strip()


def print_table(figures, columns):
    """Print figures as rows; `columns` gives for each heading the values in the order of the figures."""
    rows = [["", *columns, "target"], ["---"] * (len(columns) + 2)]
    for i, figure in enumerate(figures):
        rows.append([figure.name, *(figure.cell(values[i]) for values in columns.values()), figure.target])
    for row in rows:
        print(f"| {' | '.join(row)} |")
    print("\nBold: misses its target.\n", flush=True)


def recording(name):
    """Folder of a real recording; ends the benchmark where it is not installed."""
    folder = RECORDINGS / name
    if not folder.exists():
        print(f"skipped: the recording {name!r} does not lie in ../shared/data beside this checkout")
        sys.exit(0)
    return folder


def process(source, out):
    """Run `luojia-air process` as a program of its own; its report, with `cpu_s` added, the CPU time of all threads.

    Its problems go to standard error.
    """
    begun = _children_cpu_s()
    command = [sys.executable, "-m", "air", "process", source, "--out", str(out), "--quiet"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return json.loads((out / "report.json").read_text()) | {"cpu_s": _children_cpu_s() - begun}


def _children_cpu_s():
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
