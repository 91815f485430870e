"""A closed loop on a simulated rig in memory: the session's loop without its wire, as fast as it goes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from aolink.control import Act, ControlLoop
from aolink.estimation import Driver, Estimate
from aolink.exposure import Exposure
from aolink.rig import Rig
from aolink.simulation.model import RigModel, exposure_of


class Closed(NamedTuple):
    """One exposure of a closed loop."""

    exposure: Exposure
    """With its truth: ``exposure.truth.path`` is the residual slopes at each fast step."""
    estimate: Estimate | None
    act: Act | None
    """None where no controller closes the loop."""


def closed_loop(
    rig: Rig, controller: str, estimator: str, exposures: int, *, seed: int | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[Closed]:  # fmt: skip
    """The exposures of a simulated rig whose loop is closed, as a session on virtual time has them.

    Parameters
    ----------
    controller:
        Its name; empty to leave the loop open, with the mirror at its safe input.
    estimator:
        The estimator that serves it; empty for none.
    seed:
        Of the rig; the rig file's own where None.

    Raises
    ------
    ControlError, EstimatorError
        There is no such controller or estimator, or it cannot work on this rig.
    """
    timing, model = rig.timing, RigModel(rig, seed)
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
