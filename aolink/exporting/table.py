"""Exposures and estimates as a table: a row for each exposure and axis."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any

import numpy as np

from aolink.estimation.estimate import Estimate
from aolink.exporting.common import Progress, clock_of, needed, no_progress, time_ns, together
from aolink.exporting.summary import estimate_scalars, path_rms, rms_by_axis
from aolink.exposure import Exposure, Truth
from aolink.numerics.arrays import FloatArray
from aolink.series import Series

if TYPE_CHECKING:
    import pandas as pd

ByAxis = Sequence[Any] | FloatArray
_ROWS_AT_ONCE = 4096
"""Rows that are in memory as Python's objects."""
_OF_EXPOSURE = (
    "frame_id", "first_step", "n_steps", "start_offset", "clock_sigma_ns", "device_start_ns", "device_end_ns",
    "host_start_ns", "host_receive_ns", "chunks_lost", "inputs_assumed",
)  # fmt: skip


def rows(series: Series, names: Sequence[str], *, progress: Progress = no_progress) -> Iterator[dict[str, Any]]:
    """The table's rows one by one, for the estimators ``names``; what is unknown is left out.

    A row names its source (``recording``, ``rig``), its exposure (``time``, ``lead_steps`` and the fields of
    `Exposure`) and its ``axis``. For that axis it has the mean of each input (``input_1_mean``, ...); and, with an
    estimator's name before them, the states (``start_x1``, ...) at both ends with their standard deviations, the mean
    of each output's path (``path_1_mean``), the RMS of the path about these means (``path_rms``), of its standard
    deviation (``path_sd_rms``) and, where the truth is known, of its error (``path_error_rms``); ``status``, ``reason``
    and ``nis``. The truth has the columns of an estimator that it can have.

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
        truth = {} if exposure.truth is None else _of_truth(exposure.truth, plant.axes)
        of_each = [("truth", truth), *((name, _of_estimate(each, exposure)) for name, each in estimates.items())]
        for axis in range(plant.axes):
            row = shared | {"axis": axis}
            row |= {f"input_{j}_mean": mean for j, mean in enumerate(inputs[axis].mean(axis=0).tolist(), 1)}
            row |= {f"{name}_{column}": values[axis] for name, found in of_each for column, values in found.items()}
            yield row


def _of_truth(truth: Truth, axes: int) -> dict[str, ByAxis]:
    """The values of a truth for each axis, by column."""
    found: dict[str, ByAxis] = {}
    for end, states in (("start", truth.start_state), ("end", truth.end_state)):
        found |= {f"{end}_x{i}": column.tolist() for i, column in enumerate(states.T, 1)}
    return found | _of_path(truth.path, axes) | {"path_rms": path_rms(truth.path, axes).tolist()}


def _of_estimate(estimate: Estimate, exposure: Exposure) -> dict[str, ByAxis]:
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
    found |= _of_path(estimate.path, axes)
    found |= {name: values.tolist() for name, values in estimate_scalars(estimate).items()}
    if exposure.truth is not None and exposure.truth.path.shape == estimate.path.shape:
        found["path_error_rms"] = rms_by_axis(estimate.path - exposure.truth.path, axes).tolist()
    return found


def _of_path(path: FloatArray, axes: int) -> dict[str, ByAxis]:
    means = path.mean(axis=1).reshape(axes, -1)
    return {f"path_{j}_mean": column.tolist() for j, column in enumerate(means.T, 1)}


def to_pandas(
    series: Series, estimators: Sequence[str] | None = None, progress: Progress = no_progress
) -> pd.DataFrame:
    """The result of `aolink.series.Series.to_pandas`. Raises RecordingError and ExportError as that does."""
    pandas = needed("pandas", "tables", "a table")
    left, parts = rows(series, series.named(estimators), progress=progress), []
    while some := list(islice(left, _ROWS_AT_ONCE)):
        parts.append(pandas.DataFrame(some))
    frame: pd.DataFrame = pandas.concat(parts)
    return frame.set_index(pandas.to_datetime(frame.pop("time"), utc=True))


def paths_to_pandas(series: Series, estimators: Sequence[str] | None = None) -> pd.DataFrame:
    """The long table of `aolink.series.Series.to_pandas`: a row for each fast step, output and name."""
    pandas = needed("pandas", "tables", "a table")
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
