"""Exposures and estimates as a table: a row for each exposure and axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from aolink.estimation.estimate import Estimate
from aolink.exporting.common import Progress, clock_of, needed, no_progress, time_ns, together
from aolink.exporting.summary import estimate_scalars, path_rms, rms_by_axis
from aolink.exposure import Exposure, Truth
from aolink.numerics.arrays import FloatArray
from aolink.series import Series

if TYPE_CHECKING:
    import pandas as pd

ColumnKind = Literal["text", "integer", "number", "time", "numbers"]
ByAxis = Sequence[Any] | FloatArray


@dataclass(frozen=True, slots=True)
class Column:
    """A column of the table."""

    name: str
    kind: ColumnKind
    """The type of its values: a ``time`` is ns since 1970, ``numbers`` a list; unknown values are None."""


def columns(series: Series, names: Sequence[str], *, lists: bool = False) -> list[Column]:
    """The table's columns for the estimators ``names``; those of an estimator begin with its name.

    A row names its source (``recording``, ``rig``), its exposure (``time``, ``lead_steps`` and the fields of
    `Exposure`) and its ``axis``. For that axis it has the mean of each input (``input_1_mean``, ...), the states
    (``x1``, ...) at both ends with their standard deviations, the mean of each output's path (``path_1_mean``), the RMS
    of the path about these means (``path_rms``), of its standard deviation (``path_sd_rms``) and, where the truth is
    known, of its error (``path_error_rms``); ``status``, ``reason`` and ``nis``. ``lists`` says whether to add the
    axis's inputs (steps x inputs), paths and their standard deviations (outputs x steps) as lists.
    """
    plant = series.rig.plant
    inputs, states = range(1, plant.n_inputs + 1), range(1, plant.n_states + 1)
    outputs = range(1, plant.n_outputs + 1)
    found = [Column(name, "text") for name in ("recording", "rig")]
    found += [Column("frame_id", "integer"), Column("time", "time"), Column("axis", "integer")]
    found += [Column(name, kind) for name, kind in _OF_EXPOSURE.items() if name != "frame_id"]
    found.append(Column("lead_steps", "integer"))
    found += [Column(f"input_{j}_mean", "number") for j in inputs]
    path = [Column(f"path_{j}_mean", "number") for j in outputs] + [Column("path_rms", "number")]
    if series.has_truth:
        found += [Column(f"truth_{end}_x{i}", "number") for end in ("start", "end") for i in states]
        found += [Column(f"truth_{each.name}", each.kind) for each in path]
    each_has = [Column("status", "text"), Column("reason", "text"), Column("nis", "number")]
    for end in ("start", "end"):
        each_has += [Column(f"{end}_x{i}{sd}", "number") for i in states for sd in ("", "_sd")]
    each_has += [*path, Column("path_sd_rms", "number")]
    if series.has_truth:
        each_has.append(Column("path_error_rms", "number"))
    if lists:
        found.append(Column("inputs", "numbers"))
        found += [Column("truth_path", "numbers")] if series.has_truth else []
        each_has += [Column("path", "numbers"), Column("path_sd", "numbers")]
    return found + [Column(f"{name}_{each.name}", each.kind) for name in names for each in each_has]


def rows(
    series: Series, names: Sequence[str], *, lists: bool = False, progress: Progress = no_progress
) -> Iterator[dict[str, Any]]:
    """The table's rows by the names of its `columns`, one by one; unknown values are left out.

    Raises ExportError where there is no exposure.
    """
    plant, clock = series.rig.plant, None
    for exposure, estimates in together(series, names, progress):
        clock = clock_of(exposure) if clock is None else clock
        shared = {
            "recording": series.path.name, "rig": series.rig.name, "time": time_ns(series, exposure, clock),
            "lead_steps": len(exposure.lead_inputs),
        } | {name: getattr(exposure, name) for name in _OF_EXPOSURE}  # fmt: skip
        inputs = exposure.inputs.reshape(exposure.n_steps, plant.axes, -1).swapaxes(0, 1)
        truth = {} if exposure.truth is None else _of_truth(exposure.truth, plant.axes, lists)
        of_each = [(name, _of_estimate(each, exposure, lists)) for name, each in estimates.items()]
        for axis in range(plant.axes):
            row = shared | {"axis": axis}
            row |= {f"input_{j}_mean": mean for j, mean in enumerate(inputs[axis].mean(axis=0).tolist(), 1)}
            if lists:
                row["inputs"] = inputs[axis].ravel()
            row |= {f"truth_{column}": values[axis] for column, values in truth.items()}
            row |= {f"{name}_{column}": values[axis] for name, found in of_each for column, values in found.items()}
            yield row


_OF_EXPOSURE: dict[str, ColumnKind] = {
    "frame_id": "integer", "first_step": "integer", "n_steps": "integer", "start_offset": "number",
    "clock_sigma_ns": "number", "device_start_ns": "integer", "device_end_ns": "integer", "host_start_ns": "integer",
    "host_receive_ns": "integer", "chunks_lost": "integer", "inputs_assumed": "integer",
}  # fmt: skip


def _of_truth(truth: Truth, axes: int, lists: bool) -> dict[str, ByAxis]:
    """The values of a truth for each axis, by column."""
    found: dict[str, ByAxis] = {}
    for end, states in (("start", truth.start_state), ("end", truth.end_state)):
        found |= {f"{end}_x{i}": column.tolist() for i, column in enumerate(states.T, 1)}
    return found | _of_path(truth.path, axes, lists) | {"path_rms": path_rms(truth.path, axes).tolist()}


def _of_estimate(estimate: Estimate, exposure: Exposure, lists: bool) -> dict[str, ByAxis]:
    """The values of an estimate for each axis, by column."""
    axes = len(estimate.start_state)
    found: dict[str, ByAxis] = {"status": [estimate.status.name] * axes, "reason": [estimate.reason] * axes}
    for end, states, covariance in (
        ("start", estimate.start_state, estimate.start_covariance),
        ("end", estimate.end_state, estimate.end_covariance),
    ):
        deviations = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
        for i, (column, deviation) in enumerate(zip(states.T, deviations.T, strict=True), 1):
            found |= {f"{end}_x{i}": column.tolist(), f"{end}_x{i}_sd": deviation.tolist()}
    found |= _of_path(estimate.path, axes, lists)
    found |= {name: values.tolist() for name, values in estimate_scalars(estimate).items()}
    if lists:
        found["path_sd"] = estimate.path_sd.reshape(axes, -1)
    if exposure.truth is not None and exposure.truth.path.shape == estimate.path.shape:
        found["path_error_rms"] = rms_by_axis(estimate.path - exposure.truth.path, axes).tolist()
    return found


def _of_path(path: FloatArray, axes: int, lists: bool) -> dict[str, ByAxis]:
    means = path.mean(axis=1).reshape(axes, -1)
    found: dict[str, ByAxis] = {f"path_{j}_mean": column.tolist() for j, column in enumerate(means.T, 1)}
    return found | ({"path": path.reshape(axes, -1)} if lists else {})


def to_pandas(series: Series, estimators: Sequence[str] | None = None) -> pd.DataFrame:
    """The result of `aolink.series.Series.to_pandas`. Raises RecordingError and ExportError as that does."""
    pandas = needed("pandas", "tables", "a data frame")
    names = series.named(estimators)
    known = columns(series, names)
    values: dict[str, list[Any]] = {column.name: [] for column in known}
    for row in rows(series, names):
        for name, column in values.items():
            column.append(row.get(name))
    types: dict[str, Any] = {"text": object, "integer": np.int64, "number": np.float64, "time": "datetime64[ns]"}
    frame: pd.DataFrame = pandas.DataFrame(
        {column.name: np.array(values[column.name], dtype=types[column.kind]) for column in known}
    )
    return frame.set_index("time").tz_localize("UTC")


def paths_to_pandas(series: Series, estimators: Sequence[str] | None = None) -> pd.DataFrame:
    """The long table of `aolink.series.Series.to_pandas`: a row for each fast step, output and name."""
    pandas = needed("pandas", "tables", "a data frame")
    names, clock, parts = series.named(estimators), None, []
    ns, outputs = series.rig.timing.fast_step_ns, series.rig.n_outputs
    for exposure, estimates in together(series, names):
        clock = clock_of(exposure) if clock is None else clock
        begun = time_ns(series, exposure, clock) + (round(exposure.start_offset * ns) if not clock else 0)
        steps = begun + ns * np.arange(exposure.n_steps)
        paths = {} if exposure.truth is None else {"truth": (exposure.truth.path, np.zeros_like(exposure.truth.path))}
        paths |= {name: (estimates[name].path, estimates[name].path_sd) for name in names if name in estimates}
        for name, (value, sd) in paths.items():
            parts.append(
                {
                    "time": np.tile(steps, outputs), "frame_id": np.full(value.size, exposure.frame_id),
                    "name": np.full(value.size, name, dtype=object),
                    "axis": np.repeat(np.arange(outputs), exposure.n_steps), "value": value.ravel(), "sd": sd.ravel(),
                }
            )  # fmt: skip
    keys = ("time", "frame_id", "name", "axis", "value", "sd")
    columns = {key: np.concatenate([part[key] for part in parts]) if parts else np.zeros(0) for key in keys}
    frame: pd.DataFrame = pandas.DataFrame(columns | {"time": columns["time"].astype("datetime64[ns]")})
    return frame.set_index("time").tz_localize("UTC")
