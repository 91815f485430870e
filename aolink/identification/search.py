"""The fit of a model to readings: a coarse grid, which contains the aliases of each frequency, then local maxima."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from aolink.errors import IdentificationError
from aolink.identification.likelihood import Likelihood
from aolink.identification.models import PARAMETERS, PLANTS, IdentifiedPlant, Process, ProcessSum, SensorFit
from aolink.identification.readings import Readings, by_slot
from aolink.numerics.arrays import FloatArray

SHORT_RUN = 16
"""Exposures in a short run (`Likelihood`): more of them add little information, and take longer."""
CYCLES = 4.0
"""Highest frequency that is searched, in cycles per exposure."""
_SPACING = 0.06
"""Spacing of the grid of frequencies, cycles per frame period: below the width of a maximum with the grid's damping."""
_DECAY = 0.4
"""Decay of the grid's resonances in a frame period, in nats."""
_STARTS = 8
_ROUNDS = 5
"""How often, at most, the aliases of a maximum are tried again."""
_FINE = 0.01
"""Spacing of the scan for a sharp vibration, cycles per exposure."""
_SHARP = 0.003
"""Damping of the scan's vibration."""
_PEAKS = 12
"""Most peaks of a scan that are climbed."""
_MOST = 3000
"""Most points of a grid of several processes."""
KEPT = 30.0
"""Local maxima that are lower than the highest by more than this, in nats, are forgotten: the pixels may prefer one
that is lower by less (`pixels`)."""
_SAME = 0.02
"""Maxima whose parameters differ by less than this share are one."""
_RIDGE = 0.5
_STEP = 1e-3
_KERNEL_CHANGE = 0.05
"""Start of ``kernel_change``, the sd of the exposures' kernel variances about their mean over the rig file's."""
_NEVER = 1e12


@dataclass(frozen=True)
class Space:
    """The parameters of a sum of processes as a vector of logarithms, and their limits."""

    kinds: tuple[str, ...]
    with_noise: bool
    """Whether a factor of the pixels' noise variance is one more parameter."""
    with_kernel: bool
    """Whether a factor of the kernel's variance, and its changes from exposure to exposure, are two more."""
    kernel_variance: float
    bounds: tuple[tuple[float, float], ...]
    plant: str | None = None
    """The kind of plant that is fitted as well; its parameters come first. None: the plant is known."""
    sign: float = 1.0
    """Sign of the plant's gain."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, with the kind before them where there are several processes."""
        several = len(self.kinds) > 1
        names = [f"plant.{name}" for name in self._of_plant]
        for k, kind in enumerate(self.kinds):
            number = "" if self.kinds.count(kind) == 1 else self.kinds[: k + 1].count(kind)
            names += [f"{kind}{number}.{name}" if several else name for name in PARAMETERS[kind]]
        return (*names, *["noise"] * self.with_noise, *["kernel", "kernel_change"] * self.with_kernel)

    @property
    def _of_plant(self) -> tuple[str, ...]:
        return PLANTS[self.plant] if self.plant else ()

    def fitted_plant(self, x: FloatArray) -> IdentifiedPlant | None:
        """The plant of a vector, where one is fitted."""
        if self.plant is None:
            return None
        gain, *rest = np.exp(x[: len(self._of_plant)]).tolist()
        return IdentifiedPlant(self.plant, (self.sign * gain, *rest))

    def model(self, x: FloatArray) -> ProcessSum:
        """The disturbance of a vector, with that from the fitted plant's own noise before the others."""
        plant = self.fitted_plant(x)
        values = np.exp(x[len(self._of_plant) :]).tolist()
        processes = [plant.noise] if plant else []
        for kind in self.kinds:
            n = len(PARAMETERS[kind])
            processes.append(Process(kind, tuple(values[:n])))
            values = values[n:]
        return ProcessSum(tuple(processes))

    def sensor(self, x: FloatArray) -> SensorFit:
        """What a vector says of the sensor."""
        own = len(self._of_plant) + sum(len(PARAMETERS[kind]) for kind in self.kinds)
        rest = np.exp(x[own:]).tolist()
        noise = rest.pop(0) if self.with_noise else 1.0
        factor, change = rest if self.with_kernel else (1.0, 0.0)
        return SensorFit(noise, (factor - 1) * self.kernel_variance, (change * self.kernel_variance) ** 2)

    def log_likelihood(self, x: FloatArray, of: Sequence[Likelihood], nodes: int | None = None) -> float:
        """The sum over recordings, -inf outside of the limits."""
        if any(not low <= value <= high for value, (low, high) in zip(x, self.bounds, strict=True)):
            return -math.inf
        model, sensor = self.model(x), self.sensor(x)
        return sum(self.driven(x, each)(model, sensor, nodes) for each in of)

    def driven(self, x: FloatArray, of: Likelihood, draws: int = 1) -> Likelihood:
        """A recording's likelihood with the fitted plant's response to its inputs, where a plant is fitted.

        ``draws`` is the number of copies of the recording's outputs, with the same inputs.
        """
        if self.plant is None:
            return of
        first = of.seen.of_outputs(range(len(of.seen.mean) // draws))
        return of.with_response(np.tile(self.response(x, first), (draws, 1, 1)))

    def response(self, x: FloatArray, seen: Readings) -> FloatArray:
        """Response to the inputs of a recording, (outputs, slots, N + 1)."""
        plant = self.fitted_plant(x)
        if plant is None:
            return seen.response
        path = plant.response(seen.inputs[:, 0], seen.step_s)
        return by_slot(path, seen.slots, seen.n_steps, seen.period_steps, seen.offset)


def space_of(
    kinds: Sequence[str], seen: Sequence[Readings], kernel_variance: float, *, with_noise: bool, with_kernel: bool,
    highest_hz: float | None = None, plant: str | None = None,
) -> Space:  # fmt: skip
    """The parameters of a sum of processes, and of a plant, within limits that the recordings set.

    Raises
    ------
    IdentificationError
        The fast rate cannot follow a frequency that is asked for, or a plant is asked for that the inputs do not show.
    """
    one = seen[0]
    exposure, period = one.n_steps * one.step_s, one.period_steps * one.step_s
    whole = max(each.slots for each in seen) * period
    top = highest_hz or min(CYCLES / exposure, 0.25 / one.step_s)
    if top > 0.5 / one.step_s:
        raise IdentificationError(f"{top:g} Hz is above half of the fast rate, {0.5 / one.step_s:g} Hz")
    limits = {
        "frequency_hz": (0.5 / whole, top),
        "damping": (1e-4, 0.95),
        "sd": (1e-4 * one.reach, 4 * one.reach),
        "correlation_s": (exposure / 100, 10 * whole),
        "intensity": (1e-8 * one.reach**2 / whole, 100 * one.reach**2 / exposure),
    }
    span = max(float(np.ptp(each.inputs)) for each in seen)
    if plant is not None and span == 0:
        raise IdentificationError(
            "the inputs of the recording never change, so it holds no input to identify a plant from: record with a"
            " [drive], or take the plant as known"
        )
    if plant is not None and any(each.inputs.shape[1] != 1 for each in seen):
        raise IdentificationError(
            f"a plant is identified where one input moves one output, here {one.inputs.shape[1]} move a copy of it"
        )
    bounds = []
    if plant is not None:
        own = limits | {"gain": (1e-3 * one.reach / span, 1e3 * one.reach / span), "damping": (1e-4, 30.0)}
        bounds = [own[name] for name in PLANTS[plant]]
    bounds += [limits[name.removeprefix("second_")] for kind in kinds for name in PARAMETERS[kind]]
    bounds += [(0.01, 100.0)] * with_noise + [(0.25, 4.0), (1e-3, 1.0)] * with_kernel
    return Space(
        tuple(kinds), with_noise, with_kernel, kernel_variance,
        tuple((math.log(low), math.log(high)) for low, high in bounds), plant, _sign(seen) if plant else 1.0,
    )  # fmt: skip


def _sign(seen: Sequence[Readings]) -> float:
    """Sign of the gain of a plant that hardly delays: that of the covariance of the means with the inputs'."""
    total = 0.0
    for each in seen:
        u = np.cumsum(each.inputs[:, 0], axis=1)
        smooth = by_slot(np.pad(u, ((0, 0), (1, 0))), each.slots, each.n_steps, each.period_steps, 0.0)
        mean = (smooth[:, :, -1] - smooth[:, :, 0]) / each.n_steps
        y = each.mean + each.centre
        good = each.usable
        total += float(((mean - mean[good].mean()) * (y - y[good].mean()))[good].sum())
    return math.copysign(1.0, total)


@dataclass(frozen=True, eq=False)
class Maximum:
    """A local maximum of the log-likelihood."""

    x: FloatArray
    log_likelihood: float
    nodes: int


def maxima(space: Space, seen: Sequence[Readings]) -> list[Maximum]:
    """The local maxima within `KEPT` of the highest, the highest first."""
    of = [Likelihood(each, SHORT_RUN) for each in seen]
    of_sensor = [0.0] * space.with_noise + [0.0, math.log(_KERNEL_CHANGE)] * space.with_kernel
    points = [np.array([*point, *of_sensor]) for point in _grid(space, seen)]
    points = [np.clip(point, *np.array(space.bounds).T) for point in points]
    values = [space.log_likelihood(point, of) for point in points]
    order = np.argsort(values)[::-1]
    chosen: list[FloatArray] = []
    for k in order[np.isfinite(np.array(values)[order])]:
        if len(chosen) < _STARTS and not any(_near(space, points[k], o, 0.04) for o in chosen):
            chosen.append(points[k])
    found: list[Maximum] = []
    for start in chosen:
        _add(space, found, climb(space, start, of, enough=0.1))
    for each in sorted(found, key=lambda each: -each.log_likelihood)[:2]:
        for start in _aliases(space, each.x, seen[0]):
            _add(space, found, climb(space, start, of, enough=0.1))
    best: list[Maximum] = []
    highest = max(each.log_likelihood for each in found)
    for each in found:
        if each.log_likelihood > highest - KEPT:
            _add(space, best, climb(space, each.x, of))
    if not best:
        raise IdentificationError("no model of this kind has a likelihood here: are there readings at all?")
    looked_at: list[Maximum] = []
    for _ in range(_ROUNDS):
        # A sharp vibration beside a drift is often found at an alias first; the true one is found only from exactly
        # that maximum. Once the highest one's aliases are known, those of the next family are tried.
        ranked = sorted(best, key=lambda each: -each.log_likelihood)
        fresh = [each for each in ranked if not any(_near(space, each.x, other.x, 5e-3) for other in looked_at)]
        if fresh[:1] != ranked[:1]:
            others = [x for at in looked_at for x in _aliases(space, at.x, seen[0])]
            fresh = [each for each in fresh if not any(_near(space, each.x, x, 5e-3) for x in others)]
        if not fresh:
            break
        looked_at.append(fresh[0])
        for start in _aliases(space, fresh[0].x, seen[0]):
            _add(space, best, climb(space, start, of))
    for start in _sharp(space, max(best, key=lambda each: each.log_likelihood).x, seen[0], of):
        _add(space, best, climb(space, start, of))
    highest = max(each.log_likelihood for each in best)
    best = [each for each in best if each.log_likelihood > highest - KEPT]
    apart: list[Maximum] = []
    for each in sorted(best, key=lambda each: -each.log_likelihood):
        if not any(_on_a_ridge(space, each, other, of) for other in apart):
            apart.append(each)
    return apart


def _on_a_ridge(space: Space, low: Maximum, high: Maximum, of: Sequence[Likelihood]) -> bool:
    """Whether two maxima are one that was not reached from both ends: nowhere between them is it lower.

    One point alone between two distant frequencies may be at a third maximum.
    """
    return all(
        space.log_likelihood((1 - share) * low.x + share * high.x, of, high.nodes) > low.log_likelihood - _RIDGE
        for share in (0.5, 0.25, 0.75)
    )


def _aliases(space: Space, x: FloatArray, one: Readings) -> list[FloatArray]:
    """Points whose frequencies have the same values at the exposures' starts, with the same decay."""
    rate = 1 / (one.period_steps * one.step_s)
    out = []
    for k, name in enumerate(space.names):
        if name.endswith("frequency_hz"):
            low, high = np.exp(space.bounds[k])
            f = math.exp(x[k])
            for m in range(1, math.ceil((high + f) / rate) + 1):
                for alias in (m * rate - f, m * rate + f, f - m * rate):
                    if low < alias < high:
                        other = x.copy()
                        other[k] = math.log(alias)
                        other[k + 1] = np.clip(x[k + 1] + x[k] - other[k], *space.bounds[k + 1])  # its damping
                        out.append(other)
    return out


def _sharp(space: Space, x: FloatArray, one: Readings, of: Sequence[Likelihood]) -> list[FloatArray]:
    """The highest peaks of a fine scan of each resonance's frequency, sharp, beside the other processes of a point."""
    step = _FINE / (one.n_steps * one.step_s)
    out: list[FloatArray] = []
    for k, name in enumerate(space.names):
        if not (name.startswith("resonance") and name.endswith("frequency_hz")):  # of a sum: alone it is easily found
            continue
        low, high = np.exp(space.bounds[k])
        points = np.tile(x, (int((high - low) / step), 1))
        points[:, k] = np.log(low + step * (np.arange(len(points)) + 0.5))
        points[:, k + 1] = np.clip(math.log(_SHARP), *space.bounds[k + 1])
        values = np.array([space.log_likelihood(point, of) for point in points])
        beside = np.pad(values, 1, constant_values=-np.inf)
        peaks = np.flatnonzero(np.isfinite(values) & (values >= beside[:-2]) & (values > beside[2:]))
        out += [points[p] for p in peaks[np.argsort(-values[peaks])][:_PEAKS]]
    return out


def _near(space: Space, a: FloatArray, b: FloatArray, share: float) -> bool:
    """Whether two points have frequencies that differ by less than this share, or have none."""
    where = [k for k, name in enumerate(space.names) if name.endswith("frequency_hz")] or list(range(len(a)))
    return bool((np.abs(a[where] - b[where]) < share).all())


def _add(space: Space, found: list[Maximum], new: Maximum) -> None:
    if not math.isfinite(new.log_likelihood):
        return
    for k, old in enumerate(found):
        if (np.abs(old.x - new.x) < _SAME).all() or (
            _near(space, old.x, new.x, 5e-3) and abs(old.log_likelihood - new.log_likelihood) < 0.1
        ):
            found[k] = max(old, new, key=lambda each: each.log_likelihood)
            return
    found.append(new)


def climb(
    space: Space, start: FloatArray, of: Sequence[Likelihood], enough: float = 1e-3, fixed: Sequence[int] = ()
) -> Maximum:
    """The local maximum that a start leads to, to ``enough`` nats, where the ``fixed`` parameters stay as they are."""
    nodes = max(each.nodes(space.model(start)) for each in of)
    nodes += 4 if nodes < of[0].seen.n_steps - 4 else 0

    def cost(x: FloatArray) -> float:
        value = space.log_likelihood(x, of, nodes)
        return -value if math.isfinite(value) else _NEVER

    # Frequencies are known far better than the other parameters: in units of their own curvature all are alike.
    low, high = np.array(space.bounds).T
    at = np.clip(start, low + 2 * _STEP, high - 2 * _STEP)
    here, scale = cost(at), np.empty(len(at))
    for k, step in enumerate(_STEP * np.eye(len(at))):
        scale[k] = min(1 / math.sqrt(max(cost(at + step) + cost(at - step) - 2 * here, 0.0) / _STEP**2 + 1), 1.0)

    def whitened(u: FloatArray) -> float:
        return cost(at + u * scale)

    low[list(fixed)] = high[list(fixed)] = at[list(fixed)]
    done = optimize.minimize(
        whitened, np.zeros(len(at)), method="L-BFGS-B",
        bounds=list(zip((low - at) / scale, (high - at) / scale, strict=True)),
        options={"maxiter": 60, "eps": 1e-3, "ftol": enough / max(abs(here), 1.0)},
    )  # fmt: skip
    return Maximum(at + done.x * scale, -float(done.fun) if done.fun < _NEVER else -math.inf, nodes)


def _grid(space: Space, seen: Sequence[Readings]) -> list[tuple[float, ...]]:
    """Points of the coarse grid, logarithms."""
    one = seen[0]
    exposure, period = one.n_steps * one.step_s, one.period_steps * one.step_s
    variance = max(each.motion for each in seen) ** 2
    share = variance / max(len(space.kinds) + (space.plant is not None), 1)
    sd = math.sqrt(share)
    at = [name for kind in space.kinds for name in PARAMETERS[kind]]
    low, high = next(
        (np.exp(space.bounds[k]) for k, name in enumerate(at) if name.endswith("frequency_hz")), (1.0, 1.0)
    )
    frequencies = np.arange(max(low, 0.05 / period), high + _SPACING / period / 2, _SPACING / period)
    pairs = [(f, min(_DECAY / (2 * math.pi * f * period), 0.5)) for f in np.minimum(frequencies, high)]

    def points(kind: str) -> list[tuple[float, ...]]:
        if kind == "random-walk":
            return [(share / exposure * c,) for c in (0.01, 0.1, 1.0)]
        if kind == "ornstein-uhlenbeck":
            return [(c * exposure, 2 * share / (c * exposure)) for c in (0.3, 3.0, 30.0)]
        if kind == "second-order":
            return [(c * exposure, c * exposure * d, sd) for c in (0.3, 3.0, 30.0) for d in (0.1, 0.5)]
        if kind == "resonance":
            return [(f, z, sd) for f, z in pairs]
        if kind == "ar3":
            return [(f, z, c * exposure, sd) for f, z in pairs for c in (0.1, 2.0)]
        # ar4: two pairs, whose order does not matter.
        return [(f, z, g, y, sd) for (f, z), (g, y) in itertools.combinations(pairs[::2], 2)]

    each = [points(kind) for kind in space.kinds]
    if space.plant is not None:
        each.insert(0, _plant_grid(space, seen, sd))
    while math.prod(len(some) for some in each) > _MOST:
        longest = max(range(len(each)), key=lambda k: len(each[k]))
        each[longest] = each[longest][::2]
    grid = []
    for product in itertools.product(*each):
        # The order of the frequencies of equal processes does not matter.
        own = product[1:] if space.plant is not None else product
        beside = itertools.pairwise(zip(own, space.kinds, strict=True))
        if all(a[0] < b[0] or kind != other for (a, kind), (b, other) in beside):
            grid.append(tuple(math.log(value) for part in product for value in part))
    return grid


def _plant_grid(space: Space, seen: Sequence[Readings], sd: float) -> list[tuple[float, ...]]:
    """Points of the coarse grid of a plant; gains are those of least squares of the means."""
    low, high = np.exp(space.bounds[1])
    scales = np.geomspace(low, high, 24)
    if space.plant == "first-order":
        shapes: list[tuple[float, ...]] = [(scale,) for scale in scales]
    else:
        shapes = [(scale, damping) for scale in scales for damping in (0.02, 0.3, 1.5, 6.0)]
    points = []
    for shape in shapes:
        top = bottom = 0.0
        for each in seen:
            path = IdentifiedPlant(space.plant or "", (1.0, *shape, sd)).response(each.inputs[:, 0], each.step_s)
            slots = by_slot(path, each.slots, each.n_steps, each.period_steps, each.offset)
            mean, y, good = slots[:, :, :-1].mean(axis=2), each.mean + each.centre, each.usable
            mean = mean - mean[good].mean()
            top += float((mean * y)[good].sum())
            bottom += float((mean * mean)[good].sum())
        gain = abs(top) / max(bottom, 1e-300)
        points.append((min(max(gain, 1e-300), 1e300), *shape, sd / 2))
    return points
