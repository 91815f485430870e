"""The exposure intervals of a camera that exposes its rows one after the other.

An exposure starts with the row that starts first, and each row has an interval of its own, as long as the exposure. The
interval of a spot is that of the middle row of its window, rounded to whole fast steps. This is the only place where
intervals become the model's steps:

- Copies of the plant that move one spot each have their own time: the state of an axis is that at the start of its own
  interval, and an exposure has the inputs of each axis from there on.
- Where one plant moves several spots, an exposure covers the steps from the first spot's interval to the last one's,
  and `Plant.delays` says where in it each output is seen.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from aolink.errors import RigError
from aolink.numerics.arrays import FloatArray, Indices
from aolink.optics.sensor import BaseSensor
from aolink.rig.parts import Plant, Timing

if TYPE_CHECKING:
    from aolink.rig.file import Rig

_MOST_NUMBERS = 20_000_000
"""Outputs times states times steps of a plant whose outputs have intervals of their own; 160 MB."""


def output_delays(sensor: BaseSensor, timing: Timing) -> Indices:
    """Fast steps from the start of an exposure to that of each output's own interval, (n_outputs of the rig,)."""
    steps = np.rint(sensor.spot_starts_s / timing.fast_step_s).astype(np.intp)
    return np.repeat(steps, sensor.directions)


def readout_steps(starts_s: FloatArray, timing: Timing) -> int:
    """Fast steps from the last step of the first row's exposure to that of the last row's."""
    last = round(float(starts_s.max()) / timing.fast_step_s, 6)
    return math.ceil(last + timing.exposure_offset) if last else 0


def with_delays(plant: Plant, sensor: BaseSensor, timing: Timing) -> Plant:
    """The plant with the delays of its outputs, where it moves several spots and they are not seen at once.

    Raises
    ------
    RigError
        The copies of the plant differ in them, the windows of successive frames overlap, or the model would be too
        large.
    """
    delays = output_delays(sensor, timing).reshape(plant.axes, plant.n_outputs)
    own = delays - delays.min(axis=1, keepdims=True)
    if not own.any():
        return plant
    if (own != own[0]).any():
        raise RigError(
            f"sensor.row_time_s: the {plant.axes} copies of the plant see their spots in different rows, so that one"
            " model does not do for all: give each spot a copy of its own"
        )
    last = int(own.max())
    if timing.exposure_steps + last > timing.frame_period_steps:
        raise RigError(
            f"sensor.row_time_s: one plant moves spots whose exposures begin up to {last} fast steps apart, and with"
            f" timing.exposure_steps = {timing.exposure_steps} they reach into the next frame's: this needs"
            f" timing.frame_period_steps of at least {timing.exposure_steps + last}"
        )
    if plant.n_outputs * plant.n_states * (timing.exposure_steps + last) > _MOST_NUMBERS:
        raise RigError(
            f"sensor.row_time_s: one plant of {plant.n_states} states moves {plant.n_outputs // 2} spots that are"
            " exposed row by row, which is modelled for smaller plants only: use a global shutter, or fewer actuators"
        )
    return replace(plant, delays=tuple(own[0].tolist()))


def inputs_by_axis(plant: Plant, delays: Indices, inputs: FloatArray, first: int, n_steps: int) -> FloatArray:
    """The inputs of each axis in its own interval, (n_steps, axes * n_inputs).

    Parameters
    ----------
    delays:
        Steps by which each axis is later, (axes,).
    inputs:
        Inputs of the rig from some step on; the mirror is at rest, with inputs of zero, before it.
    first:
        Row of ``inputs`` at which the result begins for an axis without a delay; may be negative.
    """
    if not delays.any() and first >= 0:
        return inputs[first : first + n_steps]
    out = np.zeros((n_steps, plant.axes, plant.n_inputs))
    each = inputs.reshape(len(inputs), plant.axes, plant.n_inputs)
    for axis, delay in enumerate(delays.tolist()):
        start = first + delay
        before = min(max(0, -start), n_steps)
        out[before:, axis] = each[start + before : start + n_steps, axis]
    return out.reshape(n_steps, inputs.shape[1])


def possible_skew_ns(rig: Rig) -> FloatArray:
    """Standard deviation of the start of each axis's own interval where the row time is not known, ns, (axes,).

    A camera reads a frame out in a frame period at most, from the top or from the bottom: the start of the middle row
    of a spot's window is uniformly distributed over as much of the period, before or after, as the window is down.
    """
    sensor, timing = rig.sensor, rig.timing
    rows = [sensor.window_of(spot)[0] for spot in range(sensor.spots)]
    middle = np.array([(each.start + each.stop - 1) / 2 for each in rows]) / sensor.shape[0]
    of_output = np.repeat(middle, sensor.directions).reshape(rig.plant.axes, -1)
    period_ns = timing.frame_period_steps * timing.fast_step_ns
    return np.asarray(of_output.max(axis=1) * period_ns / math.sqrt(3))
