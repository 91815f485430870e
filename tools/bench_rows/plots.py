"""Curves of an exposure's cost against the sizes that it depends on, on one page, and their slopes."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aolink.rig import Rig, load_rig, parse_rig
from bench_rows.row import Effort, median_s, timed


@dataclass(frozen=True)
class Curve:
    """A cost at several sizes."""

    what: str
    """The size, with its unit."""
    cost: str
    """The cost, with its unit."""
    sizes: list[float]
    costs: list[float]

    @property
    def slope(self) -> float:
        """Exponent of the cost as a power of the size, in the larger half of the sizes: the slope of the logarithms."""
        half = len(self.sizes) // 2
        x, y = np.log(self.sizes[half:]), np.log(self.costs[half:])
        return float(np.polyfit(x, y, 1)[0])

    def __str__(self) -> str:
        low, high = self.costs[0], self.costs[-1]
        return (
            f"{self.cost} against {self.what}, {self.sizes[0]:g} to {self.sizes[-1]:g}: {low:.3g} to {high:.3g};"
            f" grows with the power {self.slope:.2f} in the larger half"
        )


def _step_ms(rig: Rig, estimator: str, effort: Effort) -> float:
    """Median time of an exposure in an estimator, ms."""
    from aolink.estimation import make_estimator
    from aolink.simulation.model import simulate

    runs = effort.of(25, 3)
    exposures, estimate = iter(simulate(rig, 1 + runs, seed=1)), make_estimator(rig, estimator)
    estimate.step(next(exposures))
    return 1e3 * median_s(lambda: estimate.step(next(exposures)), runs)[0]


def _against(
    what: str, name: str, sizes: list[int], change: Callable[[str, int], str], estimator: str, effort: Effort
) -> Curve:
    text = load_rig(name).toml
    costs = [_step_ms(parse_rig(change(text, size)), estimator, effort) for size in sizes]
    return Curve(what, f"an exposure in {estimator} (ms)", [float(size) for size in sizes], costs)


def _replaced(text: str, old: str, new: str) -> str:
    if old not in text:
        raise ValueError(f"the rig file has no {old!r} any more")
    return text.replace(old, new)


def curves(effort: Effort) -> list[Curve]:
    """All curves, measured."""
    squares = [side * side for side in (1, 2, 4, 7, 12, 20, 30, 40, 50)]

    def grid(text: str, spots: int) -> str:
        text = _replaced(_replaced(text, "axes = 32", f"axes = {2 * spots}"), "[24, 24]", "[16, 16]")
        return _replaced(text, "[4, 4]", f"[{math.isqrt(spots)}, {math.isqrt(spots)}]").replace("block_steps", "#")

    def steps(text: str, count: int) -> str:
        return _replaced(text, "exposure_steps = 200", f"exposure_steps = {count}")

    def pixels(text: str, count: int) -> str:
        return _replaced(text, "pixels = 40", f"pixels = {count}")

    found = [_against("lenslets", "sh-4x4", squares, grid, "o3", effort)]
    for estimator in ("o3", "moments"):
        found += [
            _against("fast steps", "section-vi-lively", [50, 100, 200, 400, 700, 1000], steps, estimator, effort),
            _against("pixels of a line", "section-vi-lively", [20, 40, 80, 160, 320], pixels, estimator, effort),
        ]
    return [*found, _length(effort), _rate(effort)]


def _length(effort: Effort) -> Curve:
    """The time to estimate a recording again, against its length."""
    from aolink.recording.reader import Recording
    from aolink.recording.reestimate import reestimate
    from bench_rows.recording import record_long

    sizes, costs = [effort.of(n, n // 50) for n in (200, 500, 1000, 2000, 5000, 10_000)], []
    with tempfile.TemporaryDirectory() as name:
        for size in sizes:
            record_long(path := Path(name) / f"{size}.mcap", size)
            costs.append(timed(lambda path=path: reestimate(Recording(path), ["o3"])))  # type: ignore[misc]
    return Curve("exposures of a recording", "estimating it again with o3 (s)", [float(n) for n in sizes], costs)


def _rate(effort: Effort) -> Curve:
    """The time for a second of data, against the number of exposures that its fast steps are divided into."""
    rates, text = [1, 2, 5, 10, 20, 50], load_rig("section-vi-lively").toml
    costs = []
    for rate in rates:
        rig = parse_rig(_replaced(text, "exposure_steps = 200", f"exposure_steps = {1000 // rate}"))
        costs.append(rate * _step_ms(rig, "o3", effort))
    return Curve("exposures a second", "a second of data in o3 (ms)", [float(rate) for rate in rates], costs)


def draw(found: list[Curve], folder: Path) -> Path:
    """One page with all curves, in doubly logarithmic axes."""
    from matplotlib.figure import Figure

    columns = 3
    rows = -(-len(found) // columns)
    figure = Figure(figsize=(4 * columns, 3.2 * rows), layout="constrained")
    for k, curve in enumerate(found):
        axes = figure.add_subplot(rows, columns, k + 1)
        axes.loglog(curve.sizes, curve.costs, "o-")
        axes.set(xlabel=curve.what, ylabel=curve.cost, title=f"power {curve.slope:.2f} in the larger half")
        axes.grid(True, which="both", alpha=0.3)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(path := folder / "cost.svg")
    return path
