"""Exposures and estimates in the files of other programs: one function for each format, and `export` for all."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from aolink.errors import ExportError
from aolink.exporting.arrays import arrays, to_xarray
from aolink.exporting.common import Progress, facts, needed, no_progress
from aolink.exporting.table import to_pandas
from aolink.exporting.telemetry import write_fits
from aolink.files import check_target, writing
from aolink.series import Series

_FORMULA = re.compile(r"\s*[=@+\-\uff1d\uff20\uff0b\uff0d]")
"""The beginning of a text that a spreadsheet runs, in the wide forms too that it reads as the plain ones."""


def export(
    series: Series, path: str | Path, estimators: Sequence[str] | None = None, *, overwrite: bool = False,
    progress: Progress = no_progress,
) -> None:  # fmt: skip
    """Write exposures and their estimates into a file of another program's format, which its suffix selects.

    ``.npz``, ``.nc`` (NetCDF) and ``.fits`` (AOT telemetry) hold everything of `arrays`; ``.parquet`` and ``.csv`` the
    table of `Series.to_pandas`. Raises `RecordingError` where there are no estimates of such a name; `ExportError`
    where the suffix is not known, a package is missing, the file exists and not ``overwrite``, or cannot be written;
    there is no exposure, or the format cannot hold them (`arrays`).

    Parameters
    ----------
    series:
        The result of `aolink.read`, or a slice of it.
    estimators:
        Estimators whose estimates are exported; all by default.
    progress:
        Called with the number of exposures read.
    """
    path = Path(path)
    if (write := WRITERS.get(path.suffix.lower())) is None:
        raise ExportError(f"cannot write {path}: its name must end with one of {', '.join(WRITERS)}")
    names = series.named(estimators)
    check_target(path, overwrite=overwrite, sources=[series.path], error=ExportError)
    with writing(path, overwrite=overwrite, sources=[series.path], error=ExportError) as partial:
        write(series, names, partial, progress)


def _write_npz(series: Series, names: Sequence[str], path: Path, progress: Progress) -> None:
    found: dict[str, Any] = {name: each.values for name, each in arrays(series, names, progress).items()}
    found |= facts(series) | {"rig_toml": series.rig.toml}
    with path.open("wb") as file:
        np.savez(file, **found)


def _write_netcdf(series: Series, names: Sequence[str], path: Path, progress: Progress) -> None:
    for module in ("h5py", "h5netcdf"):
        needed(module, "tables", "NetCDF (.nc)")
    dataset, file = to_xarray(series, names, progress), io.BytesIO()
    dataset.to_netcdf(file, engine="h5netcdf")
    path.write_bytes(file.getbuffer())  # HDF5 itself ends the process where a disk is full


def no_formula(cell: Any) -> Any:
    """A cell of a table. A text that a spreadsheet would take for a formula gets an apostrophe before it: some come
    from others."""
    return f"'{cell}" if isinstance(cell, str) and _FORMULA.match(cell) else cell


def _write_csv(series: Series, names: Sequence[str], path: Path, progress: Progress) -> None:
    to_pandas(series, names, progress).rename(columns=no_formula).map(no_formula).to_csv(path)


def _write_parquet(series: Series, names: Sequence[str], path: Path, progress: Progress) -> None:
    needed("pyarrow", "tables", "Parquet (.parquet)")
    table = to_pandas(series, names, progress)
    table.attrs = {**facts(series), "rig_toml": series.rig.toml}
    table.to_parquet(path, engine="pyarrow")


WRITERS: dict[str, Callable[[Series, Sequence[str], Path, Progress], None]] = {
    ".npz": _write_npz, ".csv": _write_csv, ".parquet": _write_parquet, ".nc": _write_netcdf, ".fits": write_fits,
}  # fmt: skip
"""Functions that write a format, by the suffix of the file."""
