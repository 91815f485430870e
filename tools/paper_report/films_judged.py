"""What `aolink look` says of strangers' films (`paper_report.strangers`), against what is true of them."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aolink.errors import AolinkError
from aolink.jobs.look import Looked, look
from aolink.jobs.look_scene import LEAST_MOTION
from aolink.rig import parse_rig
from paper_report.strangers import Stranger, draw

NARROW = 0.05
"""Share of the band, from a fiftieth of the frame rate to half the rate of fast steps, below which pieces of a set are
an answer."""


@dataclass(frozen=True, kw_only=True)
class FilmRow:
    """What `look` says of one film."""

    seed: int
    text: str
    """What is true of the film."""
    motion: str
    flaw: str
    failed: str = ""
    """The error, where there was no answer."""
    moves: bool = False
    sets: list[list[list[float]]] = dataclasses.field(default_factory=list)
    """Pieces of each narrow set of a frequency, Hz."""
    holds: list[bool] = dataclasses.field(default_factory=list)
    """Whether each of these holds a true frequency."""
    models: list[str] = dataclasses.field(default_factory=list)
    kernel: float = math.nan
    """The kernel's standard deviation over the true one."""
    doubts: list[str] = dataclasses.field(default_factory=list)
    could: bool = False
    """Whether there is a right set with the true kernel given."""
    seconds: float = 0.0
    """Processor time."""


def judge_film(seed: int, *, thorough: bool, twice: bool) -> FilmRow:
    """The row of a film; ``twice``: where lines move it and no set is right, look once more with the true kernel."""
    made, start = draw(seed), time.process_time()
    row = FilmRow(seed=seed, text=made.text, motion=made.motion, flaw=made.flaw)
    try:
        looked = look(made.film, made.settings, "stranger", thorough=thorough)
    except AolinkError as error:
        row = dataclasses.replace(row, failed=str(error))
    else:
        sets = narrow_sets(looked)
        row = dataclasses.replace(
            row, moves=looked.moves, sets=sets, holds=[_holds(each, made) for each in sets],
            models=[each.found.model.name if each.found else "" for each in looked.directions],
            kernel=looked.sd / made.sd, doubts=list(looked.doubts),
        )  # fmt: skip
    row = dataclasses.replace(row, could=any(row.holds), seconds=time.process_time() - start)
    if twice and made.hz and not row.could:
        try:
            known = look(made.film, made.settings, "stranger", kernel=made.sd, thorough=thorough)
        except AolinkError:
            return row
        row = dataclasses.replace(row, could=any(_holds(each, made) for each in narrow_sets(known)))
    return row


def narrow_sets(looked: Looked) -> list[list[list[float]]]:
    """Pieces of the sets of frequencies that are narrow enough to be an answer."""
    highest = 0.5 / parse_rig(looked.text).timing.fast_step_s
    out = []
    for each in looked.directions:
        for one in each.found.parameters if each.found else ():
            if one.name.endswith("frequency_hz") and one.pieces:
                width = sum(piece.high - piece.low for piece in one.pieces)
                if width < NARROW * (highest - looked.rate_hz / 50):
                    out.append([[piece.low, piece.high] for piece in one.pieces])
    return out


def _holds(pieces: list[list[float]], made: Stranger) -> bool:
    return any(low <= hz <= high for hz in made.hz for low, high in pieces)


def judge_films(path: Path, first: int, films: int, *, thorough: bool) -> list[FilmRow]:
    """Judge films one after the other; rows that the file has already are not made again."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    rows = {row.seed: row for row in (FilmRow(**json.loads(line)) for line in lines)}
    with path.open("a", encoding="utf-8") as file:
        for seed in range(first, first + films):
            if seed not in rows:
                rows[seed] = judge_film(seed, thorough=thorough, twice=True)
                file.write(f"{json.dumps(dataclasses.asdict(rows[seed]))}\n")
                file.flush()
    return list(rows.values())


def table_of_films(rows: Sequence[FilmRow]) -> str:
    """Lines of text: how many films get a set of frequencies, and how many of these are right, with and without a
    warning."""
    given = [row for row in rows if row.sets]
    right = [row for row in given if all(row.holds)]
    wrong = [row for row in given if not all(row.holds)]
    possible = [row for row in rows if row.could]
    reached = [row for row in possible if any(row.holds)]
    still = [row for row in rows if row.motion == "nothing" and not row.failed]
    quiet = [row for row in still if not row.moves]
    kernels = np.array([row.kernel for row in rows if not row.failed])
    unwarned = [row for row in wrong if not row.doubts]
    lines = [
        f"films {len(rows)}, without an answer {sum(bool(row.failed) for row in rows)}",
        f"with a narrow set of a frequency {len(given)}: all hold the truth in {len(right)},"
        f" warned {sum(bool(row.doubts) for row in right)}",
        f"a set without the truth {len(wrong)}, of them without a warning {len(unwarned)}"
        f" (seeds {[row.seed for row in unwarned]})",
        f"of {len(possible)} in which a right set can be had with the true kernel, {len(reached)} have one",
        f"nothing moves in {len(still)}: said in {len(quiet)} (least motion spoken of {LEAST_MOTION} pixels)",
        f"kernel over the true one: median {np.median(kernels):.3f}, 90 % within"
        f" [{np.quantile(kernels, 0.05):.3f}, {np.quantile(kernels, 0.95):.3f}]",
        f"processor time: median {np.median([row.seconds for row in rows]):.0f} s,"
        f" most {max(row.seconds for row in rows):.0f} s",
    ]
    return "\n".join(lines)
