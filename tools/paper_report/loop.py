"""The benefit of closing the loop: residual slopes over those of the best integrator."""

from __future__ import annotations

from collections.abc import Sequence

from bench_rows import loop_worth as worth
from bench_rows.loop_worth import FROM_PATH, Measured

from paper_report.blocks import Block, Heading, Table, Text

_GROUPS = (worth.HEADLINE, worth.TURBULENCE_AND_VIBRATION, worth.TURBULENCE, worth.VIBRATION, worth.FACTORS)
_COLUMNS = (
    "ar_kalman", "least_squares", "o1", "moments", "profile", "identified o1", "identified profile", FROM_PATH,
    "true state",
)  # fmt: skip


def loop_cells(quick: bool) -> list[Measured]:
    """All cells, or one of each group and little of it."""
    return [each for group in _GROUPS for each in worth.all_measured(group, quick)]


def loop_section(cells: Sequence[Measured]) -> list[Block]:
    """A table of all cells, and the goals that were set before, with the results."""
    seeds = len(next(iter(cells[0].rms.values())))
    rows = [
        [str(each.cell), *(str(each.ratio(name)) if name in each.rms else "-" for name in _COLUMNS),
         each.best.removeprefix("integrator ")]
        for each in cells
    ]  # fmt: skip
    goals = [
        [f"{each.cell}: {goal.name} over {goal.over or 'the best integrator'}", f"below {goal.limit:g}",
         str(each.ratio(goal.name, goal.over)), "yes" if each.reaches(goal) else "no"]
        for each in cells for goal in each.goals
    ]  # fmt: skip
    return [
        Heading("What closing the loop is worth"),
        Text(
            "Not the paper's: the rig loop with its mirror, disturbed by tilt of two von Karman layers (5 and 11 m/s"
            " over 0.5 m), by a vibration of damping 0.002 at so many times the frame rate, or by both with equal sd;"
            " if not said otherwise the path's sd is 1.5 times the kernel's, an exposure has 50 fast steps of 1 ms, and"
            " the noise of a centroid is 2 % of the path's sd. Residual slopes at the fast rate, rms, over those of the"
            f" integrator whose gain is the best for these seeds: mean over {seeds} seeds, in brackets the one-sided"
            " 95 % bound. o1, moments and profile serve lqg with the true model of the vibration, and of turbulence"
            " with one that is fitted to its true slopes before; identified means with a model from the blurred frames"
            f" before alone; {FROM_PATH} has a model of the same kinds that is fitted to the true slopes of these"
            " frames, and so bounds identification. ar_kalman and least_squares are pyRTC's predictors, fitted to the"
            " centroids of the same frames. true state is lqg given the disturbance itself up to the end of each"
            " exposure, by an autoregressive model of order 64 of turbulence: what bounds all of them, as far"
            " as that model goes."
        ),
        Table(["disturbance", *_COLUMNS, "gain"], rows),
        Text("The goals, each to be kept by the bound:"),
        Table(["ratio", "goal", "found", "reached"], goals),
    ]
