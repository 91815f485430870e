"""What `aolink look` says of films that are drawn as strangers take them, against what is true of them."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from aolink.errors import AolinkError
from aolink.jobs.look import Looked, look
from aolink.rig import parse_rig
from judging.films import Stranger, draw
from judging.rows import Given, Judge, Line, Row, grouped

NARROW = 0.05
"""Share of the band, from a fiftieth of the frame rate to half the rate of fast steps, below which pieces of a set are
an answer."""


def rows(seed: int, given: Given) -> Iterator[Row]:
    """The row of a film: narrow sets of a frequency, whether each holds a true one, and the doubts; where lines move it
    and no set is right, whether one can be had with the true kernel."""
    made, start = draw(seed), time.process_time()
    row: Row = {"what": made.motion, "scene": made.text, "flaw": made.flaw}
    try:
        looked = look(made.film, made.settings, "stranger")
    except AolinkError as error:
        row |= {"failed": str(error), "moves": False, "holds": [], "kernel": None, "doubts": []}
    else:
        row |= {
            "failed": "", "moves": looked.moves, "holds": _holds(looked, made), "kernel": looked.sd / made.sd,
            "doubts": list(looked.doubts),
        }  # fmt: skip
    row |= {"seconds": time.process_time() - start, "could": any(row["holds"])}
    if made.hz and not row["could"]:
        try:
            row["could"] = any(_holds(look(made.film, made.settings, "stranger", kernel=made.sd), made))
        except AolinkError:
            row["could"] = False
    yield row


def _holds(looked: Looked, made: Stranger) -> list[bool]:
    """Whether each set of a frequency that is narrow enough to be an answer holds a true one."""
    highest, found = 0.5 / parse_rig(looked.text).timing.fast_step_s, []
    for each in looked.directions:
        for one in each.found.parameters if each.found else ():
            if one.name.endswith("frequency_hz") and one.pieces:
                width = sum(piece.high - piece.low for piece in one.pieces)
                if width < NARROW * (highest - looked.rate_hz / 50):
                    found.append(any(piece.low <= hz <= piece.high for hz in made.hz for piece in one.pieces))
    return found


def table(rows: Sequence[Row]) -> tuple[Line, Iterable[Line]]:
    """A line for each kind of motion: films with right and wrong answers, and with a warning beside them."""
    heads = (
        "motion", "films", "no answer", "sets all right", "doubted", "a set is wrong", "without a doubt",
        "right of possible", "nothing moves", "kernel: 5 to 95 %", "s",
    )  # fmt: skip
    by_motion = grouped(rows)
    return heads, [_line(*each) for each in [*by_motion.items(), ("all", rows)]]


def _line(motion: str, rows: Sequence[Row]) -> Line:
    right = [row for row in rows if row["holds"] and all(row["holds"])]
    wrong = [row for row in rows if not all(row["holds"])]
    possible = [row for row in rows if row["could"]]
    kernels = [row["kernel"] for row in rows if row["kernel"] is not None]
    low, high = np.quantile(kernels, [0.05, 0.95]) if kernels else (0.0, 0.0)
    return (
        motion, str(len(rows)), str(sum(bool(row["failed"]) for row in rows)), str(len(right)),
        str(sum(bool(row["doubts"]) for row in right)), str(len(wrong)),
        str(sum(not row["doubts"] for row in wrong)),
        f"{sum(any(row['holds']) for row in possible)} of {len(possible)}",
        str(sum(not (row["moves"] or row["failed"]) for row in rows)), f"{low:.2f} to {high:.2f}",
        f"{np.median([row['seconds'] for row in rows]):.0f}",
    )  # fmt: skip


LOOK = Judge(summary="`aolink look` on films as strangers take them", rows=rows, table=table, scenes=60)
