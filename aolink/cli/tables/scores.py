"""Tables of how good estimates are."""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Mapping
from dataclasses import asdict
from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table

from aolink.cli.tables.json import without_nan
from aolink.estimation.score import Consistency, Score

_MOST_REASONS = 3
"""How many reasons of one estimator the table shows."""


def scores(by_name: Mapping[str, Score], only: Container[str] = ()) -> Table:
    """RMSE against truth, NIS and NEES with their 95 % bounds; a mean outside its bounds is marked.

    Where any exposure was gated, a column says how many. ``only`` names the columns, all by default.
    """
    counted = max((each.exposures for each in by_name.values()), default=0)
    title = f"Estimates of {counted} exposures against the truth" if counted else "No truth in this recording: NIS only"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, caption_justify="left", pad_edge=False)
    table.add_column("estimator", no_wrap=True)
    columns: dict[str, Callable[[Score], str]] = {"NIS": lambda each: _consistency(each.nis)}
    if counted:
        columns = {
            "RMSE start": lambda each: _rmse(each.start_rmse), "RMSE end": lambda each: _rmse(each.end_rmse),
            "RMSE path": lambda each: _rmse(each.path_rmse), **columns,
            "NEES start": lambda each: _consistency(each.start_nees),
            "NEES end": lambda each: _consistency(each.end_nees),
        }  # fmt: skip
    if any(each.gated for each in by_name.values()):
        columns["gated"] = lambda each: f"{each.gated}  "
    columns = {name: column for name, column in columns.items() if not only or name in only}
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    for name, each in by_name.items():
        table.add_row(name, *(column(each) for column in columns.values()))
    lines = unused_lines(by_name)
    if bounds := _bounds(by_name):
        of_states = "RMSE start" in columns and any(math.isfinite(each.start_rmse) for each in by_name.values())
        norm = "RMSE of states: norm over the states. " if of_states else ""
        lines = [f"{norm}! outside the 95 % bounds of a consistent filter:", bounds, *lines]
    table.caption = escape("\n".join(lines))
    return table


def unused_lines(by_name: Mapping[str, Score]) -> list[str]:
    """The number of exposures that each estimator could not use, and why, in words; empty where every estimator used
    all."""
    lines = []
    for name, each in by_name.items():
        lines += [f"{name}: {unused.text(each.estimated)}" for unused in each.unused[:_MOST_REASONS]]
        more = len(each.unused) - _MOST_REASONS
        if more > 0:
            lines.append(f"{name}: and {more} other reasons, which --json has")
    return lines


def _rmse(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4f}"


def _consistency(value: Consistency) -> str:
    return "-  " if math.isnan(value.mean) else f"{value.mean:.2f}{'  ' if value.inside else ' !'}"


def _bounds(by_name: Mapping[str, Score]) -> str:
    """NEES and NIS bounds; those of NIS depend on how many moments an estimator takes."""
    nis: dict[str, list[str]] = {}
    for name, each in by_name.items():
        if not math.isnan(each.nis.mean):
            nis.setdefault(f"{each.nis.low:.2f} to {each.nis.high:.2f}", []).append(name)
    parts = [f"NIS {bounds} for {', '.join(names)}" for bounds, names in nis.items()]
    nees = next((each.end_nees for each in by_name.values() if not math.isnan(each.end_nees.mean)), None)
    if nees:
        parts.insert(0, f"NEES {nees.low:.2f} to {nees.high:.2f}")
    return "; ".join(parts)


def scores_as_json(by_name: Mapping[str, Score]) -> dict[str, Any]:
    """The scores as JSON, for scripts; unknown values are null."""
    return {name: without_nan(asdict(each)) for name, each in by_name.items()}
