"""The fit of a model to readings: scans over frequency with the other parameters' best, then local maxima.

A scan takes vibrations that last for a given time at all frequencies, so near to each other that no maximum is between
two of them; so it meets the aliases of every vibration as well. The first scans, of short vibrations, are beside coarse
points for the other processes, the later ones, of long vibrations, beside the highest maximum, until it stays.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from aolink.errors import IdentificationError
from aolink.identification.likelihood import Likelihood
from aolink.identification.models import PARAMETERS, PLANTS, IdentifiedPlant, Process, ProcessSum
from aolink.identification.readings import Readings, by_slot
from aolink.numerics.arrays import FloatArray

SHORT_RUN = 16
"""Exposures in a short run (`Likelihood`): more of them add little information, and take longer."""
CYCLES = 4.0
"""Highest frequency that is searched, in cycles per exposure."""
SPACING = 0.15
"""Distance of a scan's frequencies, in cycles in the time that its vibrations last: half of a resonance's width."""
_SHORT = 2.5
"""How long the vibrations of the first scan last, in frame periods."""
DECAY = 1 / 8
"""How long those of the later ones last, in lengths of the recording."""
_SIZES = (0.25, 0.8)
"""Sizes of a scan's vibrations, over the sd of the motion."""
_STARTS = 8
"""Most points of the coarse grid, and peaks of a scan, that are climbed from."""
_BESIDE = 4
"""Most points of the coarse grid beside which the first scans look for a vibration."""
_ROUNDS = 4
"""Most rounds of scans beside the highest maximum."""
KEPT = 30.0
"""Local maxima that are lower than the highest by more than this, in nats, are forgotten: the pixels may prefer one
that is lower by less (`pixels`)."""
_RIDGE = 0.5
_STEP = 1e-3
_NEVER = 1e12


@dataclass(frozen=True)
class Space:
    """The parameters of a sum of processes as a vector of logarithms, and their limits."""

    kinds: tuple[str, ...]
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
        return tuple(names)

    @property
    def _of_plant(self) -> tuple[str, ...]:
        return PLANTS[self.plant] if self.plant else ()

    @property
    def vibrations(self) -> list[int]:
        """Where the frequencies of the disturbance's vibrations are among the parameters; a damping follows each."""
        return [
            k for k, name in enumerate(self.names)
            if name.endswith("frequency_hz") and not name.startswith("plant.")
        ]  # fmt: skip

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

    def log_likelihood(self, x: FloatArray, of: Sequence[Likelihood], nodes: int | None = None) -> float:
        """The sum over recordings, -inf outside of the limits."""
        if any(not low <= value <= high for value, (low, high) in zip(x, self.bounds, strict=True)):
            return -math.inf
        model = self.model(x)
        return sum(self.driven(x, each)(model, nodes) for each in of)

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
    kinds: Sequence[str], seen: Sequence[Readings], *, lowest_hz: float | None = None, highest_hz: float | None = None,
    plant: str | None = None,
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
        "frequency_hz": (lowest_hz or 0.5 / whole, top),
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
    limited = tuple((math.log(low), math.log(high)) for low, high in bounds)
    return Space(tuple(kinds), limited, plant, _sign(seen) if plant else 1.0)


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
    period_s = seen[0].period_steps * seen[0].step_s
    short, long = _SHORT * period_s, max(_SHORT, DECAY * max(each.slots for each in seen)) * period_s
    beside = starting_points(space, seen, of)
    found = [] if space.vibrations else _distinct(space, [climb(space, each.x, of) for each in beside], of)
    for lasting_s in (short, *[long] * _ROUNDS) if space.vibrations else ():
        before = found[0].log_likelihood if found else -math.inf
        for k in space.vibrations:
            known = [math.exp(each.x[k]) for each in found] if len(space.vibrations) == 1 else []
            for point in peaks(scan(space, k, beside, seen, of, lasting_s))[:_STARTS]:
                if all(abs(hz - math.exp(point.x[k])) > SPACING / lasting_s / 2 for hz in known):
                    found.append(climb(space, point.x, of))
            found = _distinct(space, found, of)
            beside = found[:1] or beside
        if lasting_s == long and found and found[0].log_likelihood < before + _RIDGE:
            break
    if not found:
        raise IdentificationError("no model of this kind has a likelihood here: are there readings at all?")
    return _distinct(space, [climb(space, each.x, of) for each in found], of)  # a second climb has new units


def _distinct(space: Space, found: Sequence[Maximum], of: Sequence[Likelihood]) -> list[Maximum]:
    """The maxima within `KEPT` of the highest, the highest first, without those that are a higher one, which was not
    reached from both ends: nowhere between the two is it lower.

    One point alone between two distant frequencies may be at a third maximum.
    """
    out: list[Maximum] = []
    for each in sorted(found, key=lambda each: -each.log_likelihood):
        if each.log_likelihood > (out or [each])[0].log_likelihood - KEPT and not any(
            all(
                space.log_likelihood((1 - part) * each.x + part * high.x, of, high.nodes) > each.log_likelihood - _RIDGE
                for part in (0.5, 0.25, 0.75)
            )
            for high in out
        ):
            out.append(each)
    return out


def starting_points(space: Space, seen: Sequence[Readings], of: Sequence[Likelihood]) -> list[Maximum]:
    """The best points of a coarse grid, whose vibrations hardly move, for scans to begin with."""
    points = [np.clip(point, *np.array(space.bounds).T) for point in _grid(space, seen)]
    tried = [Maximum(x, space.log_likelihood(x, of), 0) for x in points]
    best = sorted((each for each in tried if math.isfinite(each.log_likelihood)), key=lambda each: -each.log_likelihood)
    return best[: _BESIDE if space.vibrations else _STARTS]


def scan(
    space: Space, k: int, beside: Sequence[Maximum], seen: Sequence[Readings], of: Sequence[Likelihood],
    lasting_s: float, lowest_hz: float = 0.0,
) -> list[Maximum]:  # fmt: skip
    """The highest point at each of the frequencies of a scan for parameter k, from low to high, with a vibration of any
    of several sizes that lasts for so long, beside the other processes of any of the given points."""
    low, high = np.array(space.bounds).T
    spacing = SPACING / lasting_s
    first, last = np.round(np.array([max(lowest_hz, math.exp(low[k])), math.exp(high[k])]) / spacing)
    sd = next(n for n in range(k, len(low)) if space.names[n].endswith("sd"))
    motion = math.log(max(each.motion for each in seen))
    found = []
    for hz in np.arange(max(first, 1.0), last + 1) * spacing:
        tried = []
        for point, size in itertools.product(beside, _SIZES):
            x = point.x.copy()
            x[[k, k + 1, sd]] = math.log(hz), -math.log(2 * math.pi * hz * lasting_s), motion + math.log(size)
            x = np.clip(x, low, high)
            tried.append(Maximum(x, space.log_likelihood(x, of), 0))
        found.append(max(tried, key=lambda each: each.log_likelihood))
    return found


def peaks(scanned: Sequence[Maximum]) -> list[Maximum]:
    """The points of a scan that are higher than their neighbours, the highest first."""
    values = np.array([each.log_likelihood for each in scanned])
    beside = np.pad(values, 1, constant_values=-np.inf)
    tops = np.flatnonzero(np.isfinite(values) & (values >= beside[:-2]) & (values > beside[2:]))
    return [scanned[n] for n in tops[np.argsort(-values[tops])]]


def climb(
    space: Space, start: FloatArray, of: Sequence[Likelihood], enough: float = 1e-3, fixed: Sequence[int] = ()
) -> Maximum:
    """The local maximum that a start leads to, to ``enough`` nats, where the ``fixed`` parameters stay as they are."""
    nodes = max(each.nodes(space.model(start)) for each in of)
    nodes += 4 if nodes < of[0].seen.n_steps - 4 else 0

    def cost(x: FloatArray) -> float:
        value = space.log_likelihood(x, of, nodes)
        return -value if math.isfinite(value) else _NEVER

    low, high = np.array(space.bounds).T
    at = np.clip(start, low + 2 * _STEP, high - 2 * _STEP)
    free, here = np.delete(np.arange(len(at)), list(fixed)), cost(at)
    # Frequencies are known far better than the other parameters: in units of their own curvature all are alike.
    steps = _STEP * np.eye(len(at))[free]
    bends = np.array([cost(at + step) + cost(at - step) - 2 * here for step in steps]) / _STEP**2
    scale = 1 / np.sqrt(np.maximum(bends, 0.0) + 1)
    units = steps / _STEP * scale[:, None]

    def whitened(u: FloatArray) -> float:
        return cost(at + u @ units)

    done = optimize.minimize(
        whitened, np.zeros(len(free)), method="L-BFGS-B",
        bounds=list(zip((low - at)[free] / scale, (high - at)[free] / scale, strict=True)),
        options={"maxiter": 60, "eps": 1e-3, "ftol": enough / max(abs(here), 1.0)},
    )  # fmt: skip
    return Maximum(at + done.x @ units, -float(done.fun) if done.fun < _NEVER else -math.inf, nodes)


def _grid(space: Space, seen: Sequence[Readings]) -> list[tuple[float, ...]]:
    """Points of the coarse grid, logarithms; their vibrations are fast, damped and small."""
    exposure = seen[0].n_steps * seen[0].step_s
    variance = max(each.motion for each in seen) ** 2 / max(len(space.kinds) + (space.plant is not None), 1)
    sd, top = math.sqrt(variance), CYCLES / exposure
    points: dict[str, list[tuple[float, ...]]] = {
        "random-walk": [(variance / exposure * c,) for c in (0.01, 0.1, 1.0)],
        "ornstein-uhlenbeck": [(c * exposure, 2 * variance / (c * exposure)) for c in (0.3, 3.0, 30.0)],
        "second-order": [(c * exposure, c * exposure * d, sd) for c in (0.3, 3.0, 30.0) for d in (0.1, 0.5)],
        "resonance": [(top, 0.5, sd / 10)],
    }
    parts = [points[kind] for kind in space.kinds]
    if space.plant is not None:
        parts.insert(0, _plant_grid(space, seen, sd))
    products = itertools.product(*parts)
    return [tuple(math.log(value) for part in product for value in part) for product in products]


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
