"""What `aolink look` says of lines and edges in films that are exposed row by row, against what is true of them."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from aolink.errors import AolinkError
from aolink.jobs.look import GRADES, Looked, look
from judging.films import RowFilm, draw_rows
from judging.rows import Given, Judge, Line, Row, grouped

_CLOSE = 1e-3
"""Share of a frequency that it may be off."""
_SHARED = {8: (900.0,), 9: (1080.0,)}
"""Last digits of seeds whose films have a tone at a multiple of the frame rate."""


def rows(seed: int, given: Given) -> Iterator[Row]:
    """The row of a film: the frequency's error, whether its set holds it, and the path's error over its bound."""
    made, start = draw_rows(seed, hz=_SHARED.get(seed % 10, ())), time.process_time()
    what = "a multiple of the rate" if seed % 10 in _SHARED else made.kind
    row: Row = {
        "what": what, "hz": made.hz[0], "readout": made.row_time_s * len(made.rest), "exposure": made.exposure_s,
        "amplitude": abs(made.amplitudes[0]), "off": None, "held": False, "alias": None, "path": None, "grade": 2,
    }  # fmt: skip
    try:
        looked = look(made.film(np.random.default_rng([72, seed])), made.settings, "rows")
    except AolinkError as error:
        row["failed"] = str(error)
    else:
        row["seconds"] = time.process_time() - start
        row["grade"] = looked.grade
        if looked.rows is not None and looked.found.lines:
            hz, parts = looked.found.lines[0].hz, looked.found.sets[0]
            row["off"] = hz / made.hz[0] - 1
            row["held"] = any(part.low <= made.hz[0] <= part.high for part in parts)
            near = any(abs(part.best / made.hz[0] - 1) < _CLOSE for part in parts)
            row["alias"] = not near  # a wrong frequency without the right one beside it
            row["path"], row["least"] = _path_error(looked, made), bounds(made)
    yield row


def _path_error(looked: Looked, made: RowFilm) -> float:
    """Root mean square of the path's error over the film, pixels."""
    t = np.linspace(0, made.frames / made.rate_hz, 20_000)
    true = sum((a * np.exp(2j * np.pi * f * t)).real for a, f in zip(made.amplitudes, made.hz, strict=True))
    return float(np.sqrt(np.mean((looked.path(t)[:, 0] - true) ** 2)))


def bounds(made: RowFilm) -> tuple[float, float]:
    """Cramer and Rao's bound of that with the frequency known, and with it unknown: row time and profile known,
    amplitude and places at rest (a parabola along the rows) not."""
    step, along, (a,), (hz,) = 1e-3, np.linspace(-1, 1, len(made.rest)), made.amplitudes, made.hz
    clean = made.clean()
    moved = [replace(made, hz=(hz + step,))]
    moved += [replace(made, amplitudes=(a + step * each,)) for each in (1, 1j)]
    moved += [replace(made, rest=made.rest + step * along**n) for n in range(3)]
    J = np.stack([(each.clean() - clean).ravel() / step for each in moved])
    t = np.linspace(0, made.frames / made.rate_hz, 20_000)
    turn = np.exp(2j * np.pi * hz * t)
    path = np.stack([(2j * np.pi * t * a * turn).real, turn.real, -turn.imag])
    found = []
    for first in (1, 0):
        covariance = np.linalg.inv(J[first:] @ J[first:].T / made.noise**2)[: 3 - first, : 3 - first]
        found.append(math.sqrt(float(np.einsum("it,ij,jt->t", path[first:], covariance, path[first:]).mean())))
    return found[0], found[1]


def table(rows: Sequence[Row]) -> tuple[Line, Iterable[Line]]:
    """A line for each kind of target."""
    heads = (
        "target",
        "films",
        "within .1 %",
        "set holds it",
        "wrong alias",
        "path over bound",
        "with the frequency unknown",
        *GRADES,
        "s",
    )
    return heads, [_line(*each) for each in [*grouped(rows).items(), ("all", rows)]]


def _line(what: str, rows: Sequence[Row]) -> Line:
    n = len(rows)
    near = sum(row["off"] is not None and abs(row["off"]) < _CLOSE for row in rows)
    right = [row for row in rows if row["alias"] is False]
    paths = [math.sqrt(np.mean([(row["path"] / row["least"][n]) ** 2 for row in right])) for n in (0, 1) if right]
    return (
        what, str(n), f"{near / n:.3f}", f"{sum(row['held'] for row in rows) / n:.3f}",
        str(sum(row["alias"] is True for row in rows)), *(f"{each:.2f}" for each in paths or (math.nan, math.nan)),
        *(str(sum(row["grade"] == grade for row in rows)) for grade in range(3)),
        f"{np.median([row.get('seconds', 0.0) for row in rows]):.1f}",
    )  # fmt: skip


ROWS = Judge(summary="`aolink look` on lines and edges that are exposed row by row", rows=rows, table=table, scenes=60)
