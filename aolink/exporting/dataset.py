"""Exposures and estimates as a dataset of xarray."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from aolink.exporting.arrays import arrays
from aolink.exporting.common import Progress, facts, needed, no_progress
from aolink.exporting.series import Series

if TYPE_CHECKING:
    import xarray as xr


def to_xarray(series: Series, estimators: Sequence[str] | None = None, progress: Progress = no_progress) -> xr.Dataset:
    """What `Series.to_xarray` gives. Raises as `arrays`, and ExportError where xarray is missing."""
    xarray = needed("xarray", "tables", "a dataset")
    found = arrays(series, estimators, progress)
    coordinates = ("time", "frame_id", "estimator")
    parts = {
        name: (each.dims, each.values, {"long_name": each.text} | ({"units": each.unit} if each.unit else {}))
        for name, each in found.items()
    }
    step_s = np.arange(found["inputs"].values.shape[1]) * series.rig.timing.fast_step_s
    parts["rig_toml"] = ((), np.array(series.rig.toml), {"long_name": "the rig file"})
    parts["step"] = (("step",), step_s, {"long_name": "time since the exposure's first fast step", "units": "s"})
    dataset: xr.Dataset = xarray.Dataset(
        {name: each for name, each in parts.items() if name not in (*coordinates, "step")},
        coords={name: parts[name] for name in (*coordinates, "step") if name in parts},
        attrs=facts(series),
    )
    return dataset
