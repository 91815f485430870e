"""Exposures and estimates in the files of other programs: one function for each format, and `export` for all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from aolink.errors import ExportError
from aolink.exporting.arrays import arrays, to_xarray
from aolink.exporting.common import Progress, facts, needed, no_progress
from aolink.exporting.table import columns, rows
from aolink.exporting.telemetry import write_fits
from aolink.files import check_target, write_csv, writing
from aolink.series import Series

_ROWS_AT_ONCE = 4096
"""Rows of a Parquet file that are in memory together."""


def export(
    series: Series, path: str | Path, estimators: Sequence[str] | None = None, *, overwrite: bool = False,
    progress: Progress = no_progress,
) -> None:  # fmt: skip
    """Write exposures and their estimates into a file of another program's format, which its suffix selects.

    ``.npz``, ``.nc`` (NetCDF) and ``.fits`` (AOT telemetry) hold everything of `arrays`; ``.parquet`` and ``.csv`` the
    table of `aolink.exporting.table`, the former with inputs and paths as lists. Raises `RecordingError` where there
    are no estimates of such a name; `ExportError` where the suffix is not known, a package is missing, the file exists
    and not ``overwrite``, or cannot be written; there is no exposure, or the format cannot hold them (`arrays`).

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
    dataset = to_xarray(series, names, progress)
    with path.open("r+b") as file:  # given the name, HDF5 would lock the file, which is locked already
        dataset.to_netcdf(file, engine="h5netcdf")


def _write_csv(series: Series, names: Sequence[str], path: Path, progress: Progress) -> None:
    known = [column.name for column in columns(series, names)]
    found = (
        row | {"time": np.datetime_as_string(np.datetime64(row["time"], "ns"), timezone="UTC")}
        for row in rows(series, names, progress=progress)
    )
    with path.open("w", encoding="utf-8", newline="") as file:
        write_csv(file, known, found)


def _write_parquet(series: Series, names: Sequence[str], path: Path, progress: Progress) -> None:
    pyarrow = needed("pyarrow", "parquet", "Parquet (.parquet)")
    parquet = needed("pyarrow.parquet", "parquet", "Parquet (.parquet)")
    types = {
        "text": pyarrow.string(), "integer": pyarrow.int64(), "number": pyarrow.float64(),
        "time": pyarrow.timestamp("ns", "UTC"), "numbers": pyarrow.list_(pyarrow.float64()),
    }  # fmt: skip
    known = [(column.name, types[column.kind]) for column in columns(series, names, lists=True)]
    schema = pyarrow.schema(known, metadata=facts(series) | {"rig_toml": series.rig.toml})
    left = rows(series, names, lists=True, progress=progress)
    with parquet.ParquetWriter(path, schema) as writer:
        while some := list(islice(left, _ROWS_AT_ONCE)):
            writer.write_table(pyarrow.Table.from_pylist(some, schema=schema))


WRITERS: dict[str, Callable[[Series, Sequence[str], Path, Progress], None]] = {
    ".npz": _write_npz, ".csv": _write_csv, ".parquet": _write_parquet, ".nc": _write_netcdf, ".fits": write_fits,
}  # fmt: skip
"""Functions that write a format, by the suffix of the file."""
