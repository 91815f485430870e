"""The evaluation of the judgement's rows: quantiles over the family, and whether its goals are held."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from judging.sampled import NAME as LIMIT
from numpy.typing import NDArray
from scipy import stats

from aolink.numerics.arrays import FloatArray
from paper_report.blocks import Block, Heading, PageFigure, Points, Table, Text
from paper_report.ensemble import IntervalEstimate, measured
from paper_report.family import SEEDS
from paper_report.judge import NAMES, Row

Rows = Mapping[str, Mapping[int, Row]]
"""Rows by estimator and seed."""

JUDGED = ("moments", "profile")
REFERENCES = ("o1", "open-loop")
NEAR_LIMIT = (1.05, 1.15)
"""Largest ratio of profile's path RMSE to sampled's, in the median and at the 95th percentile."""
MEDIAN_INSIDE = (0.93, 0.97)
SCENE_INSIDE = (0.90, 0.99)
SHARE_INSIDE = 0.95
"""Share of the scenes whose coverage is to be within ``SCENE_INSIDE``."""
SHARE_NEES = 0.90
MOST_RATIO = 1.02
"""Upper bound of the family's ratio to a reference."""
_RESAMPLES = 1000
_LIMIT_INSIDE = 0.8
"""Coverage of sampled's own intervals below which its particles were too few for a scene, so that it is not the limit
there."""
_FEWEST_SCENES = 20
"""Fewest scenes with which a goal counts as held: a 95th percentile of fewer is the largest of them."""
_FEWEST_RUNS = 4
"""Fewest runs for a statement about a single scene."""


def by_estimator(rows: Sequence[Row]) -> Rows:
    """The rows, sorted."""
    found: dict[str, dict[int, Row]] = {name: {} for name in NAMES}
    for row in rows:
        found[row.estimator][row.seed] = row
    return found


def squares(rows: Rows, name: str, reference: str) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Mean squared errors of the path by seed, (runs,), of the runs that both have."""
    pairs = {}
    for seed in sorted(rows[name].keys() & rows[reference].keys()):
        one, other = np.array(rows[name][seed].path), np.array(rows[reference][seed].path)
        runs = min(len(one), len(other))
        pairs[seed] = one[:runs], other[:runs]
    return pairs


def ratios(rows: Rows, name: str, reference: str) -> dict[int, float]:
    """Ratio of the path's RMSE to a reference's by seed; scenes in which `sampled` is not the limit are left out of its
    ratios."""
    pairs = squares(rows, name, reference)
    if reference == LIMIT:
        pairs = {seed: each for seed, each in pairs.items() if np.mean(rows[LIMIT][seed].inside) >= _LIMIT_INSIDE}
    return {seed: math.sqrt(a.mean() / b.mean()) for seed, (a, b) in pairs.items()}


def family_ratio(rows: Rows, name: str, reference: str) -> IntervalEstimate | None:
    """The ratio over the family, the root of the scenes' mean squared ratio, by bootstrap over scenes and over the runs
    of each; None without scenes."""
    pairs = list(squares(rows, name, reference).values())
    if not pairs:
        return None
    rng = np.random.default_rng(0)
    each = np.empty((len(pairs), _RESAMPLES))
    for k, (a, b) in enumerate(pairs):
        chosen = rng.integers(0, len(a), (_RESAMPLES, len(a)))
        each[k] = a[chosen].mean(axis=1) / b[chosen].mean(axis=1)
    scenes = rng.integers(0, len(pairs), (_RESAMPLES, len(pairs)))
    samples = np.sqrt(each[scenes, np.arange(_RESAMPLES)[:, None]].mean(axis=1))
    return measured(math.sqrt(np.mean([a.mean() / b.mean() for a, b in pairs])), samples)


def significantly_worse(rows: Rows, name: str, reference: str, level: float = 0.05) -> list[int]:
    """Seeds of scenes with a larger error than the reference's: t-tests of the pairs, with Holm's correction.

    Holm, A simple sequentially rejective multiple test procedure, Scand. J. Stat. 6 (1979).
    """
    tested = {}
    for seed, (a, b) in squares(rows, name, reference).items():
        if len(a) >= _FEWEST_RUNS:
            difference = a - b
            se = difference.std(ddof=1) / math.sqrt(len(a))
            tested[seed] = float(stats.t.sf(difference.mean() / se, len(a) - 1)) if se > 0 else 1.0
    worse: list[int] = []
    for seed in sorted(tested, key=lambda each: tested[each]):
        if tested[seed] > level / (len(tested) - len(worse)):
            break
        worse.append(seed)
    return worse


def nees_inside(row: Row) -> bool:
    """Whether the 95 % bounds of a scene's mean NEES, over its runs, have the number of states inside.

    They are Student's. A bootstrap's percentiles are too near each other where runs are few: of four, ten and 24 runs
    they have `open-loop`, whose covariance is exact, inside in 78 %, 91 % and 100 % of planes, these in 91 %, 94 % and
    100 %.
    """
    nees = np.array(row.nees)
    se = nees.std(ddof=1) / math.sqrt(len(nees))
    return bool(abs(nees.mean() - row.states) <= stats.t.ppf(0.975, len(nees) - 1) * se)


def told_of_nees(row: Row) -> bool:
    """Whether there are enough runs for a statement about the NEES."""
    return len(row.nees) >= _FEWEST_RUNS


def share_of_nees(rows: Sequence[Row]) -> float:
    """Share of scenes with `nees_inside` among those with enough runs; NaN if there is none."""
    inside = [nees_inside(row) for row in rows if told_of_nees(row)]
    return float(np.mean(inside)) if inside else math.nan


@dataclass(frozen=True)
class Goal:
    """A goal beside what was measured."""

    text: str
    measured: str
    held: bool
    scenes: int

    @property
    def verdict(self) -> str:
        """Whether the goal is held, and in how many scenes; with few scenes only a goal that is not held is stated."""
        if self.held and self.scenes < _FEWEST_SCENES:
            return f"too few scenes to tell ({self.scenes})"
        return f"{'held' if self.held else 'not held'} ({self.scenes} scenes)"


def goals(rows: Rows) -> list[Goal]:
    """All goals for which there are rows."""
    found: list[Goal] = []
    to_limit = list(ratios(rows, "profile", "sampled").values())
    if to_limit:
        median, high = np.quantile(to_limit, [0.5, 0.95])
        text = f"profile's path RMSE over sampled's at most {NEAR_LIMIT[0]:g} in the median and {NEAR_LIMIT[1]:g} at"
        within = bool(median <= NEAR_LIMIT[0] and high <= NEAR_LIMIT[1])
        found.append(Goal(f"{text} the 95th percentile", f"{median:.3f} and {high:.3f}", within, len(to_limit)))
    for name in (each for each in JUDGED if rows[each]):
        judged = list(rows[name].values())
        inside = np.array([np.mean(row.inside) for row in judged])
        median, share = float(np.median(inside)), float(np.mean(_within(inside, SCENE_INSIDE)))
        text = f"{name}: coverage of 95 % intervals {_span(MEDIAN_INSIDE)} in the median, {_span(SCENE_INSIDE)} in"
        within = bool(_within(median, MEDIAN_INSIDE) and share >= SHARE_INSIDE)
        found.append(Goal(f"{text} {SHARE_INSIDE:.0%} of scenes", f"{median:.3f}, {share:.0%}", within, len(judged)))
        share = share_of_nees(judged)
        if math.isfinite(share):
            text = f"{name}: end NEES inside its bounds in {SHARE_NEES:.0%} of scenes"
            found.append(Goal(text, f"{share:.0%}", share >= SHARE_NEES, sum(map(told_of_nees, judged))))
        for reference in REFERENCES:
            bound = family_ratio(rows, name, reference)
            if bound is not None:
                worse, pairs = significantly_worse(rows, name, reference), squares(rows, name, reference)
                text = f"{name} over {reference}: upper bound at most {MOST_RATIO:g}, no scene significantly worse"
                which = f" ({', '.join(map(str, worse[:8]))})" if worse else ""
                within = bound.high <= MOST_RATIO and not worse
                found.append(Goal(text, f"{bound.interval}, {len(worse)} scenes{which}", within, len(pairs)))
    return found


def _within(values: FloatArray | float, ends: tuple[float, float]) -> NDArray[np.bool_]:
    return np.asarray((values >= np.array(ends[0])) & (values <= np.array(ends[1])))


def _span(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.2f} to {ends[1]:.2f}"


def family_section(given: Sequence[Row], picture: PageFigure | None = None) -> list[Block]:
    """Quantiles over the family, the picture, and the goals."""
    rows = by_estimator(given)
    reporting = [row.seed in SEEDS["reporting"] for row in given]
    seeds = "reporting" if all(reporting) else "tuning" if not any(reporting) else "both tuning and reporting"
    table = [_quantiles(rows, name) for name in NAMES if rows[name]]
    return [
        Heading("A family of plants that nobody tuned for"),
        Text(
            "Scenes drawn by seed (tools/paper_report/family.py): one to three modes, a line of pixels, a spot on a"
            " plane or both axes of one plant, commands, dead time, lost frames, masked pixels. Seeds from"
            f" {SEEDS['tuning'][0]} on are for tuning, from {SEEDS['reporting'][0]} on for reporting; these rows are"
            f" of {seeds} seeds. Slow estimators are judged on fewer scenes and runs, paired with the others on the"
            " same frames. Ratios are of the path's RMSE: to sampled's in each scene where its own"
            f" intervals hold {_LIMIT_INSIDE:.0%} of the path at least, and over the family, the root of"
            " the scenes' mean squared ratio with the 95 % interval of a bootstrap over scenes and runs. In brackets"
            " are scenes that are significantly worse (t-tests over runs, Holm's correction, 5 %). Coverage is the"
            " share of the path inside its 95 % intervals; open-loop, whose covariance is exact, shows what chance"
            f" does to a criterion.{_made_by(given)}"
        ),
        Table(
            [
                "estimator", "scenes", "exposures in a scene", "over sampled: median", "95 %", "coverage: 5 %",
                "median", "95 %", f"scenes in {_span(SCENE_INSIDE)}", "NEES inside", "over o1", "over open-loop",
                "ms",
            ],
            table,
        ),
        *([picture] if picture else []),
        Points([f"{goal.text}: {goal.measured}: {goal.verdict}" for goal in goals(rows)]),
    ]  # fmt: skip


def _made_by(rows: Sequence[Row]) -> str:
    """The commits that made the rows, in words."""
    counts = Counter(row.commit for row in rows if row.commit)
    by = [f"{number} by commit {commit}" for commit, number in counts.items()]
    return f" Rows as recorded: {', '.join(by)}." if by else ""


def _quantiles(rows: Rows, name: str) -> list[str]:
    judged = list(rows[name].values())
    inside = np.array([np.mean(row.inside) for row in judged])
    limit = list(ratios(rows, name, "sampled").values()) if name != "sampled" else []
    to_limit = [f"{x:.3f}" for x in np.quantile(limit, [0.5, 0.95])] if limit else ["-", "-"]
    over, nees = [], share_of_nees(judged)
    for reference in REFERENCES:
        bound = family_ratio(rows, name, reference) if name != reference else None
        over.append("-" if bound is None else f"{bound.interval} ({len(significantly_worse(rows, name, reference))})")
    return [
        name, str(len(judged)), f"{np.median([row.scored for row in judged]):.0f}", *to_limit,
        *(f"{x:.3f}" for x in np.quantile(inside, [0.05, 0.5, 0.95])),
        f"{np.mean(_within(inside, SCENE_INSIDE)):.0%}", "-" if math.isnan(nees) else f"{nees:.0%}", *over,
        f"{1e3 * np.median([row.seconds for row in judged]):.2g}",
    ]  # fmt: skip
