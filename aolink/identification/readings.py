"""The measurements for identification: two weighted sums of the pixels for each slope in each exposure.

A spot at theta gives a weighted sum g(theta) = sum_i W_i (kernel integrated over pixel i). The weights are those of
least noise for which g is theta - c, and (theta - c)^2, wherever the spot moves; c is the expected position of the
spot. So the sums are the mean of the path in the exposure and its mean square about c, without the effect of kernel and
pixels, with the noise of the pixels that are needed and of no others. They are linear in the pixels, so that their
noise is Gaussian.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg

from aolink.errors import IdentificationError
from aolink.estimation.frames.frame_data import HALF, Needs, Profile
from aolink.estimation.frames.measure import measure
from aolink.exposure import Exposure
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.camera import effective_noise_density, shot_gain
from aolink.optics.kernel import pixel_masses
from aolink.optics.sensor import RegionSensor, Sensor
from aolink.plant.lifting import input_response, output_rows
from aolink.rig import Rig

FEWEST = 24
"""Fewest exposures from which a model is identified."""
_REACH = 4.0
"""The spot moves within this many standard deviations of its path about c: the weights are right up to there."""
_WRONG = 2e-3
"""Largest rms error of g there, in units of the path's standard deviation and its square."""
_HIDDEN = 0.05
"""The same in standard deviations of a sum by the pixels' noise; the larger of the two limits applies."""
_POINTS = 61
_ROUNDS = 4
_FOLLOWED = 0.6
"""Weights follow the spot if that makes its motion about them smaller by this factor."""
_LEAST_MOTION = 0.15
"""Least standard deviation of a path that weights are made for, in those of the kernel."""
_FEWEST_STEPS = 8
"""Fast steps in an exposure from which on their number does not matter: with N instants instead of an integral, a
random walk's means gain 1/(2 N^2) of variance."""
_SEEN, _EXACT, _LEAST_LIGHT = 4.0, 0.02, 0.2
"""The light is measured where its deviations from one have their neighbours' sign more often than chance allows by this
many standard deviations, and are larger than the second value; with less than the last there is no spot to speak of."""
_MISSING = 0.05
"""Share of the weights' noise that may be in pixels that did not arrive."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """What the readings are made from, (outputs, slots, pixels)."""

    sensor: Sensor
    density: FloatArray
    """Divided by ``light``."""
    mask: BoolArray
    light: FloatArray | None
    """Light of each exposure, (outputs, slots), where it is measured; None where it is one, as the rig file says."""

    def noise(self, W: FloatArray, o: int, k: int) -> FloatArray:
        """Variances of weighted sums in one exposure by the pixels' noise."""
        sensor, y = self.sensor, self.density[o, k]
        D, light = sensor.pixel_width, 1.0
        if self.light is not None:
            light = float(self.light[o, k])
            W = W - (W @ y * D)[:, None]  # noise of the light is noise of the quotient
        pixel = effective_noise_density(sensor) / D + shot_gain(sensor) * np.maximum(light * y, 0.0)
        return np.asarray((W**2) @ pixel * D**2 / light**2)


@dataclass(frozen=True, eq=False)
class Readings:
    """The readings of a recording's exposures, in slots at equal distances, some of them perhaps empty.

    Arrays are (outputs, slots): an output is a slope of one copy of the plant.
    """

    step_s: float
    """Fast step, s."""
    n_steps: int
    """N, fast steps in one exposure."""
    period_steps: int
    """Fast steps from slot to slot."""
    mean: FloatArray
    """Mean of the path in the exposure about ``centre``, slope units."""
    square: FloatArray
    """Mean square of the path about ``centre``, slope units squared."""
    mean_noise: FloatArray
    """Variance of ``mean`` by the pixels' noise."""
    square_noise: FloatArray
    centre: FloatArray
    """c, slope units."""
    usable: BoolArray
    """False where there is no exposure, or where it showed no spot."""
    response: FloatArray
    """Response of the output to the inputs at each fast step, by the known plant, (outputs, slots, N + 1)."""
    inputs: FloatArray
    """Inputs of the copy of the plant that the output belongs to, at each fast step from the first slot on, (outputs,
    n_inputs, steps)."""
    offset: float
    """How far into a fast step the exposures start, in fast steps."""
    motion: float
    """Standard deviation of the path about c, slope units."""
    follows: bool
    """Whether c follows the spot: it is the response to the inputs plus the residual of the exposure before, or
    otherwise plus a constant."""
    reach: float
    """Half of the sensor's field, slope units."""

    @property
    def slots(self) -> int:
        return int(self.mean.shape[1])

    def part(self, first: int, end: int) -> Readings:
        """The slots from ``first`` up to ``end``."""
        steps = slice(first * self.period_steps, end * self.period_steps)
        own = {name: getattr(self, name)[:, first:end] for name in _OF_SLOTS}
        return replace(self, inputs=self.inputs[:, :, steps], **own)

    def of_outputs(self, which: Sequence[int]) -> Readings:
        """The readings of some of the outputs."""
        return replace(self, **{name: getattr(self, name)[list(which)] for name in (*_OF_SLOTS, "inputs")})


_OF_SLOTS = ("mean", "square", "mean_noise", "square_noise", "centre", "usable", "response")


def readings(rig: Rig, exposures: Sequence[Exposure], *, plant_known: bool = True) -> Readings:
    """The readings of a recording's exposures.

    Parameters
    ----------
    plant_known:
        Whether the inputs' response is that of the rig's plant; if not, no response is part of the expected position.

    Raises
    ------
    IdentificationError
        There are too few exposures, they have no pixels, or their lengths differ.
    """
    if len(exposures) < FEWEST:
        raise IdentificationError(
            f"{len(exposures)} exposures are too short a recording to identify a model from: {FEWEST} or more are"
            " needed"
        )
    if any(each.slopes is not None for each in exposures):
        raise IdentificationError("the recording holds slopes and no pixels: identification needs the blur")
    if isinstance(rig.sensor, RegionSensor):
        raise IdentificationError(
            f"{rig.name} sees a region, and this identifies by spots: `aolink look FILM` takes both"
        )
    if rig.plant.delays:
        raise IdentificationError(
            "one plant moves several spots that the camera exposes row by row (sensor.row_time_s): identify it from a"
            " recording of a global shutter"
        )
    n_steps = exposures[0].n_steps
    if any(each.n_steps != n_steps for each in exposures):
        raise IdentificationError("exposures of several lengths: cut the recording where the length changes")
    starts = np.array([each.first_step for each in exposures])
    period = max(n_steps, rig.timing.frame_period_steps)
    slot = np.rint((starts - starts[0]) / period).astype(int)
    if (np.diff(slot) < 1).any() or (np.abs(starts - starts[0] - slot * period) > 0.02 * n_steps).any():
        raise IdentificationError(f"exposures do not start every {period} fast steps, as the rig file says")
    slots = int(slot[-1]) + 1
    inputs = _inputs(rig, exposures, slots * period)
    density = np.zeros((rig.n_outputs, slots, rig.sensor.profile.pixels))
    mask = np.zeros(density.shape, dtype=bool)
    needs = Needs(what="profile", least_usable=HALF)
    for k, exposure in zip(slot, exposures, strict=True):
        found, _ = measure(rig, exposure, needs)
        if isinstance(found, Profile):
            density[:, k], mask[:, k] = found.density, found.mask
            if found.usable is not None:
                mask[~np.repeat(found.usable, rig.plant.n_outputs), k] = False
    if (showing := int(mask.any(axis=(0, 2)).sum())) < FEWEST:
        raise IdentificationError(f"{showing} exposures show a spot, {FEWEST} or more are needed")
    response = np.zeros((rig.n_outputs, slots, n_steps + 1))
    if plant_known:
        response = _response(rig, inputs, slots, n_steps, period, exposures[0].start_offset)
    empty = np.zeros(density.shape[:2])
    blank = Readings(
        step_s=rig.timing.fast_step_s, n_steps=n_steps, period_steps=period, mean=empty, square=empty,
        mean_noise=empty, square_noise=empty, centre=empty, usable=np.asarray(mask.any(axis=2)), response=response,
        inputs=np.repeat(inputs, rig.plant.n_outputs, axis=0), offset=exposures[0].start_offset, motion=0.0,
        follows=False, reach=(rig.sensor.field[1] - rig.sensor.field[0]) / 2,
    )  # fmt: skip
    seen = _lit(rig.sensor.profile, density, mask)
    return _divided(_measured(seen, blank))


def _lit(sensor: Sensor, density: FloatArray, mask: BoolArray) -> _Seen:
    """Densities divided by their light, if they show that it is not always one: all readings are proportional to it."""
    light, whole = density.sum(axis=2) * sensor.pixel_width, np.asarray(mask.all(axis=2))
    off, both = light - 1, whole[:, 1:] & whole[:, :-1]
    # Noise differs from exposure to exposure, light lasts. A spot that leaves the sensor now and then loses light too:
    # signs and medians do not count how much.
    pairs = (off[:, 1:] * off[:, :-1])[both]
    lasting = int((pairs > 0).sum()) - len(pairs) / 2 > _SEEN * math.sqrt(len(pairs)) / 2
    if not lasting or float(np.median(np.abs(off[whole]))) < _EXACT:
        return _Seen(sensor, density, mask, None)
    usual = float(np.median(light[whole]))
    light = np.where(whole & (light > _LEAST_LIGHT), light, usual)
    return _Seen(sensor, density / light[:, :, None], mask, light)


def _divided(found: Readings) -> Readings:
    """Readings with fast steps divided where exposures have few: a camera integrates over a fast step as well."""
    parts = -(-_FEWEST_STEPS // found.n_steps)
    if parts == 1 or found.offset:
        return found
    held, last = np.repeat(found.response[:, :, :-1], parts, axis=2), found.response[:, :, -1:]
    return replace(
        found, step_s=found.step_s / parts, n_steps=found.n_steps * parts, period_steps=found.period_steps * parts,
        response=np.concatenate([held, last], axis=2), inputs=np.repeat(found.inputs, parts, axis=2),
    )  # fmt: skip


def _inputs(rig: Rig, exposures: Sequence[Exposure], steps: int) -> FloatArray:
    """Inputs at each fast step from the first exposure on, (axes, n_inputs, steps); held where they are not known."""
    first = exposures[0].first_step
    u = np.full((steps, rig.n_inputs), np.nan)
    for each in exposures:
        values = np.concatenate([each.lead_inputs, each.inputs])
        start = each.first_step - len(each.lead_inputs) - first
        begin, end = max(start, 0), min(start + len(values), steps)
        if end > begin:
            u[begin:end] = values[begin - start : end - start]
    known = np.isfinite(u).all(axis=1)
    held = np.maximum.accumulate(np.where(known, np.arange(steps), 0))
    u = np.nan_to_num(u[held])
    return np.ascontiguousarray(u.reshape(steps, rig.plant.axes, -1).transpose(1, 2, 0))


def _response(rig: Rig, inputs: FloatArray, slots: int, n_steps: int, period: int, offset: float) -> FloatArray:
    """Response of the outputs in each slot, (outputs, slots, N + 1), by the plant without its noise."""
    plant = rig.plant
    rows, transition = output_rows(plant, period), np.linalg.matrix_power(plant.A, period)
    state = np.tile(plant.initial_mean, (plant.axes, 1))
    out = np.empty((plant.axes, plant.n_outputs, slots, period))
    for k in range(slots):
        c, d = input_response(plant, inputs[:, :, k * period : (k + 1) * period].transpose(0, 2, 1))
        out[:, :, k] = c + np.einsum("oin,an->aoi", rows, state)
        state = state @ transition.T + d
    after = (state @ plant.C.T)[:, :, None]
    flat = np.concatenate([out.reshape(plant.axes, plant.n_outputs, -1), after], axis=2)
    return by_slot(flat.reshape(rig.n_outputs, -1), slots, n_steps, period, offset)


def by_slot(path: FloatArray, slots: int, n_steps: int, period: int, offset: float) -> FloatArray:
    """Outputs at each fast step and one more (outputs, steps + 1), divided into exposures, (outputs, slots, N + 1)."""
    if offset:
        path = np.concatenate([(1 - offset) * path[:, :-1] + offset * path[:, 1:], path[:, -1:]], axis=1)
    return np.asarray(path[:, np.arange(slots)[:, None] * period + np.arange(n_steps + 1)])


def _measured(seen: _Seen, blank: Readings) -> Readings:
    """Readings from densities (outputs, slots, pixels): the expected position follows the spot, if that makes the
    motion about it smaller."""
    sensor, expected = seen.sensor, blank.response[:, :, :-1].mean(axis=2)
    middle = (sensor.field[0] + sensor.field[1]) / 2
    # First the spot may be anywhere; then weights are made for the motion that was found.
    found = _at(seen, blank, np.full_like(expected, middle), blank.reach / _REACH)
    best = found
    for _ in range(_ROUNDS):
        if not best.usable.any():
            raise IdentificationError("no exposure shows a spot on the rig's sensor")
        place = best.mean + best.centre - expected  # the motion that the inputs do not explain
        mean = (place * best.usable).sum(axis=1) / np.maximum(best.usable.sum(axis=1), 1)
        still = expected + mean[:, None]
        follows = expected + before(place, best.usable)
        tried = [
            _at(seen, blank, centre, _motion_about(sensor, best, centre))
            for centre in (np.clip(each, *sensor.field) for each in (still, follows))
        ]
        last = best.motion
        # Following the spot adds the noise of its position, so it is done only where it helps.
        best = replace(tried[1], follows=True) if tried[1].motion < _FOLLOWED * tried[0].motion else tried[0]
        if abs(best.motion - last) < 0.02 * last:
            break
    return best


def before(values: FloatArray, usable: BoolArray) -> FloatArray:
    """The value of the last usable slot before each slot; slots before the first usable one have its value."""
    slots = np.arange(values.shape[1])
    last = np.maximum.accumulate(np.where(usable, slots, -1), axis=1)
    last = np.concatenate([np.full((len(values), 1), -1), last[:, :-1]], axis=1)
    first = np.argmax(usable, axis=1)[:, None]
    return np.asarray(np.take_along_axis(values, np.where(last < 0, first, last), axis=1))


def _motion_about(sensor: Sensor, found: Readings, centre: FloatArray) -> float:
    """Standard deviation of the path about other places, slope units."""
    away = found.centre - centre
    squares = found.square + 2 * away * found.mean + away**2
    whole = found.usable.any(axis=1)
    count = found.usable[whole].sum(axis=1)
    each = (squares * found.usable)[whole].sum(axis=1) / count
    # There may be as much motion as the noise can hide.
    sd = np.sqrt(((found.square_noise + 4 * away**2 * found.mean_noise) * found.usable)[whole].sum(axis=1)) / count
    least = (_LEAST_MOTION**2) * sensor.kernel.variance
    return math.sqrt(max(float((np.maximum(each, 0.0) + sd).max()), least))


def _at(seen: _Seen, blank: Readings, centre: FloatArray, motion: float) -> Readings:
    """The readings about these positions, for paths of this standard deviation."""
    sensor, shape = seen.sensor, centre.shape
    D = sensor.pixel_width
    mean, square, mean_noise, square_noise = (np.zeros(shape) for _ in range(4))
    usable = np.zeros(shape, dtype=bool)
    made: dict[int, FloatArray] = {}
    for o in range(shape[0]):
        for k in np.flatnonzero(blank.usable[o]):
            # Places are a hundredth of a pixel apart, so that weights are made once for many exposures.
            place = round((centre[o, k] - sensor.field[0]) / (0.01 * D))
            if place not in made:
                made[place] = _weights(sensor, sensor.field[0] + 0.01 * D * place, motion)
            W = made[place]
            off = centre[o, k] - (sensor.field[0] + 0.01 * D * place)
            here = seen.mask[o, k]
            noise = (W**2).sum(axis=1)
            if ((W[:, ~here] ** 2).sum(axis=1) > _MISSING * noise).any():
                continue
            first, second = W @ seen.density[o, k] * D
            mean[o, k], square[o, k] = first - off, second - 2 * off * first + off**2
            mean_noise[o, k], square_noise[o, k] = seen.noise(W, o, int(k))
            usable[o, k] = True
    found = replace(
        blank, mean=mean, square=square, mean_noise=mean_noise, square_noise=square_noise, centre=centre, usable=usable
    )
    return replace(found, motion=_motion_about(sensor, found, centre)) if usable.any() else found


def _weights(sensor: Sensor, centre: float, motion: float) -> FloatArray:
    """Weights of the pixels for theta - c and (theta - c)^2, (2, pixels), with the least noise.

    They are a ridge regression for spots at points of the range, with the largest ridge for which g is still accurate
    enough.
    """
    edges, D, variance = sensor.edges, sensor.pixel_width, float(sensor.kernel.variance)
    read = math.sqrt(effective_noise_density(sensor) * D)
    margin = math.sqrt(variance)
    low, high = sensor.field[0] + margin - centre, sensor.field[1] - margin - centre
    at = np.linspace(max(-_REACH * motion, min(low, -margin)), min(_REACH * motion, max(high, margin)), _POINTS)
    prior = np.exp(-0.5 * (at / (1.5 * motion)) ** 2) + 0.02
    prior /= prior.sum()
    G = pixel_masses(variance, edges, centre + at, 0)[0]
    root = np.sqrt(prior)[:, None]
    U, values, V = linalg.svd(root * G, full_matrices=False)
    out = np.empty((2, len(V[0])))
    for p in (1, 2):
        wanted = root[:, 0] * at**p
        onto = U.T @ wanted
        rest = float(wanted @ wanted - onto @ onto)
        ridge = values[0] ** 2
        while ridge > 1e-13 * values[0] ** 2:
            left = ridge / (values**2 + ridge) * onto
            noise = read * float(np.linalg.norm(values / (values**2 + ridge) * onto))
            if float(left @ left) + rest <= max(_WRONG * motion**p, _HIDDEN * noise) ** 2:
                break
            ridge /= 3
        out[p - 1] = (values / (values**2 + ridge) * onto) @ V
    return out
