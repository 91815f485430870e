"""The check whether a loop is stable by its model, and with what margin, before anything is commanded."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import repeat

import numpy as np

from aolink.control.checked import CheckedController
from aolink.control.controller import Controller, ControllerRow, Seen
from aolink.control.loop import delay_steps
from aolink.control.modes import reached
from aolink.control.registry import find_controller
from aolink.errors import ControlError
from aolink.estimation import exposure_model
from aolink.estimation.frames.centroid_noise import centroid_covariance
from aolink.estimation.kalman.steady_gain import steady_gain
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig

_EXPOSURES = 40
"""Exposures over which a disturbed loop is computed; its growth is that of the second half."""
_MOST_GAIN = 16.0
"""Margins beyond this factor are not searched for."""
_HALVINGS = 5
_SWING = 5
_SETTLED = 1e-9
_BURST = 1e6
"""A loop that has fallen to the first share of its beginning has settled, and one that has grown to the second never
will."""
_BEYOND = 1e100
"""A loop that has grown to this has no growth that can be computed: the next number may be none."""


@dataclass(frozen=True, kw_only=True)
class Stability:
    """The stability of a closed loop by its model."""

    radius: float
    """Factor by which a disturbed loop grows from one exposure to the next; below 1 it is stable."""
    gain_margin: float
    """Factor by which the mirror's gain may be larger than the plant's before the loop is unstable, `_MOST_GAIN` at
    most; for a loop that is unstable, the factor below 1 at which it would be stable, or 0 where none was found."""

    @property
    def stable(self) -> bool:
        return self.radius < 1

    def text(self) -> str:
        bound = f"up to {self.gain_margin:.3g} times" if self.stable else f"below {self.gain_margin:.2g} times"
        return (
            f"by the model a disturbance is {self.radius:.3f} times as large one exposure later, and the loop is stable"
            f" with {bound} the mirror's gain"
        )


def stability(rig: Rig, name: str) -> Stability:
    """Compute the loop of a controller by the plant's model, without noise and limits.

    The true mirror has its states disturbed and its gain changed, while the controller and the estimator that serves it
    use the plant of the rig file. That estimator is the filter on centroids with its steady gain.

    Raises
    ------
    ControlError
        There is no such controller, it fails or gives something that is no input of this rig, or there is no steady
        gain for this plant.
    """
    grows = partial(_growth, rig, find_controller(name, rig), _observer_gain(rig))
    radius = grows(1.0)
    low, high = (1.0, _MOST_GAIN) if radius < 1 else (1 / _MOST_GAIN, 1.0)
    if radius < 1 and grows(high) < 1:
        return Stability(radius=radius, gain_margin=high)
    if radius >= 1 and grows(low) >= 1:
        return Stability(radius=radius, gain_margin=0.0)
    for _ in range(_HALVINGS):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if grows(middle) < 1 else (low, middle)
    return Stability(radius=radius, gain_margin=low)


def check_stable(rig: Rig, name: str) -> Stability:
    """The result of `stability`; raises ControlError for a loop that would be unstable, with its margin."""
    found = stability(rig, name)
    if not found.stable:
        raise ControlError(
            f"the loop of {name} on {rig.name} is unstable: {found.text()}; change [control] in the rig file (gain,"
            " effort, delay_s), or close it all the same with --force"
        )
    return found


def _observer_gain(rig: Rig) -> FloatArray:
    """Gain of the correction of the state at an exposure's end by its centroids, (n_states, n_outputs)."""
    model = exposure_model(rig.plant, rig.timing.exposure_steps, rig.timing.exposure_offset)
    gain = steady_gain(model, model.process_noise, centroid_covariance(rig)[0])
    if gain is None:
        raise ControlError(f"the loop on {rig.name} cannot be checked: its centroids lose a state that does not decay")
    return np.asarray(model.transition @ gain)


def _growth(rig: Rig, row: ControllerRow, gain: FloatArray, of_mirror: float) -> float:
    """Factor by which a disturbance grows in an exposure, with a true mirror of ``of_mirror`` times the gain."""
    moved, _ = reached(rig.plant)
    start = np.zeros((rig.plant.axes, rig.plant.n_states))
    start[:, moved] = np.random.default_rng(0).standard_normal((len(start), len(moved)))
    disturbed = _followed(rig, CheckedController(row, rig), gain, of_mirror, start)
    # An undisturbed loop may move by itself where its safe input is not zero: this motion is subtracted.
    alone: Iterator[FloatArray] = repeat(np.zeros(1))
    if rig.mirror.park.any():
        alone = _followed(rig, CheckedController(row, rig), gain, of_mirror, np.zeros_like(start))
    sizes: list[float] = []
    for one, other in zip(disturbed, alone, strict=False):
        size = math.hypot(*(one - other))  # numpy's norm squares, and would overflow earlier
        if sizes and not size < _BEYOND * sizes[0]:
            return math.inf
        sizes.append(size)
        if len(sizes) > _SWING and not _SETTLED < max(sizes[-_SWING:]) / sizes[0] < _BURST:
            break
    # Maxima over some exposures, because a loop may swing as it shrinks or grows.
    middle, last = (max(sizes[k - _SWING : k]) for k in (max(len(sizes) // 2, _SWING), len(sizes)))
    return float((last / middle) ** (1 / (len(sizes) - max(len(sizes) // 2, _SWING))))


def _followed(
    rig: Rig, controller: Controller, gain: FloatArray, of_mirror: float, start: FloatArray
) -> Iterator[FloatArray]:
    """Slopes at the end of each exposure, and their means in it, (2 n_outputs,)."""
    plant, timing, delay = rig.plant, rig.timing, delay_steps(rig)
    A, B, C = plant.A.T.copy(), plant.B.T.copy(), plant.C.T.copy()
    true, believed, u = start, np.zeros_like(start), rig.mirror.park
    recent: deque[FloatArray] = deque([u] * delay, maxlen=delay)
    waiting: tuple[FloatArray, FloatArray] | None = None
    acting, due = False, 0
    means = np.zeros((2, plant.axes, plant.n_outputs))
    for step in range(_EXPOSURES * timing.frame_period_steps + delay):
        k = step % timing.frame_period_steps
        if k == timing.exposure_steps % timing.frame_period_steps and step >= timing.exposure_steps:
            y, expected = means / timing.exposure_steps
            believed = believed + (y - expected) @ gain.T
            waiting, due = (y.ravel(), believed), step + delay
            yield np.concatenate([(true @ C).ravel(), y.ravel()])
            means[:] = 0
        if waiting is not None and step == due:
            slopes, state = waiting
            controller.see(Seen(slopes=slopes, state=state, pending=np.array(recent)))
            waiting, acting = None, True
        if acting:
            u = controller.step(u)
        recent.append(u)
        if k < timing.exposure_steps:
            means[0] += true @ C
            means[1] += believed @ C
        pushed = u.reshape(plant.axes, -1) @ B
        true, believed = true @ A + of_mirror * pushed, believed @ A + pushed
