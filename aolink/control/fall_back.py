"""The rule by which a controller whose model does not pay leaves the mirror to the integrator, or to rest.

The integrator and a mirror that holds still are computed beside the controller that acts, on the same exposures
(`Rival`), and the slopes that they would have left are compared. The centroids say how far the exposures' means would
have been from zero. Inside an exposure the frame shows how far the spot moved, but not when. With s the slopes less
their mean in the exposure, and e the difference that another input would have made, less its own mean, s = -b e + r,
where r is independent of e. Then var s = b^2 var e + var r: over many exposures b^2 is the slope of a straight-line fit
of the blur's variance to that of e, and the other input would have left var s + (1 - 2 b) var e. Where the acting
controller moves with the disturbance, b is 0; where it moves needlessly, b is 1.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from aolink.control.checked import CheckedController
from aolink.control.controller import ControllerRow
from aolink.control.integrator import INTEGRATOR, STILL
from aolink.control.rival import Rival
from aolink.estimation import Needs
from aolink.estimation.frames.measure import measure
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig

WINDOW = 120
"""The most exposures that are judged together, and those from a fall-back to the first trial of the controller that was
asked for."""
_FEWEST = 40
"""The fewest exposures that are judged together."""
_SETTLING = 5
"""Exposures that are left out after each change of the acting controller."""
_LEAST_GAIN = 0.04
"""Least gain, as a share of the slopes' mean square: it is 2 % of their root mean square."""
_SIGMAS, _SIGMAS_OF_MOTION = 2.0, 3.5
"""Standard errors by which the gain must exceed that, and by which the estimate of b^2 is reduced, because the blur of
some exposures may follow the mirror by chance. Where the model is known to be wrong, they are none and the first."""
_LAGS = 8
"""Exposures over which the compared quantity is correlated, as the disturbance is."""
_FEW = 1.5
_BLUR = Needs(what="moments", orders=(1, 2))


class FallBack:
    """Chooses the controller that acts: the one that was asked for, or another while that one is worse.

    The others are the integrator and a mirror that holds still. Another one acts once it would have left significantly
    less over the last exposures; the one that was asked for is tried again after a while, unless its model is known not
    to fit.
    """

    def __init__(self, rig: Rig, row: ControllerRow, delay_steps: int) -> None:
        self.acting = self._preferred = row.name
        self._rig, self._delay = rig, delay_steps
        self._rows = {each.name: each for each in (row, INTEGRATOR, STILL)}
        self._wait = self._since = self._end = 0
        """Exposures from a fall-back to the next trial, exposures since the asked-for controller was left or tried, and
        the step after the newest exposure."""
        self._begin()

    def controller(self) -> CheckedController:
        """A controller of the kind that acts."""
        return CheckedController(self._rows[self.acting], self._rig)

    def interrupt(self) -> None:
        """Begin the rivals anew from the input that the mirror holds, because the loop is open or exposures are
        missing."""
        self._rivals: dict[str, Rival] = {}
        self._settling = _SETTLING

    def see(self, exposure: Exposure, slopes: FloatArray, misfits: bool) -> float | None:
        """Take the next exposure with its centroids, (n_outputs,). Where another controller is to act, it gives the
        slopes that this one would have left less, as a share of their root mean square, or NaN for a trial.

        ``misfits`` says whether the model is known not to fit.
        """
        held, before = np.concatenate([exposure.lead_inputs, exposure.inputs]), self._end
        self._end, self._since = exposure.first_step + exposure.n_steps, self._since + 1
        if not self._rivals or self._end - len(held) != before:
            self.interrupt()
            others = (row for name, row in self._rows.items() if name not in (self._preferred, self.acting))
            self._rivals = {each.name: Rival(self._rig, each, self._delay, held[-1], slopes) for each in others}
            return None
        moved = [each.see(held, slopes) for each in self._rivals.values()]
        self._settling -= 1
        if self._settling >= 0 or not np.isfinite(slopes).any():
            return None
        squares = [float(np.nansum(each**2)) for each in (slopes, *(slopes + each.mean(axis=1) for each in moved))]
        self._judged.append([_blur(self._rig, exposure), *squares, *(float(each.var(axis=1).sum()) for each in moved)])
        return self._verdict(misfits)

    def _begin(self) -> None:
        """Forget earlier exposures, and judge from now on."""
        self.interrupt()
        self._judged: deque[list[float]] = deque(maxlen=WINDOW)
        """The blur's variance, the squared means, the real ones first, then those that each rival would have left, and
        the variance inside the exposure of the difference that each would have made."""

    def _verdict(self, misfits: bool) -> float | None:
        if len(self._judged) < _FEWEST:
            return None
        count, (blur, real, *rest) = len(self._rivals), np.array(self._judged).T
        asked = self.acting == self._preferred
        # With a model that is known to be wrong there is no reason to expect more of the one that acts.
        required, sigmas = 0.0 if misfits and asked else _SIGMAS, _SIGMAS if misfits else _SIGMAS_OF_MOTION
        gains = [
            _mean_and_error(real - square - (1 - 2 * _needless(blur, inside, sigmas)) * inside)
            for square, inside in zip(rest[:count], rest[count:], strict=True)
        ]
        least = [mean - required * error for mean, error in gains]
        best = int(np.argmax(least))
        if least[best] > _LEAST_GAIN * real.mean():
            before = real.mean() + max(float(np.nan_to_num(blur).mean()), 0.0)
            name, gained = list(self._rivals)[best], 1 - math.sqrt(max(1 - gains[best][0] / before, 0.0))
        elif not asked and not misfits and self._since >= self._wait:
            name, gained = self._preferred, math.nan
        else:
            return None
        if asked:  # each trial that fails doubles the time to the next one
            self._wait = 2 * self._wait if self._since < self._wait else WINDOW
        if self._preferred in (self.acting, name):
            self._since = 0
        self.acting = name
        self._begin()
        return gained


def _blur(rig: Rig, exposure: Exposure) -> float:
    """Variance of the slopes inside an exposure by its blur, all slopes together; NaN where nothing was measured."""
    measured = None if exposure.slopes is not None else measure(rig, exposure, _BLUR)[0]
    if measured is None:
        return math.nan
    value = np.asarray(measured.value, dtype=np.float64)  # type: ignore[union-attr] # moments were asked for
    first, second = np.moveaxis(value.reshape(len(value), 2, -1), 1, 0)
    return float((second - first**2)[slice(None) if measured.usable is None else measured.usable].sum())


def _needless(blur: FloatArray, inside: FloatArray, sigmas: float) -> float:
    """b of the module's text, with b^2 reduced by so many standard errors: the benefit of the doubt is with the
    controller that acts."""
    known = np.isfinite(blur)
    if known.sum() < _FEWEST or not (spread := float(inside[known].var())):
        return 0.0
    x, y = (each[known] - each[known].mean() for each in (inside, blur))
    slope = float((x * y).mean()) / spread
    return math.sqrt(float(np.clip(slope - sigmas * _mean_and_error(x * (y - slope * x) / spread)[1], 0.0, 1.0)))


def _mean_and_error(series: FloatArray) -> tuple[float, float]:
    """Mean of a series whose neighbours are correlated, and its standard error (Newey and West)."""
    mean, n = float(series.mean()), len(series)
    lags = np.arange(1, _LAGS + 1)
    off = np.correlate(series - mean, series - mean, "full")[n - 1 :]
    total = float(off[0] + 2 * (1 - lags / (_LAGS + 1)) @ off[lags])
    # A standard error from few exposures is too small, so the quantile at this bandwidth is used (Kiefer and
    # Vogelsang).
    return mean, math.sqrt(max(total, 0.0)) / n * (1 + _FEW * _LAGS / n)
