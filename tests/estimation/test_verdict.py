"""The verdict whether the model fits: silent on right files, and what it does where one is wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from aolink import simulate
from aolink.estimation import Driver, Estimate, make_estimator, score, smooth
from aolink.estimation.estimate import COMPARED, Status
from aolink.estimation.score import score_table
from aolink.estimation.verdict import Fit
from aolink.exposure import Exposure
from aolink.recording import convert
from aolink.rig import Rig, load_rig

EXPOSURES = 90


def with_noise(rig: Rig, factor: float) -> Rig:
    plant = rig.plant
    return replace(
        rig,
        plant=replace(
            plant, process_noise=plant.process_noise * factor, initial_covariance=plant.initial_covariance * factor
        ),
    )


def with_read_noise(rig: Rig, factor: float) -> Rig:
    return replace(rig, sensor=replace(rig.sensor, noise_density=factor * rig.sensor.noise_density))


@pytest.fixture(scope="module")
def rig() -> Rig:
    return load_rig("section-vi-lively")


@pytest.fixture(scope="module")
def right(rig: Rig) -> list[Exposure]:
    return list(simulate(rig, EXPOSURES, seed=5))


def estimates_of(rig: Rig, exposures: Sequence[Exposure], name: str = "moments", judged: bool = True) -> list[Estimate]:
    estimator = make_estimator(rig, name)
    if not judged:
        estimator.judge = None
    return [estimator.step(each) for each in exposures]


def same_bits(one: Estimate, other: Estimate) -> bool:
    for name in COMPARED:
        a, b = getattr(one, name), getattr(other, name)
        if not (np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b):
            return False
    return True


def test_a_right_model_fits_and_no_bit_of_an_estimate_changes(rig: Rig, right: list[Exposure]) -> None:
    made, plain = estimates_of(rig, right), estimates_of(rig, right, judged=False)
    assert made[5].verdict is not None
    assert made[5].verdict.fit is Fit.UNKNOWN  # there were too few exposures
    assert made[-1].verdict is not None
    assert made[-1].verdict.fit is Fit.FITS
    assert all(map(same_bits, made, plain))


@pytest.mark.parametrize(
    ("name", "wrong", "kind"),
    [
        ("moments", lambda rig: with_noise(rig, 6.0), "motion"),
        ("profile", lambda rig: with_read_noise(rig, 1.6), "pixels"),
        ("moments", lambda rig: with_read_noise(rig, 1.6), ""),  # four moments do not tell
    ],
)
def test_a_wrong_model_is_found_and_its_intervals_are_wider(
    rig: Rig, name: str, wrong: Callable[[Rig], Rig], kind: str
) -> None:
    exposures = simulate(wrong(rig), EXPOSURES, seed=5)
    made, plain = (estimates_of(rig, exposures, name, judged) for judged in (True, False))
    verdict = made[-1].verdict
    assert verdict is not None
    assert (verdict.fit, verdict.kind) == (Fit.DOES_NOT_FIT, kind)
    assert verdict.text in made[-1].reason
    assert verdict.widening >= 1.0
    for name in ("coefficient_covariance", "end_covariance", "start_covariance"):
        expected = verdict.widening**2 * getattr(plain[-1], name)
        np.testing.assert_allclose(getattr(made[-1], name), expected, rtol=1e-12)
    # The filter itself goes on as it was.
    assert np.array_equal(made[-1].end_state, plain[-1].end_state)
    assert any(each.verdict is not None and each.verdict.begins_with(each.frame_id) for each in made)


def test_a_model_by_which_frames_are_refused_does_not_fit(rig: Rig) -> None:
    quiet = with_read_noise(with_noise(rig, 1e-6), 1e-3)
    estimates = estimates_of(quiet, list(simulate(rig, EXPOSURES, seed=5)))
    assert sum(each.status in (Status.OK, Status.INPUT_INVALID) for each in estimates) < EXPOSURES / 2
    verdict = estimates[-1].verdict
    assert verdict is not None
    assert (verdict.fit, verdict.kind) == (Fit.DOES_NOT_FIT, "")  # refused frames do not tell what is wrong
    assert verdict.widening > 2


def test_it_is_the_same_exposure_by_exposure_and_in_batches(rig: Rig) -> None:
    exposures = simulate(with_noise(rig, 6.0), EXPOSURES, seed=5)
    one, many = Driver(rig, ["moments", "o1"]), Driver(rig, ["moments", "o1"])
    for exposure, (_, batched) in zip(exposures, many.steps(exposures), strict=True):
        for a, b in zip(one.step(exposure), batched, strict=True):
            assert same_bits(a, b)
            assert a.verdict == b.verdict


def test_it_is_recorded_and_scored(rig: Rig) -> None:
    exposures = simulate(with_noise(rig, 6.0), EXPOSURES, seed=5)
    made = estimates_of(rig, exposures)
    message = convert.estimate_message(made[-1])
    back = convert.estimate_from_message(message, made[-1].model, exposures[-1])
    assert back.verdict == made[-1].verdict
    assert same_bits(back, made[-1])
    message.ClearField("verdict")
    assert convert.estimate_from_message(message, made[-1].model, exposures[-1]).verdict is None
    assert any("does not fit (motion" in note for note in score_table({"moments": score(exposures, made)}).notes)


@pytest.mark.parametrize("name", ["o1", "o3", "moments", "profile"])
def test_numbers_of_a_right_model_are_standard_normal(rig: Rig, right: list[Exposure], name: str) -> None:
    """o1 and o3 leave out the process noise inside an exposure; the verdict does not."""
    estimates = estimates_of(rig, right, name)
    verdict = estimates[-1].verdict
    assert verdict is not None
    assert max(abs(verdict.pixels), abs(verdict.motion), verdict.zero, abs(verdict.nis)) < 3.5
    assert verdict.fit is Fit.FITS


def test_smoothing_sees_no_widened_covariance(rig: Rig) -> None:
    exposures = list(simulate(with_noise(rig, 6.0), EXPOSURES, seed=5))
    wide, plain = (
        smooth(rig.plant, exposures, estimates_of(rig, exposures, judged=judged)) for judged in (True, False)
    )
    assert wide[-1].verdict is not None
    assert wide[-1].verdict.widening > 1
    for one, other in zip(wide, plain, strict=True):
        assert one.verdict is not None
        np.testing.assert_allclose(one.path, other.path, atol=1e-9)
        np.testing.assert_allclose(one.path_sd, one.verdict.widening * other.path_sd, rtol=1e-9)
