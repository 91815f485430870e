"""The tables of a batch: a row for each recording, model and estimator, and a row for each exposure."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from aolink.errors import AolinkError, RecordingError
from aolink.extensions import install_command
from aolink.files import write_csv, writing

COLUMNS = (
    "recording", "model", "estimator", "exposures", "path_rmse", "start_rmse", "end_rmse",
    "nis", "nis_low", "nis_high", "start_nees", "end_nees", "nees_low", "nees_high", "not_ok", "nothing_measured",
    "seconds", "output", "damage", "error",
)  # fmt: skip
"""Columns of the table of recordings: one row for each recording, model and estimator; unknown values are empty."""
EXPOSURE_COLUMNS = (
    "recording", "model", "estimator", "frame_id", "time_ns", "first_step", "status", "reason", "nis", "nis_degrees",
    "path_rms", "path_sd", "path_rmse", "start_rmse", "end_rmse",
)  # fmt: skip
"""Columns of the table of exposures."""
_KEYS = ("recording", "model", "estimator")
"""Columns that both tables have."""
_TEXTS = {
    "recording", "model", "estimator", "status", "reason", "nothing_measured", "output", "damage", "error"
}  # fmt: skip
_WHOLE = {"exposures", "not_ok", "frame_id", "time_ns", "first_step", "nis_degrees"}
_ROWS_AT_ONCE = 4096
"""Rows of the table of exposures that are written together."""


def fill_table(partial: Path, rows: Sequence[Mapping[str, Any]], suffix: str) -> None:
    """Write rows of `COLUMNS` into a file that is there already: Parquet where the suffix is .parquet, or else CSV.

    Raises
    ------
    AolinkError
        pyarrow is missing for Parquet.
    """
    if suffix == ".parquet":
        pa, pq = parquet()
        pq.write_table(pa.Table.from_pylist([dict(row) for row in rows], schema=_schema(COLUMNS)), partial)
    else:
        with partial.open("w", newline="") as file:
            write_csv(file, COLUMNS, rows)


@contextmanager
def rows_into(path: Path | None, job: str) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """A context that gives a function for the rows of a table of exposures, by `EXPOSURE_COLUMNS`; some thousands of
    them are kept in memory.

    The table has its name, and the digest of its ``job`` in its metadata, when the block has ended well. Without a path
    there is none. Raises AolinkError where it cannot be written or pyarrow is missing.
    """
    if path is None:
        yield lambda row: None
        return
    pa, pq = parquet()
    schema = _schema(EXPOSURE_COLUMNS).with_metadata({"job": job})
    waiting: list[Mapping[str, Any]] = []
    with writing(path, overwrite=True, error=RecordingError) as partial, pq.ParquetWriter(partial, schema) as writer:

        def flush() -> None:
            writer.write_table(pa.Table.from_pylist(waiting, schema=schema))
            waiting.clear()

        def add(row: Mapping[str, Any]) -> None:
            waiting.append(row)
            if len(waiting) >= _ROWS_AT_ONCE:
                flush()

        yield add
        flush()


def join_tables(parts: Sequence[Path], path: Path) -> None:
    """Write tables of exposures one after the other into one, a few megabytes at a time.

    Raises
    ------
    AolinkError
        The table cannot be written, or a part is not such a table.
    """
    _, pq = parquet()
    schema = _schema(EXPOSURE_COLUMNS)
    with writing(path, overwrite=True) as partial, pq.ParquetWriter(partial, schema) as writer:
        for part in parts:
            try:
                with pq.ParquetFile(part) as file:
                    for rows in file.iter_batches(columns=list(EXPOSURE_COLUMNS)):
                        writer.write_batch(rows.replace_schema_metadata())
            except (ValueError, KeyError) as error:
                raise AolinkError(f"{part} is no table of exposures ({error}): estimate again") from None


def table_beside(side: Path) -> Path:
    """The table of exposures that belongs to a side file."""
    return side.with_suffix(".parquet")


def check_table(path: Path) -> None:
    """Raise RecordingError where a file of a table's name is there that is no table of a batch."""
    if not path.is_file():
        return
    try:
        if path.suffix == ".parquet":
            found = parquet()[1].read_schema(path).names
        else:
            with path.open(newline="") as file:
                found = next(csv.reader(file), [])
    except (OSError, ValueError, csv.Error):
        found = []
    if not {*_KEYS} <= {*found}:
        raise RecordingError(
            f"{path} exists and is no table of a batch: give another folder or another --table; --overwrite replaces it"
        )


def is_table_of(path: Path, job: str) -> bool:
    """Whether a file is the table of exposures of a job, by its digest."""
    _, pq = parquet()
    try:
        found: bytes | None = (pq.read_schema(path).metadata or {}).get(b"job")
    except (OSError, ValueError):
        return False
    return found == job.encode()


def parquet() -> tuple[Any, Any]:
    """The modules pyarrow and pyarrow.parquet. Raises AolinkError where they are missing."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise AolinkError(f"Parquet needs pyarrow: {install_command('parquet')}, or write .csv") from None
    return pa, pq


def _schema(columns: Sequence[str]) -> Any:
    """One schema for all tables, also for those in which a column is empty, so that they can be read as one."""
    pa, _ = parquet()
    return pa.schema(
        [(each, pa.string() if each in _TEXTS else pa.int64() if each in _WHOLE else pa.float64()) for each in columns]
    )
