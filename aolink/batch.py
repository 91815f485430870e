"""The unit of a batch: one recording, one model and one estimator; a function that any engine can call.

`aolink/pages/many_recordings.md` shows how.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from aolink.errors import AolinkError, EstimatorError, RecordingError, RigError
from aolink.estimation import Score, Scorer
from aolink.estimation.registry import DEFAULT_ESTIMATOR
from aolink.files import check_target, writing
from aolink.recording.editing import recorded_estimate, side_file
from aolink.recording.reader import Recording
from aolink.recording.reestimate import check_has_exposures, steps_estimated
from aolink.rig import parse_rig
from aolink.rig.edit import with_value

COLUMNS = (
    "recording", "model", "estimator", "exposures", "path_rmse", "start_rmse", "end_rmse",
    "nis", "nis_low", "nis_high", "start_nees", "end_nees", "nees_low", "nees_high", "not_ok", "nothing_measured",
    "seconds", "output", "damage", "done_before", "error",
)  # fmt: skip
"""Columns of the table of a batch: one row for each recording, model and estimator."""


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


def estimate_file(
    source: str | Path, out: str | Path, estimator: str = DEFAULT_ESTIMATOR, *, model: Model | None = None,
    overwrite: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Estimate one recording and write a side file: its estimates alone, which refer to the recording.

    A recording that was done before with the same arguments and version of aolink is not done again. The recording is
    read twice: for its digest and for its exposures. Several processes may call this at the same time, on any machines
    that share the folder of ``out``; the file appears when it is whole.

    Parameters
    ----------
    source:
        The recording.
    out:
        The side file to write, such as ``session.moments.mcap``: `Recording` takes it as ``side``, and `aolink view`
        beside the recording.
    estimator:
        One of `aolink.estimation.ESTIMATOR_NAMES`.
    model:
        The recording's own rig if not given.
    overwrite:
        Whether to estimate again a recording that was done before, and to replace a file of that name that is not a
        side file.

    Returns
    -------
    A row by `COLUMNS` of numbers and texts; unknown values are None. RMSE is in slope units, ``seconds`` is the time of
    the call that made the estimates.

    Raises
    ------
    RecordingError
        The recording cannot be read or holds no exposure, or the side file cannot be written.
    RigError, EstimatorError
        The model does not fit the recording, or the estimator cannot work with it.
    """
    begin, out, model = time.perf_counter(), Path(out), model or Model()
    recording = model.applied_to(Recording(source))
    facts = [
        recording.digest, aolink_version(), estimator, model.rig_text,
        [[key, str(value)] for key, value in model.changes],
    ]  # fmt: skip
    digest = hashlib.sha256(json.dumps(facts).encode()).hexdigest()
    if not overwrite and (before := _row_before(out, digest)) is not None:
        return before | {"recording": str(recording.path), "output": out.name, "done_before": True}
    check_has_exposures(recording)
    notes = {"aolink_version": aolink_version(), "estimators": estimator, "job": digest}
    scorer = Scorer()
    with (
        writing(out, overwrite=True, sources=recording.files, error=RecordingError) as partial,
        side_file(recording, partial, notes) as side,
    ):
        try:
            for step, (estimate,) in steps_estimated(recording, [estimator]):
                side.add(recorded_estimate(estimate, step.time_ns))
                scorer.add(step.exposure, estimate)
        except (ArithmeticError, ValueError) as error:
            if model == Model():
                raise
            raise EstimatorError(
                f"{recording.path} cannot be estimated with this model: {error!r}; are its numbers intended?"
            ) from None
        row: dict[str, Any] = dict.fromkeys(COLUMNS) | _score_row(scorer.result())
        row |= {
            "recording": str(recording.path), "model": model.name, "estimator": estimator, "output": out.name,
            "seconds": round(time.perf_counter() - begin, 3), "damage": recording.damage or None, "done_before": False,
        }  # fmt: skip
        side.finish(end={"row": json.dumps(row)})
    return row


@lru_cache(maxsize=1)
def aolink_version() -> str:
    """The installed version of aolink. It is found once, because that takes longer than opening a recording."""
    return version("aolink")


def _row_before(out: Path, digest: str) -> dict[str, Any] | None:
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
    elif before.metadata.get("job") == digest and "row" in before.end_metadata:
        return dict(json.loads(before.end_metadata["row"]))
    return None


def _score_row(score: Score) -> dict[str, Any]:
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
