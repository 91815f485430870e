"""A closed loop for an hour in real time: memory, and the end of each frame and each step."""

from __future__ import annotations

import time
from pathlib import Path
from tempfile import TemporaryDirectory

from mcap.reader import make_reader

from aolink.jobs.demo import simulated_rig
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session import record
from bench_rows.row import Effort, Row, resident_mb

_HOUR_S, _SHORT_S = 3600.0, 5.0
_SETTLED = 1 / 6
"""Part of the session after which memory is first measured: by then all code has run once."""
_MOST_GROWTH_MB = 20.0
_INDEX_MB = 0.8e-3
"""Memory that the writer of MCAP keeps for each chunk until it writes the index at the end: some 0.8 kB."""
_ENDS = ("steps_applied", "steps_late", "steps_superseded", "steps_refused", "steps_not_reported")


def closed_loop_soak(effort: Effort) -> Row:
    """`lqg` with `o1` on the rig `loop` over pseudo terminals; a frame or step that is not accounted for ends the row
    with an error."""
    rig = load_rig("loop")
    period_s = rig.timing.frame_period_steps * rig.timing.fast_step_s
    exposures = round((_HOUR_S if effort.share >= 1 else _SHORT_S) / period_s)
    settled_mb, begun_s = 0.0, time.monotonic()

    def progress(so_far: int) -> None:
        nonlocal settled_mb
        if not settled_mb and so_far >= _SETTLED * exposures:
            settled_mb = resident_mb()

    with TemporaryDirectory() as name:
        folder = Path(name)
        file, path = folder / "rig.toml", folder / "a.mcap"
        file.write_text(rig.toml)
        with simulated_rig(file, "--real-time") as ports:
            report = record(
                load_rig(file), *ports, path, estimators=["o1"], control="lqg", exposures=exposures, progress=progress
            )
        growth_mb = resident_mb() - settled_mb  # before the recording is read, which takes memory of its own
        recorded, size_mb = len(Recording(path)), path.stat().st_size / 1e6
        with path.open("rb") as recording:
            summary = make_reader(recording).get_summary()
        assert summary is not None
        index_mb = _INDEX_MB * len(summary.chunk_indexes)
    lost = report.frames_lost + report.frames_incomplete + abs(exposures - recorded)
    unaccounted = report.steps_commanded - sum(getattr(report, end) for end in _ENDS)
    skipped = report.estimation["o1"].skipped
    if (report.ended, lost, unaccounted) != ("complete", 0, 0):
        raise AssertionError(f"it ended as {report.ended}, {lost} frames lost, {unaccounted} steps without an account")
    return Row(
        f"closed loop, lqg + o1, {time.monotonic() - begun_s:.0f} s in real time: growth of memory;"
        f" {recorded} exposures of {exposures}, {report.steps_commanded} steps commanded, {report.steps_late} late,"
        f" 0 without an account, {skipped} estimates skipped, {size_mb:.0f} MB recorded",
        f"{growth_mb:.1f} MB", f"limit {_MOST_GROWTH_MB:g} MB and the recording's index, {index_mb:.0f} MB",
        (_MOST_GROWTH_MB + index_mb) / max(growth_mb, 0.1), 1.0,
    )  # fmt: skip
