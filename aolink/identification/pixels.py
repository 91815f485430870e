"""What all pixels say about a vibration: which of its aliases it is, how long it lasts, and its frequency.

The likelihood of `likelihood` has two sums of each exposure. Its maxima at the aliases of a vibration can be nearly as
high as that at its frequency, and where its damping is low, these sums hardly show how low. The shape of the blur tells
more: where a spot turns, and how often. So the filter of `profile` goes through the exposures with each candidate's
model, and the sum of its log-evidences, which is the log-likelihood of the pixels except for Laplace's approximation
(`aolink.estimation.pixels.modes`), decides between candidates. One that is far behind is left out at once, so that most
of them take few exposures.

Beside a process that moves the centroid much more than a vibration does, there may be no maximum near the vibration's
frequency at all. So the pixels also choose among frequencies at equal distances (`scanned`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from aolink.errors import EstimatorError
from aolink.estimation import Estimator, make_estimator
from aolink.exposure import Exposure
from aolink.identification.likelihood import Likelihood
from aolink.identification.readings import Readings
from aolink.identification.search import DECAY, KEPT, SHORT_RUN, SPACING, Maximum, Space, climb, scan, starting_points
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig

_ESTIMATOR = "profile"
_RULED_OUT = 30.0
"""Nats by which a candidate is behind where it is left out: the evidence is approximate."""
_MOST = 10.0
"""The most nats by which one exposure counts against a candidate: no single frame may decide."""
_SETTLED = 4
"""Exposures at the beginning that do not count: every filter first has to find its state."""
_ENOUGH = 256
"""Exposures after which candidates that are still alike are left as they are."""
_ALIKE = 3.0
"""Such a candidate is not made where the maximum's own damping is within this factor."""
_LASTING, _LEAST_CYCLES = 3.0, 0.25
"""How long the vibrations of a scan last at first, in exposures, and its lowest frequency, in cycles an exposure: below
that, centroids show the frequency."""
_PEAKS = 4
"""Most frequencies of the scan, each better than its neighbours, about which vibrations that last longer are tried."""
_NEAR_ENOUGH = 0.1
"""Nats to which a scan maximises the likelihood of readings."""
_STAYED = 0.02
"""A maximum of the likelihood of readings belongs to a frequency of a scan if it differs by less than this share."""
_AROUND = np.array([-1.5, 0.0, 1.5])
"""Steps from a parameter at which the evidence is compared."""
_MOVES = 3
"""How often a parameter is moved at most: again where the best is at an end of these steps."""
_MOST_NEAR = 2.0
"""The most nats by which one exposure counts between models that differ by such steps."""


RigOf = Callable[[FloatArray], Rig]
"""A function that gives the rig with the parameters of a `Space`."""
Tell = Callable[[int, int], None]
"""Called with how much is done, and how much there is."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A model that the pixels may choose."""

    x: FloatArray
    """Its parameters, as those of its `Space`."""
    maximum: Maximum
    """The local maximum of the likelihood of readings that it is, or is beside."""


@dataclass(frozen=True, eq=False)
class Scan:
    """What the pixels say about frequencies at equal distances (`scanned`)."""

    candidates: list[Candidate]
    """A candidate at each frequency that they prefer."""
    left: dict[int, list[tuple[float, float]]]
    """Intervals of frequencies that they do not rule out, Hz, by the number of the parameter; they may overlap."""


def candidates(space: Space, found: Sequence[Maximum], seen: Sequence[Readings]) -> list[Candidate]:
    """Each maximum, with vibrations that last an eighth of the recording where its own do not.

    A candidate whose vibrations never change loses against any other alias with some damping as soon as the true
    vibration has changed, although its frequency is right. So where a maximum's vibrations last for longer than the
    recording, the other takes its place; where they last for less, both are candidates. The other's further parameters
    are those that then maximise the likelihood of readings.
    """
    whole = max(each.slots * each.period_steps * each.step_s for each in seen)
    of, out = [Likelihood(each, SHORT_RUN) for each in seen], []
    for each in found:
        x = each.x.copy()
        lasting = False
        for k in space.vibrations:
            damping = -math.log(2 * math.pi * DECAY * whole) - x[k]
            lasting |= x[k + 1] < damping + math.log(DECAY)
            if abs(damping - x[k + 1]) > math.log(_ALIKE):
                x[k + 1] = np.clip(damping, *space.bounds[k + 1])
        if not lasting:
            out.append(Candidate(each.x, each))
        if (x != each.x).any():
            fixed = [at for k in space.vibrations for at in (k, k + 1)]
            out.append(Candidate(climb(space, x, of, _NEAR_ENOUGH, fixed).x, each))
    return out


def scanned(
    space: Space, found: Sequence[Maximum], seen: Sequence[Readings], rig_of: RigOf, exposures: Sequence[Exposure],
    tell: Tell = lambda done, of: None,
) -> Scan:  # fmt: skip
    """Candidates for each vibration of a sum at the frequencies that the pixels prefer, wherever the maxima are.

    First vibrations last for three exposures, so that their frequencies may be far apart; at each frequency the other
    parameters are those that maximise the likelihood of readings. About the best of them vibrations that last an eighth
    of the recording are tried.

    There is no candidate for a vibration that is alone, which `maxima` finds, and where `profile` cannot work on the
    rig. The parameters are those of `candidates`; the highest maximum of ``found`` comes first.
    """
    out = Scan([], {})
    if len(space.kinds) < 2 or not exposures:
        return out
    try:
        make_estimator(rig_of(found[0].x), _ESTIMATOR)
    except EstimatorError:
        return out
    of = [Likelihood(each, SHORT_RUN) for each in seen]
    period_s, exposure_s = (steps * seen[0].step_s for steps in (seen[0].period_steps, seen[0].n_steps))
    beside = [*found[:_PEAKS], *starting_points(space, seen, of)]

    def judged(k: int, points: Sequence[FloatArray], tell: Tell) -> list[Candidate]:
        tops = [climb(space, x, of, _NEAR_ENOUGH, fixed=(k, k + 1)) for x in points]
        least = max(top.log_likelihood for top in tops) - KEPT
        possible = [Candidate(top.x, top) for top in tops if top.log_likelihood > least]
        return by_pixels(possible, rig_of, exposures, tell)

    for k in space.vibrations:
        lasting = _LASTING * period_s
        points = scan(space, k, beside, seen, of, lasting, _LEAST_CYCLES / exposure_s)
        left = judged(k, [each.x for each in points], lambda done, of: tell(done, 2 * of))
        # Each stands for half the distance on either side, and a little more.
        half = 0.51 * SPACING / lasting
        best_hz = [math.exp(each.x[k]) for each in left]
        out.left[k] = [(0.0, math.exp(points[0].x[k]) - half), *((hz - half, hz + half) for hz in best_hz)]
        longer = max(lasting, DECAY * len(exposures) * period_s)
        close = []
        for each in _apart(left, k, 3 * half):
            hz = math.exp(each.x[k])
            for at in np.arange(math.ceil((hz - half) * longer / SPACING), (hz + half) * longer / SPACING):
                x = each.x.copy()
                x[k], x[k + 1] = math.log(at * SPACING / longer), -math.log(2 * math.pi * at * SPACING)
                close.append(np.clip(x, *np.array(space.bounds).T))
        for each in _apart(judged(k, close, lambda done, of: tell(of + done, 2 * of)), k, 1.5 * SPACING / longer):
            top = climb(space, each.x, of)
            out.candidates.append(Candidate(each.x, top if abs(top.x[k] - each.x[k]) < _STAYED else each.maximum))
    return out


def _apart(left: Sequence[Candidate], k: int, distance_hz: float) -> list[Candidate]:
    """The best candidates, none of them so near to a better one."""
    out: list[Candidate] = []
    for each in left:
        if len(out) < _PEAKS and all(abs(math.exp(each.x[k]) - math.exp(one.x[k])) > distance_hz for one in out):
            out.append(each)
    return out


def by_pixels(
    found: Sequence[Candidate], rig_of: RigOf, exposures: Sequence[Exposure], tell: Tell = lambda done, of: None
) -> list[Candidate]:
    """The candidates that the pixels do not rule out, the one with the highest evidence first.

    Where `profile` cannot work on the rig, or there is one candidate only, they are all returned in their order, which
    is also the one to keep where the pixels cannot decide. ``rig_of`` gives the rig with a candidate's parameters;
    ``tell`` is called with the exposures, which have pixels, that have been used, and how many there are.
    """
    if len(found) < 2:
        return list(found)
    try:
        running = {k: make_estimator(rig_of(each.x), _ESTIMATOR) for k, each in enumerate(found)}
    except EstimatorError:
        return list(found)
    total = np.zeros(len(found))
    used = exposures[:_ENOUGH]
    for number, exposure in enumerate(used):
        tell(number, len(used))
        each = np.array([_log_evidence(exposure, estimator) for estimator in running.values()])
        if number < _SETTLED or not np.isfinite(each).any():
            continue
        at = list(running)
        total[at] += np.maximum(np.nan_to_num(each, nan=-np.inf) - np.nanmax(each), -_MOST)
        behind = [k for k in at if total[k] < total[at].max() - _RULED_OUT]
        for k in behind:
            del running[k]
        if len(running) == 1:
            break
    return [found[k] for k in sorted(running, key=lambda k: -total[k])]


def refined(
    space: Space, x: FloatArray, rig_of: RigOf, exposures: Sequence[Exposure], tell: Tell = lambda done, of: None
) -> FloatArray:
    """Parameters in which damping and frequency of each vibration are where the pixels' evidence is highest.

    First the damping, then the frequency is moved to the vertex of the parabola through three evidences. Where
    `profile` cannot work on the rig, they stay. The parameters are those of `candidates`, the others as in `by_pixels`;
    `tell` is called with the number of parameters that are done.
    """
    x = x.copy()

    @cache
    def evidence(*x: float) -> FloatArray:
        estimator = make_estimator(rig_of(np.array(x)), _ESTIMATOR)
        return np.array([_log_evidence(exposure, estimator) for exposure in exposures[:_ENOUGH]][_SETTLED:])

    # With a damping that is far too high, any frequency nearby will do.
    moved = [at for k in space.vibrations for at in (k + 1, k)]
    for number, k in enumerate(moved):
        tell(number, len(moved))
        # Half of a resonance's width, over its frequency, is its damping.
        step = math.exp(x[k + 1]) if k in space.vibrations else math.log(2)
        for _ in range(_MOVES):
            beside = np.tile(x, (len(_AROUND), 1))
            beside[:, k] = np.clip(x[k] + step * _AROUND, *space.bounds[k])
            try:
                each = np.array([evidence(*at) for at in beside])
            except EstimatorError:
                return x
            # The evidence of an exposure jumps where the filter has lost a mode of the posterior.
            gains = np.clip(np.nan_to_num(each - each[len(each) // 2]), -_MOST_NEAR, _MOST_NEAR).sum(axis=1)
            square, slope, _ = np.polyfit(_AROUND, gains, 2)
            vertex = -slope / (2 * square) if square < 0 else _AROUND[gains.argmax()]
            to = float(np.clip(vertex, _AROUND[0], _AROUND[-1]))
            x[k] = np.clip(x[k] + step * to, *space.bounds[k])
            if abs(to) < _AROUND[-1]:
                break
    return x


def _log_evidence(exposure: Exposure, estimator: Estimator) -> float:
    """Log-evidence of a frame, nats, the sum over axes; NaN where it shows none."""
    estimator.step(exposure)
    assert estimator.posterior is not None
    evidence: FloatArray | None = estimator.posterior.log_evidence
    return float("nan") if evidence is None else float(evidence.sum())
