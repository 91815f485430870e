"""The comparison of a controller with the integrator and a mirror that holds still, by the disturbance that each would
have left.

The inputs of the mirror are known, and so is the effect of other inputs in their place: the slopes would have differed
by the response of the plant's mirror to the difference of the two inputs. So another controller is computed beside the
one that acts, on the same exposures, and the slopes that it would have left are compared. This needs no model of the
disturbance; the centroids say how far the exposures' means would have been from zero.

Inside an exposure the frame shows how far the spot moved, but not when. With s the slopes less their mean in the
exposure, and e the difference that another input would have made, less its own mean, s = -b e + r, where r is
independent of e. Then var s = b^2 var e + var r: over many exposures b^2 is the slope of a straight-line fit of the
blur's variance to that of e, and the other input would have left var s + (1 - 2 b) var e. Where the acting controller
moves with the disturbance, b is 0; where it moves needlessly, b is 1.

This cannot show whether a controller that does not act would be better, because one that moves needlessly still moves
most where there is most to cancel. Where its model predicts the measurements as well as its covariance says, b = 1 is
assumed, and the controller is tried. It then acts until it is worse again, and each trial that fails doubles the time
to the next one.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from aolink.control.checked import CheckedController
from aolink.control.controller import ControllerRow, Seen
from aolink.control.drift import TOLERATED_RATIO, Fit
from aolink.control.integrator import Integrator
from aolink.control.modes import reached
from aolink.estimation import Estimate, Needs
from aolink.estimation.frames.measure import measure
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig

WINDOW = 120
"""The most exposures that are judged together."""
_FEWEST = 40
"""The fewest exposures that are judged together."""
_WAIT = WINDOW
"""Exposures from the fall-back to the first trial of the controller that was asked for."""
_SETTLING = 5
"""Exposures that are left out after each change of the acting controller."""
_LEAST_GAIN = 0.04
"""Least gain, as a share of the slopes' mean square: it is 2 % of their root mean square."""
_SIGMAS = 2.0
"""Standard errors by which the gain must exceed that, unless the model is known to be wrong, and by which the estimate
of b^2 is reduced where it is."""
_SIGMAS_WHERE_IT_FITS = 3.5
"""The number for b^2 where the model is not known to be wrong: the blur of some exposures may follow the mirror by
chance."""
_LAGS = 8
"""Exposures over which the compared quantity is correlated, as the disturbance is."""
_FEW = 1.5
_BLUR = Needs(what="moments", orders=(1, 2))


class Still:
    """A controller with which the mirror holds its safe input."""

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
class ControllerChange:
    """The change to another controller."""

    acting: str
    gained: float
    """The slopes that it would have left less, as a share of their root mean square."""


class _Judged(NamedTuple):
    """One exposure with a rival's inputs compared with those of the acting controller; all values are sums over
    slopes."""

    means: float
    """Difference of the squared means."""
    within: float
    """Variance of the slopes' difference inside the exposure."""


class Rival:
    """A controller that does not act, computed beside the one that does.

    It begins from the input ``held``, (n_inputs,).
    """

    def __init__(self, rig: Rig, row: ControllerRow, delay_steps: int, held: FloatArray) -> None:
        plant, mirror = rig.plant, rig.mirror
        self._rig, self._delay = rig, delay_steps
        # The check of each step would cost time before new inputs are sent; aolink's own two need none here.
        self._controller = row.build(rig) if row in (INTEGRATOR, STILL) else CheckedController(row, rig)
        self._moved, _ = reached(plant)
        self._A, self._B = plant.A[np.ix_(self._moved, self._moved)].T.copy(), plant.B[self._moved].T.copy()
        self._C = plant.C[:, self._moved].T.copy()
        self._offset = np.zeros((plant.axes, len(self._moved)))
        """The mirror's states with the rival's inputs less its real states."""
        self._low, self._high = mirror.input_min, mirror.input_max
        self._most_change = mirror.slew_max_per_s * rig.timing.fast_step_s or math.inf
        self._u, self._sent, self._sees = held, held, False
        self._wanted: FloatArray | None = None
        """The input that was wanted last, once the mirror holds it."""
        self._ahead: list[FloatArray] = []
        """The rival's inputs from the end of the newest exposure on."""

    def see(self, held: FloatArray, slopes: FloatArray, state: FloatArray | None) -> FloatArray:
        """Take the next exposure: inputs that the mirror held since the end of the one before, (k, n_inputs),
        centroids, and the estimated state at its end. Gives the difference that the rival's inputs would have made to
        the slopes, (k, n_outputs)."""
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
        """The rival's input in the next fast step, rounded by the mirror's converter."""
        if not self._sees or (given := self._controller.step(self._u)) is self._wanted:
            return self._u
        wanted = near = np.minimum(np.maximum(given, self._low), self._high)
        if self._most_change < math.inf:
            near = np.minimum(np.maximum(wanted, self._sent - self._most_change), self._sent + self._most_change)
        self._sent, self._u = near, self._rig.mirror.quantise(near)
        self._wanted = given if near is wanted or np.array_equal(near, wanted) else None
        return self._u


class FallBack:
    """Chooses the controller that acts: the one that was asked for, or another while that one is worse.

    The others are the integrator and a mirror that holds still. Another one acts once it would have left significantly
    less over the last exposures; the one that was asked for is tried again where its model predicts as large a gain.
    """

    def __init__(self, rig: Rig, row: ControllerRow, delay_steps: int) -> None:
        self.acting = self._preferred = row.name
        self._rig, self._delay = rig, delay_steps
        self._rows = {each.name: each for each in (row, INTEGRATOR, STILL)}
        self._rivals: dict[str, Rival] = {}
        self._wait, self._since, self._tries = _WAIT, 0, 0
        """Exposures until the asked-for controller is tried again, exposures since it was left or tried, and number of
        trials."""
        self._end = 0
        """The step after the newest exposure."""
        self._begin()

    def controller(self) -> CheckedController:
        """A controller of the kind that acts."""
        return CheckedController(self._rows[self.acting], self._rig)

    def interrupt(self) -> None:
        """Begin the rivals anew from the input that the mirror holds, because the loop is open or exposures are
        missing."""
        self._rivals = {}

    def see(
        self, exposure: Exposure, slopes: FloatArray, estimate: Estimate | None, fit: Fit | None
    ) -> ControllerChange | None:
        """Take the next exposure with its centroids, (n_outputs,); gives a `ControllerChange` where another
        controller is to act.

        ``fit`` says how well the asked-for controller's model fits, as far as that is known.
        """
        held = np.concatenate([exposure.lead_inputs, exposure.inputs])
        end = exposure.first_step + exposure.n_steps
        if end - len(held) != self._end:
            self.interrupt()
        self._end, self._since = end, self._since + 1
        state = None if estimate is None else estimate.end_state
        if not self._rivals:
            others = {name: row for name, row in self._rows.items() if name != self.acting}
            self._rivals = {name: Rival(self._rig, row, self._delay, held[-1]) for name, row in others.items()}
            self._settling = _SETTLING
            for rival in self._rivals.values():
                rival.see(held[-1:], slopes, state)
            return None
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
        """Forget earlier exposures, and judge from now on."""
        self.interrupt()
        self._settling = 0
        self._blur: deque[float] = deque(maxlen=WINDOW)
        self._power: deque[float] = deque(maxlen=WINDOW)
        self._judged: dict[str, deque[_Judged]] = {name: deque(maxlen=WINDOW) for name in self._rows}

    def _verdict(self, fit: Fit | None) -> ControllerChange | None:
        """The controller that is to act, where that changes; the asked-for one once it is time to try it."""
        if len(self._power) < _FEWEST:
            return None
        power, blur = float(np.mean(self._power)), np.array(self._blur)
        known_wrong = fit is not None and not fit.fits
        sigmas = _SIGMAS if known_wrong else _SIGMAS_WHERE_IT_FITS
        # With a model that is known to be wrong there is no reason to expect more of the one that acts.
        required = 0.0 if known_wrong and self.acting == self._preferred else _SIGMAS
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
            if mean + required * error < least:
                best, least, gained = name, mean + required * error, -mean
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
        return ControllerChange(acting=best, gained=1 - math.sqrt(max(1 - gained / before, 0.0)))


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
    """b of the module's text, from the variances inside the exposures; b^2 is reduced by the given number of standard
    errors: the benefit of the doubt is with the controller that acts."""
    known = np.isfinite(blur)
    within = judged[known, 1]
    if len(within) < _FEWEST or (spread := float(within.var())) == 0:
        return 0.0
    x, y = within - within.mean(), blur[known] - blur[known].mean()
    slope = float((x * y).mean()) / spread
    error = _mean_and_error(x * (y - slope * x) / spread)[1]
    return min(math.sqrt(max(slope - sigmas * error, 0.0)), 1.0)


def _difference(judged: FloatArray, share: float) -> tuple[float, float]:
    """Mean square of the slopes that a rival would have left less that of the real ones, and its standard error, for b
    = ``share``.

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
    # A standard error from few exposures is too small, so the quantile at this bandwidth is used (Kiefer and
    # Vogelsang).
    return mean, math.sqrt(max(total, 0.0)) / n * (1 + _FEW * _LAGS / n)
