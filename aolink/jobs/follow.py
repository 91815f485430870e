"""The job of `aolink identify --follow`: it takes exposures as they come, and fits a new model where the old one no
longer fits.

The innovations of an estimator of its own say whether a model fits, with or without estimators in the recording, as
those of the loop's estimator do in a session (`aolink.control.FitMonitor`). A new model is fitted to exposures that no
model fits, and judged on those that come after them, which it has not seen.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from aolink.control import Fit, FitMonitor
from aolink.control.drift import WINDOW
from aolink.errors import EstimatorError, IdentificationError
from aolink.estimation import make_estimator
from aolink.exposure import Exposure
from aolink.identification import CANDIDATES, PARAMETERS, Readings, kinds_of, readings, rig_model
from aolink.identification.likelihood import Likelihood
from aolink.identification.search import SHORT_RUN
from aolink.jobs.identify import Result, Tell, Wanted, from_readings, outputs_of
from aolink.rig import Rig, parse_rig

FITTED = 96
"""Exposures that a new model is fitted to: with 64, the two processes of a sum often cannot be separated."""
HELD_OUT = 32
"""Exposures after these on which it is judged."""
LEAST_GAIN = 3.0
"""A new model is offered if it raises their log-likelihood by more than this, nats: odds of twenty to one."""
REPORT = 60
"""Exposures between two lines of output about the models' fit."""


@dataclass(frozen=True, kw_only=True)
class News:
    """The news after an exposure."""

    frame_id: int
    fits: bool | None
    """Whether one of the models fits; None where the news is about something else."""
    text: str


@dataclass(frozen=True, kw_only=True)
class Offer:
    """A new model with a higher likelihood of the exposures that were held out."""

    frame_id: int
    path: Path
    """The rig file that it is to be written to."""
    result: Result
    fitted: tuple[int, int]
    """First and last frame that it was fitted to."""
    held_out: tuple[int, int]
    log_likelihood: float
    """Log-likelihood of the exposures that were held out, nats."""
    before: float
    """Their log-likelihood by the best of the earlier models."""
    before_name: str
    before_model: str
    """The poles of that model, in words."""


def with_own_kinds(wanted: Wanted, rig: Rig) -> Wanted:
    """If no model was asked for, take the kinds of the rig file's own model, if it has one of a single output.

    A choice among nine takes minutes, while a session goes on; a process that drifts keeps its kind.
    """
    tables = tomllib.loads(rig.toml).get("disturbance", {}).get("model", [])
    kinds = [each["kind"] for each in tables]
    if wanted.models != CANDIDATES or not kinds or rig.plant.n_outputs > 1 or not {*kinds} <= PARAMETERS.keys():
        return wanted
    return replace(wanted, models=("+".join(kinds),))


def offer_path(target: Path, number: int) -> Path:
    """The file of an offer, counted from 1: ``identified.toml``, ``identified-2.toml``, ..."""
    return target if number == 1 else target.with_name(f"{target.stem}-{number}{target.suffix}")


class _Followed:
    """A model, an estimator that uses it, and how well it fits."""

    def __init__(self, rig: Rig, name: str) -> None:
        self.rig, self.name = rig, name
        self.fit: Fit | None = None
        self._monitor = FitMonitor()
        try:
            self._estimator = make_estimator(rig, "moments")
        except EstimatorError:  # more spots than `moments` takes; centroids show less of a misfit
            self._estimator = make_estimator(rig, "o1")

    def see(self, exposure: Exposure) -> None:
        self.fit = self._monitor.add(self._estimator.step(exposure))

    @property
    def fits(self) -> bool:
        return self.fit is not None and self.fit.fits

    def text(self) -> str:
        how = "cannot be judged yet" if self.fit is None else f"{'fits' if self.fits else 'does not fit'}"
        return f"{self.name} {how}" + (f": {self.fit.text()}" if self.fit else "")


class Following:
    """Follows the rig file's model, and the newest offer beside it, exposure by exposure.

    Parameters
    ----------
    wanted:
        The kinds of a new model; the plant is taken as known.
    target:
        The file of the first offer.
    tell:
        Called with the progress of a fit.

    Raises
    ------
    IdentificationError
        There is no such kind of process.
    """

    def __init__(self, rig: Rig, wanted: Wanted, target: Path, tell: Tell | None = None) -> None:
        for name in wanted.models:
            kinds_of(name)
        self.exposures = self.offers = 0
        self.judged = False
        """Whether the models could be judged at all."""
        self._rig, self._wanted, self._target, self._tell = rig, with_own_kinds(wanted, rig), target, tell
        self._followed = [_Followed(rig, "the rig file's model")]
        self._unfitted: list[Exposure]
        """The exposures since the models no longer fit."""
        self._result: Result | None
        """The model that was fitted to the first of them, and waits for its judgement."""
        self._missed: bool
        """Whether the models miss exposures. This ends once a model has fitted for so long that its judgement depends
        on new exposures only."""
        self._agreed = 0
        """Exposures in a row after which a model fitted."""
        self._said, self._said_missed = 0, False
        """Number of exposures at the last line of output about the models' fit, and whether the models missed them
        then."""
        self._begin()

    def see(self, exposure: Exposure) -> Iterator[News | Offer]:
        """Take the next exposure. Raises IdentificationError where the recording has no pixels."""
        if exposure.slopes is not None:
            raise IdentificationError("the recording holds slopes and no pixels: identification needs the blur")
        self.exposures += 1
        for each in self._followed:
            each.see(exposure)
        fitting = next((each for each in self._followed if each.fits), None)
        judged_before, self.judged = self.judged, self.judged or any(each.fit for each in self._followed)
        self._agreed = self._agreed + 1 if fitting else 0
        self._missed |= self.judged and fitting is None
        explained = fitting is not None and (not self._missed or self._agreed >= WINDOW)
        if explained:
            self._begin()
        if self.judged and (
            not judged_before or self._missed != self._said_missed or self.exposures - self._said >= REPORT
        ):
            self._said, self._said_missed = self.exposures, self._missed
            text = fitting.text() if fitting else "; ".join(each.text() for each in self._followed)
            yield News(frame_id=exposure.frame_id, fits=fitting is not None, text=text)
        if explained:
            return
        # They are kept before the first judgement as well: if no model fits then, a new one is fitted to them.
        self._unfitted.append(exposure)
        if not self._missed:
            del self._unfitted[:-FITTED]
            return
        try:
            yield from self._fit(exposure.frame_id)
        except IdentificationError as error:
            self._begin()
            yield News(frame_id=exposure.frame_id, fits=None, text=f"no new model: {error}")

    def _begin(self) -> None:
        """Forget the exposures that no model fits."""
        self._unfitted, self._result, self._missed = [], None, False

    def _fit(self, frame_id: int) -> Iterator[News | Offer]:
        """Fit a new model once there are enough exposures, and judge it once there are more."""
        if self._result is None and len(self._unfitted) >= FITTED:
            del self._unfitted[:-FITTED]
            seen = [readings(self._rig, self._unfitted, kernel_known=not self._wanted.kernel)]
            self._result = from_readings(self._rig, seen, self._unfitted, self._wanted, self._tell)
        elif self._result is not None and len(self._unfitted) == FITTED + HELD_OUT:
            yield self._judge(frame_id, self._result)
            self._begin()

    def _judge(self, frame_id: int, result: Result) -> News | Offer:
        """An offer, if the exposures held out have a higher likelihood by the new model than by the earlier ones."""
        exposures = self._unfitted
        seen = readings(self._rig, exposures)
        first = exposures[FITTED].first_step - exposures[0].first_step
        held = seen.part(round(first / seen.period_steps), seen.slots)
        new = parse_rig(result.text)
        value = _log_likelihood(new, held)
        values = [_log_likelihood(each.rig, held) for each in self._followed]
        best = max(range(len(values)), key=values.__getitem__)
        before, old = values[best], self._followed[best]
        if not value > before + LEAST_GAIN:
            text = (
                f"a new model was fitted and is not offered: it does not explain the {HELD_OUT} exposures after those"
                f" that it was fitted to much better than {old.name} does (log-likelihood {value - before:+.1f} nats,"
                f" {LEAST_GAIN:+g} are needed)"
            )
            return News(frame_id=frame_id, fits=None, text=text)
        self.offers += 1
        path = offer_path(self._target, self.offers)
        offered = _Followed(new, path.name)
        for each in exposures:
            offered.see(each)
        self._followed[1:] = [offered]
        return Offer(
            frame_id=frame_id, path=path, result=result, log_likelihood=value, before=before, before_name=old.name,
            before_model=_in_words(old.rig), fitted=(exposures[0].frame_id, exposures[FITTED - 1].frame_id),
            held_out=(exposures[FITTED].frame_id, exposures[-1].frame_id),
        )  # fmt: skip


def _log_likelihood(rig: Rig, seen: Readings) -> float:
    """Log-likelihood of readings by a rig file's model, nats; -inf where that model has no disturbance."""
    per_copy = rig.plant.n_outputs
    try:
        return sum(
            Likelihood(seen.of_outputs([output]), SHORT_RUN)(rig_model(rig, output % per_copy))
            for output in outputs_of(seen, range(rig.n_outputs))
        )
    except IdentificationError:
        return -math.inf


def _in_words(rig: Rig) -> str:
    try:
        each = [rig_model(rig, output).text() for output in range(min(rig.plant.n_outputs, 2))]
    except IdentificationError:
        return "nothing disturbs"
    return "; ".join(dict.fromkeys(each))
