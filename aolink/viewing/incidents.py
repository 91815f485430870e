"""Lanes of states, and warnings: when the camera exposed, how each exposure was used, and what went wrong."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

import rerun as rr

from aolink.exposure import Exposure
from aolink.gathered import incidents_of
from aolink.series import Step
from aolink.viewing.entities import STATUS, WARNINGS
from aolink.viewing.series import Drawing, send_states
from aolink.viewing.timebase import Timebase


def log_exposures(
    drawing: Drawing, timebase: Timebase, exposures: Sequence[Exposure], before: Exposure | None = None
) -> None:
    """Each exposure as an interval from its start to its end, and the frames that never came: ``/status/exposure``.

    Parameters
    ----------
    before:
        The exposure before the first of them, where there was one.
    """
    found: list[tuple[int, str]] = []
    for last, exposure in zip([before, *exposures], exposures, strict=False):
        following = exposure.first_step
        if last is not None:
            end = last.first_step + last.n_steps
            if exposure.frame_id > last.frame_id + 1:
                following = max(end, int(timebase.step_of_frame(last.frame_id + 1)))
                found.append((following, "LOST"))
            if end < following:
                found.append((end, "READOUT"))
        found.append((exposure.first_step, "NEXT EXPOSURE" if exposure.frame_id % 2 else "EXPOSURE"))
    found.sort(key=lambda each: each[0])
    send_states(drawing, f"{STATUS}/exposure", timebase, found)


def log_status(drawing: Drawing, timebase: Timebase, name: str, steps: Sequence[Step]) -> None:
    """The status of each exposure in an estimator: ``/status/NAME``."""
    states = [
        (each.exposure.first_step, "SKIPPED" if name in each.skipped else each.estimates[name].status.name)
        for each in steps
        if name in each.skipped or name in each.estimates
    ]
    send_states(drawing, f"{STATUS}/{name}", timebase, states)


def log_warnings(drawing: Drawing, timebase: Timebase, steps: Sequence[Step], before: Exposure | None = None) -> int:
    """What went wrong (`incidents_of`) in words, on the timelines: ``/warnings``; gives how many warnings there are."""
    said = [
        (each.exposure.first_step, each.exposure.frame_id, text)
        for last, each in zip(chain([before], (each.exposure for each in steps)), steps, strict=False)
        for _, text in incidents_of(last, each)
    ]
    if said:
        at, frames, texts = zip(*said, strict=True)
        columns = rr.TextLog.columns(text=texts, level=["WARN"] * len(said))
        drawing.send_columns(WARNINGS, timebase.at_steps(at, frames), columns)
    return len(said)
