"""Exposures and estimates as arrays along time, each with its dimensions, its unit and its meaning."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import ExportError
from aolink.exporting.common import Progress, clock_of, facts, needed, no_progress, time_ns, together
from aolink.exporting.summary import estimate_scalars
from aolink.exposure import Exposure
from aolink.series import Series

if TYPE_CHECKING:
    import xarray as xr

_MOST_BYTES = 8 << 30
"""The most bytes that are put into memory at once; a quarter of the machine's memory is the other limit."""
_SLOPE = "slope unit"


@dataclass(frozen=True, kw_only=True, eq=False)
class Variable:
    """One array of an export."""

    dims: tuple[str, ...]
    """Names of its dimensions."""
    values: NDArray[Any]
    text: str
    """The meaning of the variable."""
    unit: str = ""


@dataclass(frozen=True)
class _Row:
    """The source of one variable."""

    text: str
    dims: tuple[str, ...] = ()
    """Dimensions besides time and estimator."""
    unit: str = ""
    get: Callable[[Any], Any] | None = None
    """Function that gets the value; where None, the attribute of the variable's name."""
    in_words: bool = False

    def of(self, name: str, source: Any) -> Any:
        return getattr(source, name) if self.get is None else self.get(source)


_FRAME, _STATE, _PATH = ("row", "column"), ("axis", "state"), ("output", "step")
EXPOSURE = {
    "frame_id": _Row("the camera's own count of its frames"),
    "first_step": _Row("fast step at which the exposure starts"),
    "n_steps": _Row("fast steps in the exposure"),
    "start_offset": _Row("how far into its first fast step the exposure starts", unit="step"),
    "device_start_ns": _Row("start, camera's clock", unit="ns"),
    "device_end_ns": _Row("end, camera's clock", unit="ns"),
    "host_start_ns": _Row("start, host's clock; 0: not known", unit="ns"),
    "host_receive_ns": _Row("when the host had the frame, host's clock", unit="ns"),
    "clock_sigma_ns": _Row("standard deviation of host_start_ns", unit="ns"),
    "chunks_lost": _Row("chunks of the frame that never arrived"),
    "inputs_assumed": _Row("steps of inputs and lead inputs without the mirror's report"),
    "lead_steps": _Row("fast steps between the exposure before and this one", get=lambda e: len(e.lead_inputs)),
    "pixels": _Row("the frame", _FRAME, "count"),
    "mask": _Row("whether the pixel arrived", _FRAME),
    "inputs": _Row("what the mirror held in each fast step", ("step", "input"), "input unit"),
}
TRUTH = {
    "truth_start_state": _Row("true state at the start", _STATE, "plant's unit", lambda t: t.start_state),
    "truth_end_state": _Row("true state a step after the end", _STATE, "plant's unit", lambda t: t.end_state),
    "truth_path": _Row("true path", _PATH, _SLOPE, lambda t: t.path),
}
ESTIMATE = {
    "status": _Row("what became of the measurement; empty: no estimate", get=lambda e: e.status.name, in_words=True),
    "reason": _Row("why the status is not OK", in_words=True),
    "start_state": _Row("state at the start", _STATE, "plant's unit"),
    "start_state_sd": _Row("its standard deviation", _STATE, "plant's unit", lambda e: _sd(e.start_covariance)),
    "end_state": _Row("state one fast step after the end", _STATE, "plant's unit"),
    "end_state_sd": _Row("its standard deviation", _STATE, "plant's unit", lambda e: _sd(e.end_covariance)),
    "path": _Row("output at each fast step", _PATH, _SLOPE),
    "path_sd": _Row("its standard deviation", _PATH, _SLOPE),
    "path_rms": _Row("RMS of the path about its mean", ("axis",), _SLOPE, lambda e: estimate_scalars(e)["path_rms"]),
    "nis": _Row(
        "normalised innovation squared; NaN: no measurement", ("axis",), get=lambda e: estimate_scalars(e)["nis"]
    ),
}


def arrays(
    series: Series, estimators: Sequence[str] | None = None, progress: Progress = no_progress
) -> dict[str, Variable]:
    """All data of exposures and their estimates, by name, in memory.

    Dimensions: ``time``, an exposure each; ``row`` and ``column`` of a frame; ``step``, a fast step of an exposure;
    ``input``; ``axis``, ``state`` and ``output`` of the plant; ``estimator``. ``lead_inputs`` are those of the steps
    between exposures, end to end along ``lead_step``: ``lead_steps`` says how many belong to each exposure, before it.
    Frames of a picture sensor are ``scene``. Variables of a truth, or of estimates, are there if any exposure has one;
    where one exposure has none, numbers are NaN and texts empty. Estimates of ``estimators`` are exported;
    by default of all. Raises `RecordingError` where there are no estimates of such a name; `ExportError` where
    there is no exposure, the exposures have different sizes, or the arrays would be too large for the memory.
    """
    names = series.named(estimators)
    _check_size(series, len(names))
    columns: dict[str, list[Any]] = {name: [] for name in (*EXPOSURE, *TRUTH)}
    by_estimator: dict[str, list[list[Any]]] = {name: [[] for _ in names] for name in ESTIMATE}
    rest: list[tuple[int, Any, Any, Any]] = []
    first: Exposure | None = None
    clock = ""
    for exposure, estimates in together(series, names, progress):
        if first is None:
            first, clock = exposure, clock_of(exposure)
        _check_alike(series, first, exposure)
        time = time_ns(series, exposure, clock)
        rest.append((time, exposure.lead_inputs, exposure.scene, exposure.slopes))
        for name, row in EXPOSURE.items():
            columns[name].append(row.of(name, exposure))
        for name, row in TRUTH.items():
            columns[name].append(None if exposure.truth is None else row.of(name, exposure.truth))
        for name, row in ESTIMATE.items():
            for column, of in zip(by_estimator[name], names, strict=True):
                column.append(row.of(name, estimates[of]) if of in estimates else None)
    times, leads, scenes, slopes = zip(*rest, strict=True)
    found = {
        "time": Variable(
            dims=("time",), values=np.array(times).astype("datetime64[ns]"),
            text=f"start of the exposure, by {clock or 'its fast step'}; UTC where that is the host's clock",
        )
    }  # fmt: skip
    for name, row in EXPOSURE.items():
        found[name] = _variable(row, np.array(columns[name]))
    found["lead_inputs"] = Variable(
        dims=("lead_step", "input"), values=np.concatenate(leads), text="what the mirror held between the exposures",
        unit="input unit",
    )  # fmt: skip
    found |= _scenes(scenes)
    if any(each is not None for each in slopes):
        none = np.full(series.rig.n_outputs, np.nan)
        found["slopes"] = Variable(
            dims=("time", "output"), values=np.array([none if each is None else each for each in slopes]),
            text="slopes of other software, where there are no pixels", unit=_SLOPE,
        )  # fmt: skip
    sizes = {
        "axis": series.rig.plant.axes, "state": series.rig.plant.n_states, "output": series.rig.n_outputs,
        "step": found["inputs"].values.shape[1],
    }  # fmt: skip
    if any(each is not None for each in columns["truth_path"]):
        found |= {name: _variable(row, _filled(row, columns[name], sizes)) for name, row in TRUTH.items()}
    if names:
        found["estimator"] = Variable(dims=("estimator",), values=np.array(names), text="name of the estimator")
        for name, row in ESTIMATE.items():
            whole = _filled(row, [each for column in by_estimator[name] for each in column], sizes)
            found[name] = _variable(row, whole.reshape(len(names), len(times), *whole.shape[1:]), "estimator")
    return found


def _variable(row: _Row, values: NDArray[Any], *before: str) -> Variable:
    return Variable(dims=(*before, "time", *row.dims), values=values, text=row.text, unit=row.unit)


def _filled(row: _Row, values: Sequence[Any], sizes: Mapping[str, int]) -> NDArray[Any]:
    """The values as an array, with NaN or an empty text for None. Raises ExportError if they are of several sizes."""
    missing = "" if row.in_words else np.full([sizes[dim] for dim in row.dims], np.nan)
    if odd := {np.shape(each) for each in values if each is not None} - {np.shape(missing)}:
        raise ExportError(
            f"the recording has a {row.text} of {odd.pop()} {' x '.join(row.dims)}, where its rig file and its"
            f" exposures have {np.shape(missing)}: it is damaged, or was recorded with another rig file"
        )
    return np.array([missing if each is None else each for each in values])


def _sd(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))


def _scenes(scenes: Sequence[Any]) -> Mapping[str, Variable]:
    """Frames of the picture sensor; one that never came is zero, with a mask that is False throughout."""
    known = next((each for each in scenes if each is not None), None)
    if known is None:
        return {}
    dims = ("time", "scene_row", "scene_column")
    dark, lost = np.zeros_like(known.pixels), np.zeros_like(known.mask)
    pixels = np.array([dark if each is None else each.pixels for each in scenes])
    mask = np.array([lost if each is None else each.mask for each in scenes])
    return {
        "scene": Variable(dims=dims, values=pixels, text="the picture sensor's frame", unit="count"),
        "scene_mask": Variable(dims=dims, values=mask, text="whether the pixel arrived"),
    }


def _check_alike(series: Series, first: Exposure, other: Exposure) -> None:
    ours = (first.n_steps, *first.pixels.shape)
    theirs = (other.n_steps, *other.pixels.shape)
    if ours != theirs:
        raise ExportError(
            f"frame {other.frame_id} of {series.path} has {theirs} fast steps, rows and columns, frame {first.frame_id}"
            f" has {ours}: they make no array; a table (.csv, .parquet) takes both"
        )


def _check_size(series: Series, n_estimators: int) -> None:
    """Refuse arrays that would fill the memory."""
    rig, steps = series.rig, series.rig.window_steps
    numbers = (1 + 2 * n_estimators) * rig.n_outputs * steps + rig.n_inputs * steps
    numbers += 4 * n_estimators * rig.plant.axes * rig.plant.n_states
    pixels = int(np.prod(rig.sensor.shape)) + (int(np.prod(rig.scene.shape)) if rig.scene else 0)
    size = len(series) * (8 * numbers + 3 * pixels)
    most = min(_MOST_BYTES, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 4)
    if size > most:
        raise ExportError(
            f"{series.path} would take {size / 2**30:.0f} GiB of memory, at most {most / 2**30:.1f} are allowed here:"
            " take fewer estimators or a part of it (`aolink copy`)"
        )


def to_xarray(series: Series, estimators: Sequence[str] | None = None, progress: Progress = no_progress) -> xr.Dataset:
    """The arrays as a dataset of xarray. Raises as `arrays`, and ExportError where xarray is missing."""
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
