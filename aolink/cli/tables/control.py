"""Tables about what a controller would have commanded in a recorded session."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rich.table import Table

from aolink.cli.tables.json import without_nan

if TYPE_CHECKING:
    from aolink.jobs.closed_loop import Replayed


def replayed_as_json(result: Replayed) -> dict[str, Any]:
    """The content of `replayed` as JSON, for scripts."""
    return dict(without_nan(asdict(result)))


def replayed(result: Replayed) -> Table:
    """The commands of a controller in a recorded session, and the slopes that it would have left."""
    table = Table(box=None, show_header=False, pad_edge=False)
    served = f" with {result.estimator}" if result.estimator else ""
    table.add_row("controller", f"{result.controller}{served}: {result.stability}")
    table.add_row(
        "commands",
        f"{result.exposures} exposures, the loop open for {result.open_exposures}; it would have commanded inputs of"
        f" {result.input_rms:.4g} rms, which differ by {result.difference_rms:.4g} rms from what the mirror held",
    )
    if result.seed is None:
        table.add_row("residual", "the slopes that it would have left are unknown: the rig is not simulated")
    else:
        table.add_row(
            "residual",
            f"slopes at the fast rate, rms: {result.recorded_rms:.4g} in the recording; from the same seed"
            f" {result.open_rms:.4g} with the loop open, {result.closed_rms:.4g} with it closed",
        )
    return table
