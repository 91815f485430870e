"""The unit of a batch: one recording, one model and one estimator; a function that any engine can call."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from aolink.errors import AolinkError, EstimatorError, RecordingError, RigError
from aolink.estimation import Driver, Estimate, Score, Scorer
from aolink.estimation.registry import DEFAULT_ESTIMATOR
from aolink.exposure import Exposure
from aolink.files import check_target, writing
from aolink.jobs.tables import COLUMNS, is_table_of, rows_into, table_beside
from aolink.numerics.rms import rms
from aolink.recording.editing import recorded_estimate, side_file
from aolink.recording.reader import Recording
from aolink.recording.reestimate import check_has_exposures
from aolink.rig import parse_rig
from aolink.rig.edit import with_value
from aolink.series import Step


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """The rig that recordings are estimated with: their own, or another, with some values changed."""

    name: str = ""
    """The other rig's name and the changed values; empty for the recording's own rig."""
    rig_text: str | None = None
    """Text of a rig file to use instead of the one in the recording; None for the latter."""
    changes: tuple[tuple[str, Any], ...] = ()
    """Dotted keys of the rig file, with their new values."""

    def text_for(self, recorded: str) -> str:
        """The rig file to use for a recording that was made with ``recorded``. Raises RigError for a key it lacks."""
        text = recorded if self.rig_text is None else self.rig_text
        for key, value in self.changes:
            try:
                text = with_value(text, key, value)
            except RigError as error:
                raise RigError(f"--set {error}") from None
        return text

    def applied_to(self, recording: Recording) -> Recording:
        """The same recording, to be estimated with this model. Raises RigError where this is not possible."""
        text = self.text_for(recording.rig.toml)
        return recording if text == recording.rig.toml else Recording(recording.path, rig=parse_rig(text))


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How a recording is estimated: plain data, which can be pickled."""

    estimator: str = DEFAULT_ESTIMATOR
    """The estimator, one of `aolink.estimation.ESTIMATOR_NAMES`."""
    model: Model = Model()
    """The model, by default the recording's own rig."""
    table: bool = False
    """Whether to write a table in Parquet too, with a row for each exposure: a file of the side file's name that ends
    with ``.parquet``. Its columns are those of `exposure_row`."""
    overwrite: bool = False
    """Whether to estimate again a recording that was done before, and to replace a file of that name that is not a side
    file."""


def estimate_file(source: str | Path, out: str | Path, settings: Settings | None = None) -> dict[str, Any]:
    """Estimate one recording and write a side file: its estimates alone, which refer to the recording.

    A recording that was done before with the same settings and version of aolink is not done again. The recording is
    read once from its start to its end. Several processes may call this at the same time, on any machines that share
    the folder of ``out``; the file appears when it is whole.

    Parameters
    ----------
    source:
        The recording's file.
    out:
        The side file to write, such as ``session.moments.mcap``: `Recording` takes it as ``side``, and `aolink view`
        beside the recording.
    settings:
        The defaults of `Settings` if not given.

    Returns
    -------
    A row by `COLUMNS` of numbers and texts; unknown values are None. RMSE is in slope units, ``seconds`` is the time of
    this call.

    Raises
    ------
    RecordingError
        The recording cannot be read or holds no exposure, or the side file cannot be written.
    RigError, EstimatorError
        The model does not fit the recording, or the estimator cannot work with it.
    """
    return estimated(source, Path(out), settings or Settings())[0]


def estimated(source: str | Path, out: Path, settings: Settings) -> tuple[dict[str, Any], bool]:
    """The row of `estimate_file`, and whether it had been done before."""
    begin = time.perf_counter()
    recording = settings.model.applied_to(Recording(source))
    digest = _digest(recording, settings)
    if not settings.overwrite and (before := _row_before(out, digest, settings)) is not None:
        return {**before, "recording": str(recording.path), "output": out.name}, True
    check_has_exposures(recording)
    notes = {"aolink_version": aolink_version(), "estimators": settings.estimator, "job": digest}
    scorer = Scorer()
    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    row |= {
        "recording": str(recording.path), "model": settings.model.name, "estimator": settings.estimator,
        "output": out.name,
    }  # fmt: skip
    names = {key: row[key] for key in ("recording", "model", "estimator")}
    with (
        writing(out, overwrite=True, sources=recording.files, error=RecordingError) as partial,
        side_file(recording, partial, notes) as side,
        rows_into(table_beside(out) if settings.table else None, digest) as add_row,
    ):
        for time_ns, exposure, estimate in _estimates(recording, settings):
            side.add(recorded_estimate(estimate, time_ns))
            scorer.add(exposure, estimate)
            if settings.table:
                add_row(names | exposure_row(time_ns, exposure, estimate))
        row |= score_row(scorer.result())
        row |= {"seconds": round(time.perf_counter() - begin, 3), "damage": recording.damage or None}
        side.finish(end={"row": json.dumps(row)})
    return row, False


def exposure_row(time_ns: int, exposure: Exposure, estimate: Estimate) -> dict[str, Any]:
    """The row of an exposure in the table of exposures, without recording, model and estimator.

    ``time_ns`` is the log time. ``nis`` is the sum over the axes that were measured, and follows chi-square with
    ``nis_degrees`` degrees of freedom. In slope units: ``path_rms`` of the estimated path, ``path_sd`` of its standard
    deviation (root mean squares over outputs and fast steps), and the errors ``path_rmse``, ``start_rmse`` and
    ``end_rmse`` (as in `aolink.estimation.Score`) of what is known, which are None where there is no truth.
    """
    seen, truth = estimate.nis > 0, exposure.truth
    row: dict[str, Any] = {
        "frame_id": estimate.frame_id, "time_ns": time_ns, "first_step": estimate.first_step,
        "status": estimate.status.name, "reason": estimate.reason,
        "nis": float(estimate.nis[seen].sum()), "nis_degrees": estimate.innovation.shape[1] * int(seen.sum()),
        "path_rms": rms(estimate.path), "path_sd": rms(estimate.path_sd),
        "path_rmse": None, "start_rmse": None, "end_rmse": None,
    }  # fmt: skip
    if truth is not None:
        row["path_rmse"] = rms((estimate.path - truth.path)[truth.known])
        for name, error in (
            ("start_rmse", estimate.start_state - truth.start_state),
            ("end_rmse", estimate.end_state - truth.end_state),
        ):
            known = np.isfinite(error).all(axis=1)
            row[name] = rms(np.linalg.norm(error[known] if known.any() else error, axis=1))
    return row


def _estimates(recording: Recording, settings: Settings) -> Iterator[tuple[int, Exposure, Estimate]]:
    waiting: deque[Step] = deque()

    def exposures() -> Iterator[Exposure]:
        for step in recording.steps():
            waiting.append(step)
            yield step.exposure

    try:
        for exposure, (estimate,) in Driver(recording.rig, [settings.estimator]).steps(exposures()):
            yield waiting.popleft().time_ns, exposure, estimate
    except (ArithmeticError, ValueError) as error:
        if settings.model == Model():
            raise
        raise EstimatorError(
            f"{recording.path} cannot be estimated with this model: {error!r}; are its numbers intended?"
        ) from None


@lru_cache(maxsize=1)
def aolink_version() -> str:
    """The installed version of aolink. It is found once, because that takes longer than opening a recording."""
    return version("aolink")


def _digest(recording: Recording, settings: Settings) -> str:
    facts = [
        recording.digest, aolink_version(), settings.estimator, settings.model.rig_text,
        [[key, str(value)] for key, value in settings.model.changes],
    ]  # fmt: skip
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()


def _row_before(out: Path, digest: str, settings: Settings) -> dict[str, Any] | None:
    """The row of a side file that is there already; None if it is to be made.

    Raises RecordingError where another file has the name.
    """
    if not out.exists():
        return None
    try:
        before = Recording(out)
    except AolinkError:
        before = None
    if before is None or not before.side_of:
        check_target(out, error=RecordingError)
        return None
    if before.metadata.get("job") != digest or "row" not in before.end_metadata:
        return None
    if settings.table and not is_table_of(table_beside(out), digest):
        return None
    return dict(json.loads(before.end_metadata["row"]))


def score_row(score: Score) -> dict[str, Any]:
    """The values of a score in a row of a table, by column; unknown values are None."""
    values = {
        "path_rmse": score.path_rmse, "start_rmse": score.start_rmse, "end_rmse": score.end_rmse,
        "nis": score.nis.mean, "nis_low": score.nis.low, "nis_high": score.nis.high,
        "start_nees": score.start_nees.mean, "end_nees": score.end_nees.mean,
        "nees_low": score.end_nees.low, "nees_high": score.end_nees.high,
    }  # fmt: skip
    return {name: None if math.isnan(value) else value for name, value in values.items()} | {
        "exposures": score.estimated, "not_ok": sum(each.exposures for each in score.unused),
        "nothing_measured": score.nothing_measured or None,
    }  # fmt: skip
