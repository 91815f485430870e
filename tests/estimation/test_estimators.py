"""Estimators by name: exposures in, estimates out; what bad exposures get; the numbers of the paper's plant."""

import dataclasses
import pickle

import numpy as np
import pytest

from aolink.errors import EstimatorError
from aolink.estimation import (
    ESTIMATOR_NAMES,
    BlurFilter,
    Driver,
    Estimator,
    Measurement,
    Status,
    exposure_model,
    make_estimator,
    path_from_coefficients,
    run,
    score,
)
from aolink.estimation.estimate import COMPARED
from aolink.estimation.frames.measure import measure
from aolink.estimation.kalman.path_moments import PathMoments
from aolink.optics.camera import pixel_noise_sd, to_counts
from aolink.optics.kernel import exposure_density
from aolink.plant.lifting import lift
from aolink.recording.reestimate import first_difference
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.kinds import line_of, must_be, truth_of

PAPER = ("o1", "o2", "o3")
NAMES = ESTIMATOR_NAMES


@pytest.fixture(scope="module")
def exposures(rig):
    return simulate(rig, 120, seed=4)


@pytest.fixture(scope="module")
def estimates(rig, exposures):
    return run(rig, exposures, NAMES)


def arrays(estimate):
    """All but the inputs, which are the exposure's."""
    values = {name: getattr(estimate, name) for name in COMPARED if name != "inputs"}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def assert_sound(estimate):
    for name, value in arrays(estimate).items():
        assert np.isfinite(value).all(), name
    for covariance in (estimate.start_covariance, estimate.end_covariance, estimate.coefficient_covariance):
        assert np.linalg.eigvalsh(covariance).min() >= -1e-10 * np.abs(covariance).max()


def with_timing(rig, exposure_steps, frame_period_steps):
    timing = dataclasses.replace(rig.timing, exposure_steps=exposure_steps, frame_period_steps=frame_period_steps)
    return dataclasses.replace(rig, timing=timing)


def test_there_is_no_other_estimator(rig):
    with pytest.raises(EstimatorError, match="no estimator 'momnts': did you mean moments"):
        make_estimator(rig, "momnts")
    with pytest.raises(EstimatorError, match="no estimator 'o4': use one of open-loop, o1"):
        make_estimator(rig, "o4")
    with pytest.raises(EstimatorError, match="no option 'tuning'"):
        make_estimator(rig, "o1", tuning=3)
    with pytest.raises(EstimatorError, match="engine = 'some'"):
        make_estimator(rig, "o1", engine="some")


@pytest.mark.parametrize("name", NAMES)
def test_estimates_are_sound_and_complete(rig, estimates, exposures, name):
    for exposure, estimate in zip(exposures, estimates[name], strict=True):
        assert_sound(estimate)
        assert (estimate.estimator, estimate.frame_id, estimate.first_step) == (
            name,
            exposure.frame_id,
            exposure.first_step,
        )
        assert estimate.status == (Status.PREDICTED if name == "open-loop" else Status.OK)
        assert estimate.reason in ("", "more than one path explains the blur")
        assert estimate.path.shape == estimate.path_sd.shape == (1, 200)
        np.testing.assert_array_equal(estimate.coefficients[:, :2], estimate.start_state)


@pytest.mark.parametrize("name", ["open-loop", *PAPER])
def test_the_path_starts_at_the_start_state_and_goes_with_the_inputs(rig, estimates, exposures, name):
    estimate, exposure = estimates[name][9], exposures[9]
    x = estimate.start_state[0]
    for k in range(200):
        assert estimate.path[0, k] == pytest.approx((rig.plant.C @ x)[0], abs=1e-12)
        x = rig.plant.A @ x + rig.plant.B @ exposure.inputs[k]
    np.testing.assert_allclose(estimate.end_state[0], x, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_a_recorded_estimate_unfolds_to_the_same_bits(rig, estimates, exposures, name):
    estimate, model = estimates[name][9], exposure_model(rig.plant, 200)
    path, sd = path_from_coefficients(
        model, np.array(estimate.coefficients), np.array(estimate.coefficient_covariance), exposures[9].inputs
    )
    assert path.tobytes() == estimate.path.tobytes()
    assert sd.tobytes() == estimate.path_sd.tobytes()


def test_the_driver_gives_what_each_estimator_gives_alone(rig, estimates, exposures):
    alone = make_estimator(rig, "o3")
    for exposure, together in zip(exposures[:20], estimates["o3"], strict=False):
        for name, value in arrays(alone.step(exposure)).items():
            assert value.tobytes() == getattr(together, name).tobytes(), name


@pytest.mark.parametrize("name", NAMES)
def test_an_estimator_that_was_saved_goes_on_where_it_was(rig, exposures, estimates, name):
    estimator = make_estimator(rig, name)
    for exposure in exposures[:5]:
        estimator.step(exposure)
    restored = pickle.loads(pickle.dumps(estimator))
    again = [restored.step(exposure) for exposure in exposures[5:10]]
    assert first_difference(estimates[name][5:10], again) is None


def test_the_truth_changes_nothing_and_a_pixel_does(rig, estimates, exposures):
    blind = [dataclasses.replace(e, truth=None) for e in exposures[:5]]
    again = run(rig, blind, ["o3"])["o3"]
    assert all(a.path.tobytes() == b.path.tobytes() for a, b in zip(again, estimates["o3"], strict=False))
    pixels = exposures[2].pixels.copy()
    pixels[0, 3] += 1
    changed = [*blind[:2], dataclasses.replace(blind[2], pixels=pixels), *blind[3:]]
    other = run(rig, changed, ["o3"])["o3"]
    assert other[1].path.tobytes() == again[1].path.tobytes()
    assert other[2].path.tobytes() != again[2].path.tobytes()


# What the paper's plant gives (estimation.md's table, whose runs are others; errors of the mean some 5 %)


@pytest.mark.slow
def test_looking_helps_on_the_lively_plant(rig):
    series = simulate(rig, 600, seed=5, inputs=np.zeros((120_000, 1)))
    scores = {n: score(series, e, skip=10) for n, e in run(rig, series, ["open-loop", "o1", "o3"]).items()}
    assert scores["open-loop"].path_rmse == pytest.approx(0.146, rel=0.25)
    assert scores["o1"].path_rmse == pytest.approx(0.0623, rel=0.08)
    assert scores["o3"].path_rmse == pytest.approx(0.0611, rel=0.08)


def test_off_centre_the_second_moment_reads_the_position_again(rig, exposures, estimates):
    """The drive takes the spot to +-0.5, where y_2 is a second reading with noise of its own."""
    o1, o3 = (score(exposures, estimates[name], skip=10) for name in ("o1", "o3"))
    assert o3.path_rmse < 0.95 * o1.path_rmse


@pytest.mark.slow
def test_looking_adds_nothing_at_the_printed_noise():
    rig = load_rig("section-vi")
    series = simulate(rig, 120, seed=4)
    scores = {name: score(series, e, skip=10) for name, e in run(rig, series, NAMES).items()}
    for name in ("open-loop", *PAPER):
        assert scores[name].path_rmse == pytest.approx(scores["open-loop"].path_rmse, rel=0.06)
        assert scores[name].start_rmse == pytest.approx(0.067, rel=0.1)


def test_shuffled_frames_ruin_the_estimate(rig, exposures, estimates):
    order = np.random.default_rng(1).permutation(len(exposures))
    shuffled = [dataclasses.replace(e, pixels=exposures[i].pixels) for e, i in zip(exposures, order, strict=True)]
    for name in (*PAPER[::2], "moments", "profile"):
        ruined = score(exposures, run(rig, shuffled, [name])[name], skip=10)
        assert ruined.path_rmse > 2 * score(exposures, estimates[name], skip=10).path_rmse


def test_exposures_are_taken_as_they_come(rig, exposures):
    order = [0, 1, 5, 2, 3]
    given = run(rig, [exposures[i] for i in order], ["o1"])["o1"]
    assert [e.frame_id for e in given] == [i + 1 for i in order]
    assert "before" in given[3].reason
    for estimate in given:
        assert_sound(estimate)


def test_open_loop_knows_how_far_noise_goes_inside_the_exposure(rig, exposures, estimates):
    model = exposure_model(rig.plant, 200)
    sd = estimates["open-loop"][30].path_sd[0]
    stationary = np.sqrt(rig.plant.initial_covariance[0, 0])
    np.testing.assert_allclose(sd, stationary, rtol=0.01)
    assert model.n_coefficients > 2


# Exposures that cannot be used


def broken(exposure, kind):
    pixels, mask = exposure.pixels.copy(), exposure.mask.copy()
    if kind == "missing":
        mask[0, 10:20] = False
        pixels[0, 10:20] = 0
    elif kind == "saturated":
        pixels[0, 20] = 65535
    elif kind == "clipped at zero":
        pixels[0, 20] = 0
    elif kind == "dark":
        rng = np.random.default_rng(0)
        pixels[:] = np.rint(20000 + 2000 * np.sqrt(0.01 / 0.05) * rng.standard_normal((1, 40)))
    elif kind == "of another camera":
        pixels, mask = np.zeros((3, 4), np.uint16), np.ones((3, 4), bool)
    return dataclasses.replace(exposure, pixels=pixels, mask=mask)


WORDS = {
    "missing": "10 of 40 pixels are missing",
    "saturated": "1 of 40 pixels are at an end",
    "clipped at zero": "1 of 40 pixels are at an end",
    "dark": "no spot",
    "of another camera": "pixels, the rig's sensor",
}


@pytest.mark.parametrize("kind", WORDS)
@pytest.mark.parametrize("name", PAPER)
def test_an_exposure_that_cannot_be_used_gives_a_prediction_and_says_why(rig, exposures, estimates, name, kind):
    series = [*exposures[:6], broken(exposures[6], kind), exposures[7]]
    given = run(rig, series, [name])[name]
    assert given[6].status == Status.INPUT_INVALID
    assert WORDS[kind] in given[6].reason
    assert_sound(given[6])
    np.testing.assert_array_equal(given[6].start_state, estimates[name][5].end_state)
    assert given[6].innovation.shape == (1, 0)
    assert given[7].status == Status.OK


BLUR = pytest.mark.parametrize("name", ["moments", "profile"])


@BLUR
def test_pixels_that_are_missing_or_stuck_are_left_out_of_the_blur(rig, exposures, estimates, name):
    holed = []
    for e in exposures[:40]:
        pixels, mask = e.pixels.copy(), e.mask.copy()
        pixels[0, 17], pixels[0, 25] = 0, 65535  # one never came, one is stuck
        mask[0, 17] = False
        holed.append(dataclasses.replace(e, pixels=pixels, mask=mask))
    given = run(rig, holed, [name])[name]
    assert {e.status for e in given} == {Status.OK}
    assert "left out" in given[0].reason
    whole = score(exposures[:40], estimates[name][:40], 10)
    assert score(exposures[:40], given, 10).path_rmse < 1.5 * whole.path_rmse


@BLUR
def test_half_a_frame_or_none_is_not_enough(rig, exposures, name):
    mask = exposures[1].mask.copy()
    mask[0, :30] = False
    half, dark = dataclasses.replace(exposures[1], mask=mask), broken(exposures[2], "dark")
    given = run(rig, [exposures[0], half, dark], [name])[name]
    assert [e.status for e in given[1:]] == [Status.INPUT_INVALID] * 2
    assert "no spot" in given[2].reason


@BLUR
def test_a_spot_that_is_not_where_it_should_be_is_lost_and_found(rig, name):
    exposures = simulate(rig, 30, seed=6)
    moved, sensor = list(exposures[:12]), line_of(rig)
    for e in exposures[12:]:
        path = np.clip(truth_of(e).path - 0.8 * np.sign(truth_of(e).path.mean()), -0.9, 0.9)
        noise = np.random.default_rng(e.frame_id).standard_normal((1, 40)) * pixel_noise_sd(sensor)
        counts = to_counts(sensor, exposure_density(sensor.kernel, sensor.edges, path) + noise)
        moved.append(dataclasses.replace(e, pixels=counts))
    estimates = run(rig, moved, [name])[name]
    statuses = [e.status for e in estimates]
    assert set(statuses[:12]) == {Status.OK}
    assert statuses[12] == Status.GATED
    assert Status.DIVERGED in statuses[12:]
    for estimate in estimates:
        assert_sound(estimate)


def test_open_loop_does_not_care(rig, exposures):
    assert make_estimator(rig, "open-loop").step(broken(exposures[0], "missing")).status == Status.PREDICTED


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_input_that_is_not_a_number_does_not_poison_the_filter(rig, exposures, value):
    inputs = exposures[1].inputs.copy()
    inputs[5] = value
    series = [exposures[0], dataclasses.replace(exposures[1], inputs=inputs), exposures[2]]
    for name in NAMES:
        given = run(rig, series, [name])[name]
        assert "not a number" in given[1].reason
        for estimate in given:
            assert_sound(estimate)


# Gaps


def test_dead_time_is_bridged_with_its_inputs(rig):
    gappy = with_timing(rig, 200, 230)
    series = simulate(gappy, 40)
    given = run(gappy, series, ["o1", "open-loop"])
    transition, noise = lift(rig.plant, 30)
    before, after = given["open-loop"][3], given["open-loop"][4]
    x = before.end_state[0]
    for u in series[4].lead_inputs:
        x = rig.plant.A @ x + rig.plant.B @ u
    np.testing.assert_allclose(after.start_state[0], x, atol=1e-12)
    bridged = transition @ before.end_covariance[0] @ transition.T + noise
    np.testing.assert_allclose(after.start_covariance[0], bridged, atol=1e-12)
    assert {e.reason for e in given["o1"]} == {""}
    assert score(series, given["o1"], 5).path_rmse < 0.7 * score(series, given["open-loop"], 5).path_rmse


def test_lost_frames_are_bridged(rig, exposures, estimates):
    """The assembler hands the inputs of lost frames on as lead inputs."""
    lead = np.concatenate([exposures[5].inputs, exposures[6].inputs])
    series = [*exposures[:5], dataclasses.replace(exposures[7], lead_inputs=lead), *exposures[8:]]
    given = run(rig, series, ["open-loop", "o3"])
    assert {e.reason for e in given["o3"]} == {""}
    # Prediction over one long gap and over three exposures is the same.
    np.testing.assert_allclose(given["open-loop"][5].start_state, estimates["open-loop"][7].start_state, atol=1e-12)
    assert np.trace(given["o3"][5].end_covariance[0]) >= np.trace(estimates["o3"][7].end_covariance[0])


def test_a_gap_with_unknown_inputs_is_bridged_and_said(rig, exposures):
    given = run(rig, [exposures[0], exposures[3]], ["o1"])["o1"]
    assert "inputs of 400 of the 400 steps before it are not known" in given[1].reason
    assert given[1].status == Status.OK
    assert_sound(given[1])


def test_a_first_exposure_is_led_in(rig, exposures):
    led = dataclasses.replace(exposures[1], lead_inputs=exposures[0].inputs)
    given = make_estimator(rig, "open-loop").step(led)
    np.testing.assert_allclose(
        given.start_state, run(rig, exposures[:2], ["open-loop"])["open-loop"][1].start_state, atol=1e-12
    )
    assert given.reason == ""


# Plants that never settle


def test_o1_without_a_steady_gain_has_one_that_varies(rig):
    angle = 2 * np.pi * 10e-3
    A = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    plant = dataclasses.replace(
        rig.plant, A=A, B=np.zeros((2, 1)), B_w=np.array([[0.0], [1e-4]]), initial_covariance=np.eye(2) * 0.01
    )
    undamped = dataclasses.replace(rig, plant=plant)
    series = simulate(undamped, 20)
    steady = make_estimator(undamped, "o1")
    varying = Estimator(undamped, "o1", BlurFilter(plant, PathMoments(plant, (1,))))
    for exposure in series:
        ours, theirs = steady.step(exposure), varying.step(exposure)
        np.testing.assert_allclose(ours.end_covariance, theirs.end_covariance, rtol=1e-9)
    for estimates in run(undamped, series, NAMES).values():
        for estimate in estimates:
            assert_sound(estimate)


def test_a_random_walk_is_followed(rig):
    plant = dataclasses.replace(
        rig.plant, A=np.eye(1), B=np.eye(1) * 1e-6, B_w=np.eye(1), C=np.eye(1),
        process_noise=np.eye(1) * 1e-6, initial_mean=np.zeros(1), initial_covariance=np.eye(1) * 0.01,
    )  # fmt: skip
    walk = dataclasses.replace(rig, plant=plant)
    series = simulate(walk, 60)
    given = run(walk, series, ["open-loop", "o1"])
    assert score(series, given["o1"], 20).path_rmse < score(series, given["open-loop"], 20).path_rmse
    assert {e.status for e in given["o1"]} == {Status.OK}


def test_a_frame_of_the_rig_has_its_moments(rig, exposures):
    measured = must_be(Measurement, measure(rig, exposures[0], PathMoments(rig.plant, (1, 2)).needs)[0])
    path = exposures[0].truth.path[0]
    errors = measured.value[0] - [path.mean(), np.mean(path**2)]
    assert (np.abs(errors) < 5 * np.sqrt(measured.covariance[0].diagonal())).all()


def test_drivers_keep_the_order_of_their_names(rig, exposures):
    driver = Driver(rig, ["o3", "open-loop"])
    assert [e.estimator for e in driver.step(exposures[0])] == ["o3", "open-loop"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["section-vi-lively", "sh-4x4"])
def test_it_does_not_matter_how_many_exposures_are_handed_over_at_once(name):
    """1, 7 or all of them, damaged, blank and shorter ones among them: bit for bit."""
    rig = load_rig(name)
    count = 66 if name == "section-vi-lively" else 15
    some = list(simulate(rig, count, seed=2))
    dark = np.full(rig.sensor.shape, round(rig.sensor.black_level), np.uint16)
    mask = np.ones(rig.sensor.shape, bool)
    mask[0, 3] = False
    some[3] = dataclasses.replace(some[3], pixels=dark)
    some[5] = dataclasses.replace(some[5], mask=mask)
    some[6] = dataclasses.replace(some[6], pixels=np.full(rig.sensor.shape, rig.sensor.full_scale, np.uint16))
    some[9] = dataclasses.replace(some[9], pixels=np.roll(some[9].pixels, some[9].pixels.shape[1] // 2, axis=1))
    some[11] = dataclasses.replace(some[11], lead_inputs=some[10].inputs[:7], first_step=some[11].first_step + 7)
    some[12] = dataclasses.replace(some[12], n_steps=150, inputs=some[12].inputs[:150])
    names = ("o1", "o3", "moments")
    one_by_one, seven, at_once = Driver(rig, names), Driver(rig, names), Driver(rig, names)
    sevens = (pair for k in range(0, count, 7) for pair in seven.steps(some[k : k + 7]))
    for exposure, theirs, (same, ours) in zip(some, sevens, at_once.steps(iter(some)), strict=True):
        assert same is exposure
        expected = one_by_one.step(exposure)
        assert first_difference(expected, ours) is None
        assert first_difference(expected, theirs[1]) is None


@pytest.mark.parametrize("name", ["section-vi-lively", "sh-4x4"])
def test_the_compiled_loop_is_the_filter_in_arrays(name):
    """With exposures that are refused, one that is not a number, and a gap."""
    rig = load_rig(name)
    some = list(simulate(rig, 60, seed=5))
    for k in (20, 40, 41, 42, 43):
        some[k] = dataclasses.replace(some[k], pixels=some[k - 7].pixels[:, ::-1].copy())
    some[30] = dataclasses.replace(some[30], inputs=np.full_like(some[30].inputs, np.nan))
    some[50:] = [dataclasses.replace(each, first_step=each.first_step + 9) for each in some[50:]]
    written, arrays = Driver(rig, ["o3"]), Driver(rig, ["o3"])
    arrays.estimators = [Estimator(rig, "o3", BlurFilter(rig.plant, PathMoments(rig.plant, (1, 2))))]
    ours, theirs = ([each for _, (each,) in driver.steps(some)] for driver in (written, arrays))
    for one, two in zip(ours, theirs, strict=True):
        assert (one.status, one.reason) == (two.status, two.reason)
        for field in ("start_state", "start_covariance", "end_state", "end_covariance", "innovation", "nis"):
            np.testing.assert_allclose(getattr(one, field), getattr(two, field), rtol=1e-9, atol=1e-12)
    assert {each.status for each in ours} >= {Status.OK, Status.GATED}


@pytest.mark.parametrize("name", ["o1", "o3", "moments", "profile"])
@pytest.mark.parametrize("rig_name", ["section-vi-lively", "tip-tilt"])
def test_a_session_may_begin_while_the_plant_moves(rig_name, name):
    """The first exposure widens a prior that does not know of it: no frame is refused, and the next ones are right."""
    rig = load_rig(rig_name)
    away = np.sqrt(np.diag(rig.plant.initial_covariance))
    rig = dataclasses.replace(
        rig, plant=dataclasses.replace(rig.plant, initial_covariance=rig.plant.initial_covariance / 30**2)
    )
    moving = dataclasses.replace(rig, plant=dataclasses.replace(rig.plant, initial_mean=rig.plant.initial_mean + away))
    exposures = list(simulate(moving, 30, seed=3))
    estimates = run(rig, exposures, [name])[name]
    assert {each.status for each in estimates} == {Status.OK}
    errors = [np.abs(e.path - truth_of(x).path) / e.path_sd for e, x in zip(estimates, exposures, strict=True)]
    if name != "o3":  # its one linearisation is about a prior that is far away
        assert np.mean(np.array(errors[:3]) < 3) > 0.8
    assert np.mean(np.array(errors) < 3) > 0.9
