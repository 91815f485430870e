"""What all judgements share: rows that a file keeps, so that one may be stopped and go on, and the table at the end."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

Row = dict[str, Any]
"""One judgement: ``seed``, ``what`` was judged, and its numbers."""
Line = Sequence[str]
BEYOND_95 = 1.959964
"""Standard deviations on either side of a 95 % interval."""


@dataclass(frozen=True, kw_only=True)
class Given:
    """What is asked for."""

    estimators: Sequence[str]
    runs: int
    """Independent runs of each scene."""


@dataclass(frozen=True, kw_only=True)
class Judge:
    """A judgement: its rows by seed, and its table."""

    summary: str
    rows: Callable[[int, Given], Iterable[Row]]
    table: Callable[[Sequence[Row]], tuple[Line, Iterable[Line]]]
    """Heads of the columns, and lines."""
    estimators: Sequence[str] = ("moments",)
    scenes: int = 40
    runs: int = 8


def judged(judge: Judge, seeds: Iterable[int], given: Given, file: Path | None) -> Iterator[Row]:
    """The rows of all seeds, those of the file first; a seed of which it has rows is not judged again."""
    there: list[Row] = []
    for line in file.read_text(encoding="utf-8").splitlines() if file and file.exists() else ():
        try:
            there.append(json.loads(line))
        except json.JSONDecodeError:  # it was stopped while it wrote
            break
    if file:
        file.write_text("".join(f"{json.dumps(row)}\n" for row in there), encoding="utf-8")
    yield from there
    done = {row["seed"] for row in there}
    for seed in seeds:
        if seed in done:
            continue
        made = [{"seed": seed, **_short(row)} for row in judge.rows(seed, given)]
        if file:
            with file.open("a", encoding="utf-8") as out:
                out.writelines(f"{json.dumps(row)}\n" for row in made)
        yield from made


def _short(value: Any) -> Any:
    """Numbers to six digits."""
    if isinstance(value, dict):
        return {key: _short(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_short(each) for each in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def grouped(rows: Iterable[Row], key: str = "what") -> dict[str, list[Row]]:
    """Rows by one of their values."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(str(row[key]), []).append(row)
    return found


def printed(heads: Line, lines: Iterable[Line]) -> None:
    """Print a table."""
    table = Table(*heads)
    for line in lines:
        table.add_row(*line)
    Console(width=150).print(table)


def mean(values: Sequence[float]) -> str:
    """A mean to two digits, or - of nothing."""
    return f"{np.mean(values):.2f}" if len(values) else "-"


def ratio(squares: Sequence[tuple[Sequence[float], Sequence[float]]]) -> str:
    """The root of the mean ratio of mean squared errors over scenes, with its 95 % interval by bootstrap over them."""
    each = np.array([np.mean(ours) / np.mean(theirs) for ours, theirs in squares])
    if not len(each):
        return "-"
    samples = np.sqrt(each[np.random.default_rng(0).integers(0, len(each), (1000, len(each)))].mean(axis=1))
    low, high = np.quantile(samples, [0.025, 0.975])
    return f"{math.sqrt(each.mean()):.2f} [{low:.2f}, {high:.2f}]"
