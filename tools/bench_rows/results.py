"""The results of a run of the benchmark, as JSON, and their changes since another run."""

from __future__ import annotations

import json
import math
import os
import platform
import statistics
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from bench_rows.row import Row

_PACKAGES = ("aolink", "numpy", "scipy", "numba", "mcap", "protobuf", "rerun-sdk", "pyarrow", "typer", "rich")
_LEAST_NOISE = 0.02
"""Least noise of a ratio, where a few runs happen to agree better than that."""
_SIGMAS = 2.0
"""Least size of a change that counts, in units of the noise."""


@dataclass(kw_only=True)
class Result:
    """A figure, measured once or several times."""

    name: str
    """Module and function, and the number of the figure where a function has several."""
    figure: str
    ours: str
    peer: str
    values: list[float] = field(default_factory=list)
    """Ratio to the peer or limit, above one where it is better, one value for each run."""
    target: float | None = None
    """The least value that it should have; None where the figure could not be measured."""
    error: str | None = None
    """The reason why it could not be measured."""

    @property
    def value(self) -> float:
        """The median; NaN where it could not be measured."""
        return statistics.median(self.values) if self.values else math.nan

    @property
    def missed(self) -> bool:
        """Whether it is worse than it should be."""
        return self.target is not None and not self.value >= self.target


def results(name: str, runs: Sequence[Row | list[Row]]) -> list[Result]:
    """The results of the runs of one function, figure by figure; the texts are those of the last run."""
    every = [run if isinstance(run, list) else [run] for run in runs]
    return [
        Result(
            name=name if len(every[0]) == 1 else f"{name}#{k + 1}", figure=rows[-1].figure, ours=rows[-1].ours,
            peer=rows[-1].peer, values=[row.ratio for row in rows], target=rows[-1].target,
        )
        for k, rows in enumerate(zip(*every, strict=True))
    ]  # fmt: skip


def failure(name: str, error: Exception) -> Result:
    """The result of a function that could not measure."""
    what = f"{type(error).__name__}: {error}"
    return Result(name=name, figure=name, ours=f"failed: {what}", peer="", error=what)


def machine() -> dict[str, Any]:
    """The facts that the figures depend on: processor, commit, versions."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": platform.platform(),
        "commit": _git("rev-parse", "HEAD"),
        "changed_since_commit": bool(_git("status", "--porcelain", "--untracked-files=no")),
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in _PACKAGES},
    }


def write(path: Path, found: Sequence[Result], *, short: bool) -> None:
    """Write a run as JSON."""
    text = json.dumps({"machine": machine(), "short": short, "rows": [asdict(each) for each in found]}, indent=1)
    path.write_text(text + "\n")


def read(path: Path) -> tuple[dict[str, Any], list[Result]]:
    """Machine and rows of a file of `write`. Raises ValueError for another file."""
    try:
        data = json.loads(path.read_text())
        return data["machine"], [Result(**row) for row in data["rows"]]
    except OSError as error:
        raise ValueError(f"cannot read {path}: {(error.strerror or str(error)).lower()}") from None
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path} is not a file that tools/bench --json has written") from None


def moved(before: Sequence[Result], now: Sequence[Result]) -> list[tuple[str, str, str, str]]:
    """Figures that have moved beyond their own noise: figure, value before, value now, and the change in words.

    The noise of a figure is the largest deviation of a run from the median of its runs, before and now, as a ratio.
    With one run only, the noise of a figure is not known, and the text says so.
    """
    earlier: Mapping[str, Result] = {each.name: each for each in before}
    lines = []
    for each in now:
        old = earlier.get(each.name)
        if old is None:
            lines.append((each.figure, "", _shown(each), "is new"))
        elif bool(old.error) != bool(each.error):
            lines.append((each.figure, old.ours, each.ours, "fails now" if each.error else "failed before"))
        elif old.values and each.values and (what := _change(old, each)):
            lines.append((each.figure, _shown(old), _shown(each), what))
    return lines


def _change(old: Result, new: Result) -> str:
    """The change in words; empty where a figure has not moved."""
    if old.value == new.value:
        return ""
    if not (old.value > 0 and new.value > 0 and math.isfinite(old.value) and math.isfinite(new.value)):
        return "is another one"
    change = new.value / old.value
    noise = max(_LEAST_NOISE, _spread(old), _spread(new))
    unknown = min(len(old.values), len(new.values)) < 2
    if abs(math.log(change)) <= _SIGMAS * noise:
        return ""
    by = f"{change:.2f} times as good"
    return f"{by} (one run: noise not known)" if unknown else f"{by}, noise {100 * noise:.0f} %"


def _spread(result: Result) -> float:
    """Largest deviation of a run from the median, as a logarithm of their ratio."""
    return max(abs(math.log(value / result.value)) if value > 0 else math.inf for value in result.values)


def _shown(result: Result) -> str:
    return f"{result.ours} ({result.value:.2f})"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


def _git(*words: str) -> str | None:
    folder = Path(__file__).parent
    try:
        return subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
