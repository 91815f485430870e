"""Whether a controller pays: what the integrator, and a mirror that holds still, would have left of a disturbance.

What the mirror did is known, and so is what another input would have done in its place: the difference of the two
inputs, by the plant's model of the mirror, is what the slopes would have differed by. So another controller is followed
beside the one that acts, on the same exposures, and what it would have left is compared. No model of the disturbance is
believed for that; the centroids say how far the exposures' means would have been from zero.

Inside an exposure the frame says how far the spot went, but not when. With s the slopes less their mean in the
exposure, and e the difference that another input would have made, less its own mean, s = -b e + r, where r has nothing
to do with e. Then var s = b^2 var e + var r: over many exposures b^2 is the slope of a line through the blur's variance
against that of e, and the other input would have left var s + (1 - 2 b) var e. A controller that moves with the
disturbance is explained by b = 0 where it acts; one that moves for nothing, by b = 1.

This does not find whether a controller that does not act would pay, because what moves for nothing still moves most
where there is most to cancel. Where its model predicts the measurements as well as it says, it is believed (b = 1), and
the controller is tried. It then acts again until it does not pay, and each trial that fails doubles the time to the
next one.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from aolink.control.controller import Controller, ControllerRow, Seen
from aolink.control.drift import TOLERATED_RATIO, Fit
from aolink.control.integrator import Integrator
from aolink.control.modes import reached
from aolink.estimation import Estimate, Needs
from aolink.estimation.frames.measure import measure
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig

WINDOW = 120
"""Exposures that are judged together, at most, ..."""
_FEWEST = 40
"""... and at least."""
_WAIT = WINDOW
"""Exposures from leaving the controller that was asked for to its first trial."""
_SETTLING = 5
"""Exposures that are left out after each change of who acts."""
_LEAST_GAIN = 0.04
"""Share of the slopes' mean square that must be gained: 2 % of their root mean square."""
_SIGMAS = 2.0
"""How many standard errors the gain must be above that, and the slope b^2 is taken as less than it was found, ..."""
_SIGMAS_WHERE_IT_FITS = 3.5
"""... where the model is not known to be wrong: the blur of some exposures may follow the mirror by chance."""
_LAGS = 8
"""Exposures over which what is compared is correlated, as the disturbance is."""
_FEW = 1.5
_BLUR = Needs(what="moments", orders=(1, 2))


class Still:
    """The mirror holds its safe input."""

    def __init__(self, rig: Rig) -> None:
        self._u = rig.mirror.park

    def see(self, seen: Seen) -> None:
        pass

    def step(self, held: FloatArray) -> FloatArray:
        return self._u


INTEGRATOR = ControllerRow(
    name="integrator", summary="leaky integrator on the centroids, modal", build=Integrator, needs_state=False
)
STILL = ControllerRow(name="still", summary="holds the safe input", build=Still, needs_state=False)


@dataclass(frozen=True, kw_only=True)
class Change:
    """Another controller is to act."""

    acting: str
    gained: float
    """How much less it would have left, as a share of the slopes' root mean square."""


class _Judged(NamedTuple):
    """An exposure, as one of those that do not act would have left it, against the one that acts. Sums over slopes."""

    means: float
    """Difference of the squared means."""
    within: float
    """Variance, inside the exposure, of the difference."""


class Rival:
    """A controller that does not act, followed beside the one that does.

    Parameters
    ----------
    held:
        The input from which it begins, (n_inputs,).
    """

    def __init__(self, rig: Rig, row: ControllerRow, delay_steps: int, held: FloatArray) -> None:
        plant, mirror = rig.plant, rig.mirror
        self._rig, self._controller, self._delay = rig, row.build(rig), delay_steps
        self._moved, _ = reached(plant)
        self._A, self._B = plant.A[np.ix_(self._moved, self._moved)].T.copy(), plant.B[self._moved].T.copy()
        self._C = plant.C[:, self._moved].T.copy()
        self._offset = np.zeros((plant.axes, len(self._moved)))
        """Offset of the mirror's states from those that it really has."""
        self._low, self._high = mirror.input_min, mirror.input_max
        self._most_change = mirror.slew_max_per_s * rig.timing.fast_step_s or math.inf
        self._u, self._sent, self._sees = held, held, False
        self._wanted: FloatArray | None = None
        """The input that was wanted last, once the mirror holds it."""
        self._ahead: list[FloatArray] = []
        """Its inputs from the end of the newest exposure on."""

    def see(self, held: FloatArray, slopes: FloatArray, state: FloatArray | None) -> FloatArray:
        """Take the next exposure: inputs that the mirror held since the end of the one before, (k, n_inputs),
        centroids, and the estimated state at its end. Gives what the slopes would have differed by, (k, n_outputs)."""
        rows = self._ahead
        while len(rows) < len(held):
            rows.append(self._next())
        pushed = (np.array(rows[: len(held)]) - held).reshape(len(held), len(self._offset), -1) @ self._B
        path = np.empty((len(held), *self._offset.shape))
        for k, push in enumerate(pushed):
            path[k] = self._offset
            self._offset = self._offset @ self._A + push
        moved = np.asarray(path @ self._C).reshape(len(held), -1)
        self._ahead = [self._next() for _ in range(self._delay)]
        if state is not None:
            state = state.copy()
            state[:, self._moved] += self._offset
        seen = slopes + moved[-self._rig.timing.exposure_steps :].mean(axis=0)
        self._controller.see(Seen(slopes=seen, state=state, pending=np.array(self._ahead)))
        self._sees = True
        return moved

    def _next(self) -> FloatArray:
        """Its input in the next fast step, as the mirror's converter would put it out."""
        if not self._sees or (given := self._controller.step(self._u)) is self._wanted:
            return self._u
        wanted = near = np.minimum(np.maximum(given, self._low), self._high)
        if self._most_change < math.inf:
            near = np.minimum(np.maximum(wanted, self._sent - self._most_change), self._sent + self._most_change)
        self._sent, self._u = near, self._rig.mirror.quantise(near)
        self._wanted = given if near is wanted or np.array_equal(near, wanted) else None
        return self._u


class FallBack:
    """Says which controller is to act: the one that was asked for, or another while that one does not pay.

    The others are the integrator and a mirror that holds still. Another one acts once it would have left significantly
    less over the last exposures; the one that was asked for is tried again where its model promises as much.
    """

    def __init__(self, rig: Rig, row: ControllerRow, delay_steps: int) -> None:
        self.acting = self._preferred = row.name
        self._rig, self._delay = rig, delay_steps
        self._rows = {each.name: each for each in (row, INTEGRATOR, STILL)}
        self._rivals: dict[str, Rival] = {}
        self._wait, self._since, self._tries = _WAIT, 0, 0
        """Exposures until the asked-for controller is tried again, those since it was left or tried, and trials."""
        self._end = 0
        """The step after the newest exposure."""
        self._begin()

    def controller(self) -> Controller:
        """A controller of the kind that is to act."""
        return self._rows[self.acting].build(self._rig)

    def interrupt(self) -> None:
        """The loop is open, or exposures are missing: who does not act is followed anew from what the mirror holds."""
        self._rivals = {}

    def see(self, exposure: Exposure, slopes: FloatArray, estimate: Estimate | None, fit: Fit | None) -> Change | None:
        """Take the next exposure with its centroids, (n_outputs,); says where another controller is to act.

        ``fit`` says how well the asked-for controller's model fits, as far as that is known.
        """
        held = np.concatenate([exposure.lead_inputs, exposure.inputs])
        end = exposure.first_step + exposure.n_steps
        if end - len(held) != self._end:
            self.interrupt()
        self._end, self._since = end, self._since + 1
        if not self._rivals:
            self._rivals = {
                name: Rival(self._rig, row, self._delay, held[-1])
                for name, row in self._rows.items()
                if name != self.acting
            }
            self._settling = _SETTLING
            for rival in self._rivals.values():
                rival.see(held[-1:], slopes, None if estimate is None else estimate.end_state)
            return None
        state = None if estimate is None else estimate.end_state
        differences = {name: rival.see(held, slopes, state) for name, rival in self._rivals.items()}
        self._settling -= 1
        if self._settling >= 0 or not np.isfinite(slopes).any():
            return None
        self._blur.append(_blur(self._rig, exposure))
        self._power.append(float(np.nansum(slopes**2)))
        for name, moved in differences.items():
            inside = moved[-exposure.n_steps :]
            mean = inside.mean(axis=0)
            means = float(np.nansum((slopes + mean) ** 2 - slopes**2))
            self._judged[name].append(_Judged(means, float(inside.var(axis=0).sum())))
        return self._verdict(fit)

    def _begin(self) -> None:
        """Judge from now on."""
        self.interrupt()
        self._settling = 0
        self._blur: deque[float] = deque(maxlen=WINDOW)
        self._power: deque[float] = deque(maxlen=WINDOW)
        self._judged: dict[str, deque[_Judged]] = {name: deque(maxlen=WINDOW) for name in self._rows}

    def _verdict(self, fit: Fit | None) -> Change | None:
        """Who is to act, where that changes; the asked-for controller once it is time to try it."""
        if len(self._power) < _FEWEST:
            return None
        power, blur = float(np.mean(self._power)), np.array(self._blur)
        sigmas = _SIGMAS_WHERE_IT_FITS if fit is None or fit.fits else _SIGMAS
        is_time = fit is not None and fit.nis_ratio <= TOLERATED_RATIO and self._since >= self._wait
        best, least, gained = "", -_LEAST_GAIN * power, 0.0
        for name in self._rivals:
            judged = np.array(self._judged[name])
            if name != self._preferred:
                mean, error = _difference(judged, _share(judged, blur, sigmas))
            elif is_time:
                mean, error = _difference(judged, 1.0)
            else:
                continue
            if mean + _SIGMAS * error < least:
                best, least, gained = name, mean + _SIGMAS * error, -mean
        if not best:
            return None
        before = power + max(float(np.nanmean(blur)), 0.0) if np.isfinite(blur).any() else power
        if self.acting == self._preferred:
            self._wait = 2 * self._wait if self._tries and self._since < self._wait else _WAIT
        self._tries += best == self._preferred
        if self._preferred in (self.acting, best):
            self._since = 0
        self.acting = best
        self._begin()
        return Change(acting=best, gained=1 - math.sqrt(max(1 - gained / before, 0.0)))


def _blur(rig: Rig, exposure: Exposure) -> float:
    """Variance of the slopes inside an exposure by its blur, all slopes together; NaN where nothing was measured."""
    if exposure.slopes is not None:
        return math.nan
    measured, _ = measure(rig, exposure, _BLUR)
    if measured is None:
        return math.nan
    value = np.asarray(measured.value, dtype=np.float64)  # type: ignore[union-attr] # moments were asked for
    first, second = np.moveaxis(value.reshape(len(value), 2, -1), 1, 0)
    if measured.usable is not None:
        first, second = first[measured.usable], second[measured.usable]
    return float((second - first**2).sum())


def _share(judged: FloatArray, blur: FloatArray, sigmas: float) -> float:
    """b of the module's text, from the variances inside the exposures; so many standard errors of b^2 on the safe side:
    the benefit of the doubt is with the controller that acts."""
    known = np.isfinite(blur)
    within = judged[known, 1]
    if len(within) < _FEWEST or (spread := float(within.var())) == 0:
        return 0.0
    x, y = within - within.mean(), blur[known] - blur[known].mean()
    slope = float((x * y).mean()) / spread
    error = _mean_and_error(x * (y - slope * x) / spread)[1]
    return min(math.sqrt(max(slope - sigmas * error, 0.0)), 1.0)


def _difference(judged: FloatArray, share: float) -> tuple[float, float]:
    """What a rival would have left less what was left, mean square, and the standard error of that, for b = ``share``.

    ``judged`` are the rows of `_Judged`.
    """
    means, within = judged.T
    return _mean_and_error(means + (1 - 2 * share) * within)


def _mean_and_error(series: FloatArray) -> tuple[float, float]:
    """Mean of a series whose neighbours are correlated, and its standard error (Newey and West)."""
    mean, n = float(series.mean()), len(series)
    off = series - mean
    total = float(off @ off)
    for lag in range(1, min(_LAGS, n - 1) + 1):
        total += 2 * (1 - lag / (_LAGS + 1)) * float(off[lag:] @ off[:-lag])
    # An error that is found from few exposures is too small: the quantile at this bandwidth (Kiefer and Vogelsang).
    return mean, math.sqrt(max(total, 0.0)) / n * (1 + _FEW * _LAGS / n)
