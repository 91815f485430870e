"""A frequency that is not that of the rig file, or wanders: it is found, and the path's intervals hold."""

import dataclasses
import math
from importlib import resources

import numpy as np
import pytest
from scipy.linalg import expm

from aolink.errors import EstimatorError, RigError
from aolink.estimation import make_estimator
from aolink.estimation.batch import Batch
from aolink.estimation.estimate import WanderingValue
from aolink.estimation.wandering import at_frequency
from aolink.numerics.block_diagonal import stationary_covariance
from aolink.rig import Wandering, load_rig, parse_rig
from aolink.simulation.model import simulate
from tests.kinds import must_be, truth_of

JITTER = load_rig("jitter")
WANDERING = Wandering(parameter="frequency", largest=0.05, rate_per_minute=0.01)


def wandering(rig, how=WANDERING):
    return dataclasses.replace(rig, plant=dataclasses.replace(rig.plant, wandering=how))


def drifting(rig, factors, seed):
    """Exposures of a rig whose frequency is another in each."""
    state, inputs, steps, out = None, rig.drive.inputs, rig.timing.exposure_steps, []
    for k, factor in enumerate(factors):
        plant = at_frequency(rig.plant, float(factor))
        if state is not None:
            nothing = np.zeros_like(plant.A)
            plant = dataclasses.replace(plant, initial_mean=state, initial_covariance=nothing)
        u = inputs(k * steps, steps, rig.timing.fast_step_s)
        (one,) = simulate(dataclasses.replace(rig, plant=plant), 1, seed=1000 * seed + k, inputs=u)
        state = truth_of(one).end_state[0]
        out.append(dataclasses.replace(one, frame_id=k, first_step=k * steps))
    return out


def found_in(estimate):
    return must_be(WanderingValue, estimate.wandering)


def judged(exposures, estimates):
    """RMSE of the path, and the share of it inside its 95 % intervals."""
    error = np.array([e.path - truth_of(x).path for x, e in zip(exposures, estimates, strict=True)])
    sd = np.array([e.path_sd for e in estimates])
    return np.sqrt(np.mean(error**2)), np.mean(np.abs(error) < 1.96 * sd)


def test_a_faster_plant_is_the_resonance_of_that_frequency():
    w, damping, factor = 2 * math.pi * 12 * 1e-3, 0.1, 1.1

    def resonance(speed):
        # Displacement, and velocity in the time of the plant: the same states at each speed.
        return expm(speed * np.array([[0.0, 1.0], [-w * w, -2 * damping * w]]))

    A = resonance(1.0)
    plant = dataclasses.replace(
        JITTER.plant, A=A, B=np.linalg.solve(A, (A - np.eye(2)) @ [[0.0], [1.0]]), process_noise=np.eye(1)
    )
    faster = at_frequency(plant, factor)
    np.testing.assert_allclose(faster.A, resonance(factor), atol=1e-12)
    own, other = (
        (stationary_covariance(p.A, p.B_w @ p.process_noise @ p.B_w.T), np.linalg.solve(np.eye(2) - p.A, p.B))
        for p in (plant, faster)
    )
    np.testing.assert_allclose(own[0], other[0], rtol=0.05, atol=1e-3 * own[0].max())
    np.testing.assert_allclose(own[1], other[1], rtol=1e-9, atol=1e-12)
    assert at_frequency(plant, 1.0) is plant


@pytest.fixture(scope="module")
def off():
    """A resonance that is 2 % faster than the rig file says, and goes on to rise by 1 % a minute."""
    truth = 1.02 + 0.01 * np.arange(60) * 0.2 / 60
    return truth, drifting(JITTER, truth, 1)


@pytest.mark.slow
def test_a_wrong_frequency_is_found_and_intervals_hold(off):
    truth, exposures = off
    fixed, following = (
        [estimator.step(exposure) for exposure in exposures]
        for estimator in (make_estimator(JITTER, "moments"), make_estimator(wandering(JITTER), "moments"))
    )
    assert all(each.wandering is None for each in fixed)
    found, sd = np.array([(found_in(each).mean[0], found_in(each).sd[0]) for each in following]).T
    assert sd[0] > 0.02
    assert sd[-10:].max() < 0.01
    assert (np.abs(found - truth) / sd)[20:].max() < 3
    (wrong, few), (right, most) = (judged(exposures[20:], each[20:]) for each in (fixed, following))
    assert right < 0.7 * wrong
    assert few < 0.8
    assert most > 0.9


def test_batches_give_the_same_bits(off):
    _, exposures = off
    one, other = (make_estimator(wandering(JITTER), "moments") for _ in range(2))
    for a, b in zip(other.steps(Batch(JITTER, exposures[:6])), map(one.step, exposures[:6]), strict=True):
        assert a.path.tobytes() == b.path.tobytes()
        assert found_in(a).mean.tobytes() == found_in(b).mean.tobytes()


def test_frames_that_cannot_be_used_leave_the_frequency_as_uncertain_as_it_was(off):
    _, exposures = off
    estimator = make_estimator(wandering(JITTER), "moments")
    for exposure in exposures[:12]:
        before = estimator.step(exposure)
    dark = dataclasses.replace(exposures[12], mask=np.zeros_like(exposures[12].mask))
    after = estimator.step(dark)
    assert after.status.name == "INPUT_INVALID"
    assert found_in(before).sd[0] <= found_in(after).sd[0] < 1.1 * found_in(before).sd[0]
    assert np.isfinite(after.path).all()
    assert np.isfinite(after.path_sd).all()


@pytest.mark.slow
def test_pixels_find_it_as_well():
    rig = dataclasses.replace(
        JITTER, plant=dataclasses.replace(
            JITTER.plant, process_noise=JITTER.plant.process_noise / 16,
            initial_covariance=JITTER.plant.initial_covariance / 16,
        ),
    )  # fmt: skip
    exposures = drifting(rig, np.full(30, 0.98), 5)
    estimator = make_estimator(
        wandering(rig, Wandering(parameter="frequency", largest=0.03, rate_per_minute=0.01)), "profile"
    )
    estimates = [estimator.step(exposure) for exposure in exposures]
    found = found_in(estimates[-1])
    assert abs(found.mean[0] - 0.98) < 3 * found.sd[0]
    assert found.sd[0] < 0.01
    assert judged(exposures[10:], estimates[10:])[1] > 0.88


def test_what_else_drifts_is_refused_with_what_to_do():
    other = wandering(JITTER, Wandering(parameter="gain", largest=0.3, rate_per_minute=0.02))
    with pytest.raises(EstimatorError, match="follows a frequency only, not gain: leave it out"):
        make_estimator(other, "moments")


def test_the_papers_estimators_take_the_plant_as_it_is():
    exposures = simulate(JITTER, 3, seed=1)
    for name in ("open-loop", "o1", "o3"):
        one, other = make_estimator(JITTER, name), make_estimator(wandering(JITTER), name)
        for exposure in exposures:
            assert one.step(exposure).path.tobytes() == other.step(exposure).path.tobytes()


@pytest.mark.parametrize(
    ("A", "message"),
    [
        (np.eye(2), r"stationary spread, and plant\.A has an eigenvalue of modulus 1"),
        (np.diag([0.5, -0.5]), "negative"),
    ],
)
def test_a_plant_without_a_frequency_is_refused(A, message):
    with pytest.raises(EstimatorError, match=message):
        make_estimator(dataclasses.replace(JITTER, plant=dataclasses.replace(wandering(JITTER).plant, A=A)), "moments")


def test_the_rig_file_says_so():
    text = (resources.files("aolink") / "rigs" / "jitter.toml").read_text(encoding="utf-8")
    table = "[plant.wandering]\nfrequency = 0.05\nrate_per_minute = 0.01\n"
    assert parse_rig(text.replace("[timing]", table + "\n[timing]")).plant.wandering == WANDERING
    assert parse_rig(text).plant.wandering is None
    with pytest.raises(RigError, match=r"plant\.wandering\.frequency"):
        parse_rig(text.replace("[timing]", table.replace("0.05", "0.5") + "\n[timing]"))
    other = parse_rig(text.replace("[timing]", table.replace("frequency", "sensor_noise") + "\n[timing]"))
    assert must_be(Wandering, other.plant.wandering).parameter == "sensor_noise"
    for wrong in (table + "gain = 0.1\n", table.replace("frequency = 0.05", "")):
        with pytest.raises(RigError, match="give one of frequency, gain, process_noise, kernel_width, sensor_noise"):
            parse_rig(text.replace("[timing]", wrong + "\n[timing]"))


@pytest.mark.slow
def test_a_frequency_that_nothing_is_seen_of_becomes_uncertain(off):
    """By as much as it may wander in the meantime."""
    _, exposures = off
    spread = []
    for minutes in (0, 20):
        estimator = make_estimator(wandering(JITTER), "moments")
        for exposure in exposures[:40]:
            estimator.step(exposure)
        dark = np.zeros_like(exposures[40].mask)
        first_step = exposures[40].first_step + round(minutes * 60 / JITTER.timing.fast_step_s)
        lost = dataclasses.replace(exposures[40], mask=dark, first_step=first_step)
        spread.append(float(found_in(estimator.step(lost)).sd[0]))
    assert spread[0] < 0.01
    assert spread[1] > 2 * spread[0]
