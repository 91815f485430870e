"""Tables of identified models, for people."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from rich import box
from rich.table import Table

from aolink.identification import UNITS, Identified

if TYPE_CHECKING:
    from aolink.jobs.identify import IdentifiedModel


def found(one: IdentifiedModel) -> Iterator[Table]:
    """The prediction scores of the models, where several were tried; and the parameters of the chosen one."""
    if one.tried:
        best = max(each.score for each in one.tried)
        table = Table(
            "model", "parameters", "below the best, nats", box=box.SIMPLE, title=f"{one.output}: cross-validated"
        )
        for each in sorted(one.tried, key=lambda each: -each.score):
            table.add_row(each.name, str(each.parameters), f"{best - each.score:.1f}")
        yield table
    name = "+".join(part for part in (one.plant.kind + " plant" if one.plant else "", one.model.name) if part)
    title = f"{one.output}: {name}, {one.exposures} exposures"
    table = Table("parameter", "value", "unit", "95 % set", box=box.SIMPLE, title=title)
    for parameter in one.parameters:
        unit = UNITS.get(parameter.name.split(".")[-1], "")
        table.add_row(parameter.name, f"{parameter.best:.4g}", unit, set_text(parameter))
    yield table


def set_text(parameter: Identified) -> str:
    """The pieces of a set, such as ``11.9 to 12; 13 to 13.1``; an open end has a sign."""
    return (
        "none: contradiction"
        if not parameter.pieces
        else "; ".join(
            f"{'<' if piece.open_low else ''}{piece.low:.4g} to {'>' if piece.open_high else ''}{piece.high:.4g}"
            for piece in parameter.pieces
        )
    )
