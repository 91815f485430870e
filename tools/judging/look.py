"""What `aolink look` says of films that are drawn as strangers take them, against what is true of them."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from aolink.errors import AolinkError
from aolink.jobs.look import GRADES, Looked, look
from judging.films import Stranger, draw
from judging.rows import Given, Judge, Line, Row, grouped

_NEAR = 5e-4
"""A set may end so much of a frequency beside the true one: films are drawn with instants in their exposures."""


def rows(seed: int, given: Given) -> Iterator[Row]:
    """The row of a film: the grade, and whether the sets of the frequencies hold true ones."""
    made, start = draw(seed), time.process_time()
    row: Row = {"what": made.motion, "scene": made.text, "flaw": made.flaw}
    try:
        looked = look(made.film, made.settings, "stranger")
    except AolinkError as error:
        row |= {"failed": str(error), "grade": 2, "right": None, "kernel": None}
    else:
        answer = looked.grade < len(GRADES) - 1 and bool(looked.found.lines)
        row |= {
            "failed": "", "grade": looked.grade, "right": _right(looked, made) if answer else None,
            "kernel": looked.sd / made.sd,
        }  # fmt: skip
    yield row | {"seconds": time.process_time() - start}


def _right(looked: Looked, made: Stranger) -> bool:
    """Whether each set holds a true frequency, harmonics aside."""
    sets = [each for each, n in zip(looked.found.sets, looked.harmonics, strict=True) if n == 1]
    return all(
        any(part.low - _NEAR * hz <= hz <= part.high + _NEAR * hz for part in each for hz in made.hz) for each in sets
    )


def table(rows: Sequence[Row]) -> tuple[Line, Iterable[Line]]:
    """A line for each kind of motion: answers by grade, right and wrong."""
    heads = (
        "motion", "films", "believed: right", "wrong", "frequency only: right", "wrong", "no answer",
        "kernel: 5 to 95 %", "s",
    )  # fmt: skip
    by_motion = grouped(rows)
    return heads, [_line(*each) for each in [*by_motion.items(), ("all", rows)]]


def _line(motion: str, rows: Sequence[Row]) -> Line:
    counts = [
        str(sum(row["grade"] == grade and row["right"] is right for row in rows))
        for grade in (0, 1)
        for right in (True, False)
    ]
    kernels = [row["kernel"] for row in rows if row["kernel"] is not None]
    low, high = np.quantile(kernels, [0.05, 0.95]) if kernels else (0.0, 0.0)
    return (
        motion, str(len(rows)), *counts, str(sum(row["right"] is None for row in rows)), f"{low:.2f} to {high:.2f}",
        f"{np.median([row['seconds'] for row in rows]):.1f}",
    )  # fmt: skip


LOOK = Judge(summary="`aolink look` on films as strangers take them", rows=rows, table=table, scenes=60)
