"""A closed loop on a simulated rig in memory: the session's loop without its wire, as fast as possible."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from aolink.control import Act, ControllerRow, ControlLoop, State, find_controller, stability
from aolink.control.loop import check_exposed_at_once
from aolink.errors import RecordingError
from aolink.estimation import Driver, Estimate
from aolink.exposure import Exposure, residual_rms
from aolink.numerics.rms import rms
from aolink.recording.reader import Recording
from aolink.rig import Rig
from aolink.session.replay import would_command
from aolink.simulation.devices import FIRMWARE
from aolink.simulation.model import RigPhysics, exposure_of

_SIMULATED = re.compile(rf" ([0-9a-f]{{8}})-(\d+) \({re.escape(FIRMWARE)}\)$")
"""Serial number and firmware of a simulated camera, in its description."""


class Closed(NamedTuple):
    """One exposure of a closed loop."""

    exposure: Exposure
    """The exposure with its truth: ``exposure.truth.path`` is the residual slopes at each fast step."""
    estimate: Estimate | None
    act: Act | None
    """The controller's act; None where no controller closes the loop."""


def seed_of(recording: Recording) -> int | None:
    """Seed of the simulated rig that made a recording; None where its rig file does not describe the rig that made
    it."""
    if (found := _SIMULATED.search(recording.metadata.get("camera", ""))) is None:
        return None
    return int(found[2]) if recording.rig.digest.startswith(found[1]) else None


def closed_loop(
    rig: Rig, controller: str | ControllerRow, estimator: str, exposures: int, *, seed: int | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[Closed]:  # fmt: skip
    """The exposures of a simulated rig whose loop is closed, as a session on virtual time has them.

    Parameters
    ----------
    controller:
        Its name, or its row; empty to leave the loop open, with the mirror at its safe input.
    estimator:
        The estimator that serves it; empty for none.
    seed:
        Seed of the rig; the rig file's own where None.

    Raises
    ------
    ControlError, EstimatorError
        There is no such controller or estimator, or it cannot work on this rig.
    """
    check_exposed_at_once(rig)
    timing, model = rig.timing, RigPhysics(rig, seed)
    loop = ControlLoop(rig, controller) if controller else None
    driver = Driver(rig, [estimator] if estimator else [])
    model.start_camera(0, exposures)
    held = rig.mirror.quantise(rig.mirror.park)[None]
    lead = held[:0]
    for number in range(exposures):
        if stop():
            return
        begin = number * timing.frame_period_steps
        end = begin + timing.exposure_steps
        since = end - model.step
        u = held.repeat(since, axis=0) if loop is None else rig.mirror.quantise(loop.inputs(model.step, since))
        (frame,) = model.advance(u)
        u = u if number == 0 else u[-timing.frame_period_steps :]
        lead, inputs = u[: -timing.exposure_steps], u[-timing.exposure_steps :]
        exposure = exposure_of(rig, frame, inputs, lead)
        estimate = next(iter(driver.step(exposure)), None)
        yield Closed(exposure, estimate, None if loop is None else loop.see(exposure, estimate, end))


@dataclass(frozen=True, kw_only=True)
class Replayed:
    """The commands of a controller in a recorded session, and the slopes that it would have left."""

    controller: str
    estimator: str
    """The estimator that served the controller; empty for none."""
    exposures: int
    open_exposures: int
    """Exposures with which the loop would have been open."""
    input_rms: float
    """Root mean square of the inputs that it would have commanded, less the safe input."""
    difference_rms: float
    """Root mean square of their difference from the inputs that the mirror held; NaN where the recording lacks
    these."""
    stability: str
    seed: int | None
    """Seed of the simulated rig; None where the recording is not of one, and the fields below are NaN."""
    recorded_rms: float
    """Residual slopes in the recording, root mean square at the fast rate, slope units."""
    open_rms: float = math.nan
    """The same with the mirror at its safe input."""
    closed_rms: float = math.nan
    """The same with the loop closed by this controller, from the same seed."""


def replayed(
    recording: Recording, controller: str, estimator: str, stop: Callable[[], bool], progress: Callable[[int], None]
) -> Replayed:
    """Compute the commands of a controller in a recorded session; on a simulated rig, close its loop from the same
    seed.

    Raises
    ------
    ControlError, EstimatorError
        There is no such controller or estimator, or it cannot work on this rig.
    RecordingError
        There is no exposure.
    """
    rig = recording.rig
    found = stability(rig, controller)
    acts, wanted, differences = [], [], []
    for each in would_command(recording, controller, estimator, stop=stop):
        acts.append(each.act)
        wanted.append(each.inputs - rig.mirror.park)
        differences.append(each.inputs[: len(each.recorded)] - each.recorded)
        progress(len(acts))
    if not acts:
        raise RecordingError(f"{recording.path} holds no exposures")
    served = estimator if find_controller(controller, rig).needs_state else ""
    seed, runs = seed_of(recording), {}
    if seed is not None:
        for name, of, by in (("open_rms", "", ""), ("closed_rms", controller, served)):
            series = closed_loop(rig, of, by, len(acts), seed=seed, stop=stop)
            runs[name] = residual_rms(each.exposure for each in series)
    return Replayed(
        controller=controller, estimator=served, exposures=len(acts),
        open_exposures=sum(act.state is not State.CLOSED for act in acts), input_rms=rms(np.concatenate(wanted)),
        difference_rms=rms(np.concatenate(differences)), stability=found.text(), seed=seed,
        recorded_rms=residual_rms(recording.exposures()), **runs,
    )  # fmt: skip
