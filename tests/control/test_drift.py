"""Whether the model fits: innovations that are what they should be, and that are not."""

from __future__ import annotations

import pytest

from aolink.control import Fit, FitMonitor
from aolink.control.drift import WINDOW
from aolink.estimation import make_estimator
from aolink.rig import Rig
from aolink.simulation.model import simulate
from tests.control.rigs import DRIFT, VIBRATION, small_rig


def fit_of(believed: Rig, true: Rig, seed: int, estimator: str = "moments") -> Fit | None:
    monitor, filter = FitMonitor(), make_estimator(believed, estimator)
    fit = None
    for exposure in simulate(true, WINDOW + 20, seed=seed):
        fit = monitor.add(filter.step(exposure))
    return fit


@pytest.mark.slow
def test_a_right_model_fits() -> None:
    rig = small_rig(DRIFT, VIBRATION)
    for seed in range(5):
        fit = fit_of(rig, rig, seed)
        assert fit is not None
        assert fit.fits, fit.text()
        assert abs(fit.nis_ratio - 1) < 0.5


def test_a_disturbance_that_has_grown_shows_in_the_nis() -> None:
    fit = fit_of(small_rig(DRIFT), small_rig(DRIFT.replace("0.15", "0.5")), seed=1)
    assert fit is not None
    assert not fit.fits
    assert fit.nis_ratio > 2


def test_a_slower_disturbance_shows_in_neighbouring_innovations() -> None:
    """White noise was expected: each innovation tells the next."""
    believed = small_rig('[[disturbance.model]]\nkind = "ar"\ncoefficients = 0.0\nsd = 0.5\n')
    fit = fit_of(believed, small_rig(DRIFT.replace("0.15", "0.06")), seed=1, estimator="o1")
    assert fit is not None
    assert not fit.fits
    assert fit.whiteness > 0.3


def test_nothing_is_said_before_there_is_a_window() -> None:
    rig = small_rig(DRIFT)
    monitor, filter = FitMonitor(), make_estimator(rig, "o1")
    assert all(monitor.add(filter.step(each)) is None for each in simulate(rig, WINDOW - 1))
