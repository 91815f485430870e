"""Tables of how good estimates are."""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import asdict
from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table

from aolink.cli.tables.json import without_nan
from aolink.estimation.score import Score, score_table


def scores(by_name: Mapping[str, Score], only: Container[str] = ()) -> Table:
    """The table of `score_table`."""
    found = score_table(by_name, only)
    counted = max((each.exposures for each in by_name.values()), default=0)
    title = f"Estimates of {counted} exposures against the truth" if counted else "No truth in this recording: NIS only"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, caption_justify="left", pad_edge=False)
    table.add_column("estimator", no_wrap=True)
    for head in found.heads:
        table.add_column(head, justify="right", no_wrap=True)
    for name, cells in found.rows.items():
        table.add_row(name, *(each if each.endswith("!") else f"{each}  " for each in cells))
    table.caption = escape("\n".join(found.notes))
    return table


def scores_as_json(by_name: Mapping[str, Score]) -> dict[str, Any]:
    """The scores as JSON, for scripts; unknown values are null."""
    return {name: without_nan(asdict(each)) for name, each in by_name.items()}
