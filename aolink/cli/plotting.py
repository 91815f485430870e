"""Pictures of tables, with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from aolink.errors import AolinkError
from aolink.extensions import install_command
from aolink.files import writing

_MOST_LABELS = 24


def batch_picture(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw a table of `aolink.jobs.batch`: error of the path, and whether the filter is consistent, job by job.

    Raises
    ------
    AolinkError
        matplotlib is missing, no row has anything to draw, or the file cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise AolinkError(f"a picture needs matplotlib: {install_command('plot')}") from None
    done = [row for row in rows if row["estimator"]]
    if not done:
        raise AolinkError("nothing was estimated: there is nothing to draw")
    labels = list(dict.fromkeys(_label(row) for row in done))
    truth = any(row["path_rmse"] is not None for row in done)
    quantities = [("nis", "NIS, over its expectation")]
    if truth:
        quantities = [
            ("path_rmse", "RMSE of the path\n(slope units)"),
            ("end_nees", "NEES of the end state,\nover its expectation"),
            *quantities,
        ]
    figure = Figure(figsize=(max(6.0, 1.5 + 0.5 * len(labels)), 2.6 * len(quantities)), layout="constrained")
    axes = figure.subplots(len(quantities), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (key, title) in zip(axes, quantities, strict=True):
        for name in dict.fromkeys(row["estimator"] for row in done):
            points = [(labels.index(_label(row)), row) for row in done if row["estimator"] == name]
            known = [(x, _value(row, key)) for x, row in points if row[key] is not None]
            if known:
                axis.plot(*zip(*known, strict=True), "o", label=name, markersize=5)
        axis.set_ylabel(title)
        axis.set_yscale("log")
        axis.grid(alpha=0.3)
        if key != "path_rmse":
            axis.axhline(1.0, color="0.4", linewidth=0.8)
    axes[0].legend(fontsize="small", ncols=4, loc="lower left", bbox_to_anchor=(0, 1))
    if len(labels) <= _MOST_LABELS:
        axes[-1].set_xticks(range(len(labels)), labels, rotation=30, ha="right", fontsize="small")
    else:
        axes[-1].set_xlabel(f"{len(labels)} recordings and models, in the order of the table")
    with writing(path, overwrite=True) as partial:
        figure.savefig(partial, dpi=120, format="png")


def _label(row: Mapping[str, Any]) -> str:
    return f"{Path(row['recording']).stem} {row['model'] or ''}".strip()


def _value(row: Mapping[str, Any], key: str) -> float:
    """A mean NIS or NEES divided by that of a consistent filter, the middle of its bounds."""
    value = float(row[key])
    if key == "path_rmse":
        return value
    low, high = (row[f"{key.removeprefix('end_')}_{end}"] for end in ("low", "high"))
    return value / float(0.5 * (low + high))
