"""Lanes of states, and warnings: when the camera exposed, how each exposure was used, and what went wrong."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import rerun as rr

from aolink.estimation.estimate import Estimate, Status
from aolink.exposure import Exposure
from aolink.viewing.entities import STATUS, WARNINGS
from aolink.viewing.series import Drawing, send_states
from aolink.viewing.timebase import Timebase

_REFUSED = {
    Status.GATED: "gated",
    Status.DIVERGED: "diverged",
    Status.REINITIALISED: "begun anew",
    Status.INPUT_INVALID: "not usable",
}
"""Words for an estimate whose exposure was not used normally."""


def log_exposures(
    drawing: Drawing, timebase: Timebase, exposures: Sequence[Exposure], before: Exposure | None = None
) -> None:
    """Each exposure as an interval from its start to its end, and the frames that never came: ``/status/exposure``.

    Parameters
    ----------
    before:
        The exposure before the first of them, where there was one.
    """
    steps: list[int] = []
    states: list[str] = []
    for last, exposure in zip([before, *exposures], exposures, strict=False):
        if last is not None:
            end = last.first_step + last.n_steps
            if exposure.frame_id > last.frame_id + 1:
                steps.append(max(end, int(timebase.step_of_frame(last.frame_id + 1))))
                states.append("LOST")
            if end < (steps[-1] if states and states[-1] == "LOST" else exposure.first_step):
                steps.append(end)
                states.append("READOUT")
        steps.append(exposure.first_step)
        states.append("NEXT EXPOSURE" if exposure.frame_id % 2 else "EXPOSURE")
    order = sorted(range(len(steps)), key=steps.__getitem__)
    send_states(drawing, f"{STATUS}/exposure", timebase, [steps[k] for k in order], [states[k] for k in order])


def log_status(
    drawing: Drawing, timebase: Timebase, name: str, exposures: Sequence[Exposure],
    estimates: Mapping[int, Estimate], skipped: Collection[int] = (),
) -> None:  # fmt: skip
    """The status of each exposure in an estimator: ``/status/NAME``.

    Parameters
    ----------
    estimates:
        Estimates by frame id.
    skipped:
        Frames that it had no time for in the session.
    """
    known = [
        (e.first_step, "SKIPPED" if e.frame_id in skipped else estimates[e.frame_id].status.name)
        for e in exposures
        if e.frame_id in skipped or e.frame_id in estimates
    ]
    send_states(drawing, f"{STATUS}/{name}", timebase, [step for step, _ in known], [state for _, state in known])


def log_warnings(
    drawing: Drawing, timebase: Timebase, exposures: Sequence[Exposure],
    estimates: Mapping[str, Mapping[int, Estimate]], skipped: Mapping[str, Collection[int]],
    before: Exposure | None = None,
) -> int:  # fmt: skip
    """Warnings in words, on the timelines: ``/warnings``; gives how many there are.

    They are about frames lost or incomplete, inputs that the mirror did not report, exposures that an estimator gated,
    could not use or had no time for, those in which it diverged or began anew, and its verdicts on the model.
    """
    said: list[tuple[Exposure, str]] = []
    for last, e in zip([before, *exposures], exposures, strict=False):
        if last is not None and (lost := e.frame_id - last.frame_id - 1) > 0:
            said.append((e, f"{lost} frame{'s' if lost > 1 else ''} lost before frame {e.frame_id}"))
        if e.slopes is None and not e.mask.all():
            said.append((e, f"frame {e.frame_id} is incomplete: {1 - e.mask.mean():.0%} of its pixels never came"))
        if e.inputs_assumed:
            said.append((e, f"frame {e.frame_id}: the mirror did not report its input in {e.inputs_assumed} steps"))
        for name, by_frame in estimates.items():
            if e.frame_id in skipped.get(name, ()):
                said.append((e, f"{name} had no time for frame {e.frame_id}"))
            found = by_frame.get(e.frame_id)
            if found is not None and found.verdict is not None and found.verdict.begins_with(e.frame_id):
                said.append((e, f"{name}: frame {e.frame_id}: {found.verdict.text}"))
            if found is not None and found.status in _REFUSED:
                why = f": {found.reason}" if found.reason else ""
                said.append((e, f"{name}: frame {e.frame_id} {_REFUSED[found.status]}{why}"))
    if said:
        times = timebase.at_steps([e.first_step for e, _ in said], [e.frame_id for e, _ in said])
        drawing.send_columns(WARNINGS, times, rr.TextLog.columns(text=[s for _, s in said], level=["WARN"] * len(said)))
    return len(said)
