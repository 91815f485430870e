"""All spots of one large plant at once: against the dense estimators on a small membrane, and a large one's claims."""

import dataclasses
import tracemalloc
from copy import copy

import numpy as np
import pytest
from scipy import linalg

from aolink.errors import EstimatorError
from aolink.estimation import SpotWindows, Status, exposure_model, make_estimator, run, score, smooth
from aolink.estimation.frames.centroid_noise import centroid_covariance
from aolink.estimation.frames.frame_data import Measurement
from aolink.estimation.frames.measure import measure
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.kalman.path_moments import predicted_moments
from aolink.estimation.kalman.steady_gain import steady_gain
from aolink.estimation.kalman.update import joseph_update
from aolink.estimation.model.dense import DenseModel
from aolink.estimation.model.factored import FactoredModel
from aolink.estimation.model.joint_paths import JointPaths
from aolink.estimation.model.quadrature import quadrature_paths
from aolink.estimation.moments import windowed
from aolink.estimation.moments.joint_moments import JointMoments, by_spot
from aolink.estimation.moments.windowed import WindowedMoments
from aolink.estimation.pixels import joint_pixels
from aolink.estimation.pixels.joint_pixels import JointPixels, find_mode
from aolink.estimation.pixels.likelihood import PixelView, Reduction
from aolink.exposure import Exposure
from aolink.optics.sensor import Kernel
from aolink.rig import Rig, load_rig, parse_rig
from aolink.simulation.model import simulate
from tests.estimation.pixels.plain import PlainView, settled_modes, whitened
from tests.kinds import must_be, spots_of, truth_of

NAMES = ("o1", "o3", "moments", "profile")
TILTED = Kernel(shape="gaussian", sigma=0.9, matrix=((0.95, 0.25), (0.25, 0.8)))


@pytest.fixture(scope="module", params=["round", "tilted, late"])
def rig(small_membrane: Rig, request: pytest.FixtureRequest) -> Rig:
    if request.param == "round":
        return small_membrane
    timing = dataclasses.replace(small_membrane.timing, exposure_offset=0.4)
    return dataclasses.replace(
        small_membrane, sensor=dataclasses.replace(small_membrane.sensor, kernel=TILTED), timing=timing
    )


@dataclasses.dataclass
class Frame:
    """One exposure with a prior that is neither at the truth nor certain."""

    model: FactoredModel
    exposure: Exposure
    windows: SpotWindows
    prior: Gaussian
    """Prior of the state, (1, n_states)."""

    @property
    def response(self):
        return self.model.response(self.exposure.inputs)


@pytest.fixture(scope="module")
def frame(rig: Rig) -> Frame:
    estimator = make_estimator(rig, "moments")
    exposures = simulate(rig, 3, seed=4)
    for each in exposures[:2]:
        estimate = estimator.step(each)
    windows = must_be(SpotWindows, measure(rig, exposures[2], estimator.filter.needs)[0])
    model = must_be(FactoredModel, exposure_model(rig.plant, 200, exposures[2].start_offset))
    return Frame(model, exposures[2], windows, Gaussian(estimate.end_state, estimate.end_covariance))


def dense_view(rig: Rig, frame: Frame, paths: JointPaths) -> PlainView:
    """The same pixels with a dense basis of the same coefficients and nodes."""
    model, size = frame.model, paths.size
    reduced = Reduction(
        expand=np.eye(model.n_coefficients)[:, :size], left_out=np.zeros((0, 0)), end_rows=model.end_rows[:, :size],
        end_remainder=model.end_remainder, widening=paths.widening, resolution=paths.resolution,
        least_blur=1.0,
    )  # fmt: skip
    (level,) = paths.resolution.of(frame.response.path).tolist()
    view: PlainView = PlainView.of(PixelView(rig.sensor, model, frame.response, frame.windows, reduced, level))
    return view


def foreseen(frame: Frame, paths: JointPaths) -> JointPaths:
    return paths.foreseen(np.zeros(paths.size), frame.response, 0)


def joint_view(rig: Rig, frame: Frame, paths: JointPaths) -> JointPixels:
    return JointPixels(spots_of(rig), foreseen(frame, paths), by_spot(frame.windows, 0))


def whole_prior(frame: Frame, size: int) -> Gaussian:
    n = frame.model.plant.n_states
    mean, covariance = np.zeros((1, size)), np.eye(size)[None].copy()
    mean[:, :n], covariance[:, :n, :n] = frame.prior.mean, frame.prior.covariance
    return Gaussian(mean, covariance)


# The pixels


@pytest.mark.slow
def test_pixels_and_what_they_tell_are_those_of_a_dense_view(rig, frame):
    paths = JointPaths(frame.model, rig.sensor)
    ours, theirs = joint_view(rig, frame, paths), dense_view(rig, frame, paths)
    t = np.random.default_rng(0).multivariate_normal(
        whole_prior(frame, paths.size).mean[0], whole_prior(frame, paths.size).covariance[0]
    )
    f, J = theirs.linearised(t[None, None])
    weigh, information = theirs.information(f)
    at = ours.at(t)
    dense = (J[0, 0] * information[0, 0][:, None]).T @ J[0, 0]
    scale = np.sqrt(np.diag(dense).max())
    np.testing.assert_allclose(ours.paths.information(at.information) / scale**2, dense / scale**2, atol=1e-10)
    np.testing.assert_allclose(ours.paths.score(at.score) / scale, weigh[0, 0] @ J[0, 0] / scale, atol=1e-8)
    assert at.log_likelihood == pytest.approx(theirs.log_likelihood(f)[0, 0], rel=1e-12)


def test_slopes_are_those_of_finite_differences(rig, frame):
    paths = JointPaths(frame.model, rig.sensor)
    view = joint_view(rig, frame, paths)
    t, rng = whole_prior(frame, paths.size).mean[0], np.random.default_rng(1)
    at = view.at(t)
    slope = paths.score(at.score)
    for _ in range(3):
        step = rng.standard_normal(paths.size) * 1e-4
        difference = (view.at(t + step).log_likelihood - view.at(t - step).log_likelihood) / 2
        assert slope @ step == pytest.approx(difference, rel=1e-4, abs=1e-6)
    for d in (0, 1):
        sides = []
        for sign in (1, -1):
            inputs = view.paths.inputs.reshape(paths.spots, 2, -1).copy()
            inputs[:, d] += sign * 1e-5
            moved = copy(view)
            moved.paths = copy(view.paths)
            moved.paths.inputs = inputs.reshape(view.paths.inputs.shape)
            sides.append(moved.at(t))
        total = at.displacement_score[:, d].sum()
        assert total == pytest.approx((sides[0].log_likelihood - sides[1].log_likelihood) / 2e-5, rel=1e-4)
    # What tells of a displacement is what tells of a course that is one.
    constant = copy(view)
    constant.paths = copy(view.paths)
    constant.paths.functions = np.column_stack([np.ones(len(view.paths.weights)), view.paths.functions[:, 1:]])
    at = constant.at(t)
    np.testing.assert_allclose(at.of_displacement, at.information[:, :, 0, :, 0], rtol=1e-9)
    np.testing.assert_allclose(at.displaced, at.information[:, :, :, :, 0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(at.displacement_score, at.score[:, :, 0], rtol=1e-9)


@pytest.mark.slow
def test_the_mode_and_its_covariance_are_those_of_the_dense_search(rig, frame):
    paths = JointPaths(frame.model, rig.sensor)
    before = whole_prior(frame, paths.size)
    dense = dense_view(rig, frame, paths)
    modes = settled_modes(dense, before, whitened(before, before.mean[:, None]))
    view = joint_view(rig, frame, paths)
    precision = paths.prior_information(frame.prior.covariance[0])
    theirs = find_mode(view, before.mean[0], precision, modes.mean[0, 0])
    # It stays where the dense search has ended, for one of Newton's steps from there goes nowhere.
    sd = np.sqrt(np.diag(modes.covariance[0, 0]))
    np.testing.assert_array_equal(theirs.x, modes.mean[0, 0])
    uphill = paths.score(theirs.seen.score) - precision @ (theirs.x - before.mean[0])
    np.testing.assert_allclose(np.linalg.solve(theirs.hessian, uphill) / sd, 0, atol=0.05)
    own = find_mode(view, before.mean[0], precision, before.mean[0])
    assert own.objective == pytest.approx(theirs.objective, abs=joint_pixels.CONVERGED)
    spread = np.linalg.inv(theirs.hessian)
    np.testing.assert_allclose(spread / sd / sd[:, None], modes.covariance[0, 0] / sd / sd[:, None], atol=0.03)


# The estimators


def test_o3_is_the_dense_filter_in_every_step(small_membrane):
    rig, plant = small_membrane, small_membrane.plant
    exposures = simulate(rig, 6)
    needs = make_estimator(rig, "o3").filter.needs
    model, P, mean = DenseModel(plant, 200), plant.initial_covariance, plant.initial_mean
    for exposure, found in zip(exposures, run(rig, exposures, ["o3"])["o3"], strict=True):
        seen = must_be(Measurement, measure(rig, exposure, needs)[0])
        response = exposure_model(plant, 200).response(exposure.inputs)
        h, H = predicted_moments(model, response, mean[None], (1, 2))
        noise = linalg.block_diag(*seen.covariance[0])
        step = joseph_update(Gaussian(mean[None], P[None]), seen.value - h, H, noise[None])
        mean = model.transition @ step.posterior.mean[0] + response.end[0]
        P = model.transition @ step.posterior.covariance[0] @ model.transition.T + model.process_noise
        sd = np.sqrt(np.diag(P))
        np.testing.assert_allclose(found.end_state[0] / sd, mean / sd, atol=1e-6)
        np.testing.assert_allclose(found.end_covariance[0] / sd / sd[:, None], P / sd / sd[:, None], atol=1e-6)
        np.testing.assert_allclose(found.nis, step.nis, rtol=1e-8)
        variances = np.einsum("amm->am", step.innovation_covariance)
        np.testing.assert_allclose(found.innovation_covariance, variances, rtol=1e-8)


def test_moments_are_the_dense_ones_but_for_errors_that_spots_share(rig, frame, monkeypatch):
    """All coefficients, the same nodes, and no errors shared: then both are the same least squares."""
    paths = JointPaths(frame.model, rig.sensor, left_out=1e-4)
    assert paths.size == frame.model.n_coefficients
    spots = rig.plant.n_outputs // 2
    nodes = quadrature_paths(frame.model, frame.response, paths.resolution.levels[0])

    monkeypatch.setattr(windowed, "MOST_INFLATION", 1.0)
    monkeypatch.setattr(JointMoments, "left_out", 1e-4)

    class Apart(WindowedMoments):
        """Without errors that spots share."""

        def regression(self, *arguments):
            fit = super().regression(*arguments)
            return fit._replace(remainder=fit.remainder * np.kron(np.eye(spots), np.ones((8, 8))))

    before = whole_prior(frame, paths.size)
    dense = Apart(rig.sensor, rig.plant.n_outputs)
    expected = dense.updated(frame.model.dynamics, nodes, before, frame.windows)
    found = JointMoments(rig.sensor, rig.plant.n_outputs).update(frame.model, frame.response, before, frame.windows)
    sd = np.sqrt(np.diag(expected.posterior.covariance[0]))
    np.testing.assert_allclose(found.posterior.mean[0] / sd, expected.posterior.mean[0] / sd, atol=1e-6)
    ours, dense = (each.posterior.covariance[0] / sd / sd[:, None] for each in (found, expected))
    np.testing.assert_allclose(ours, dense, atol=1e-6)
    np.testing.assert_allclose(found.innovation, expected.innovation, atol=1e-8)
    np.testing.assert_allclose(found.nis, expected.nis, rtol=1e-5)
    S = expected.innovation_covariance[0]
    np.testing.assert_allclose(found.innovation_covariance[0], np.diag(S), rtol=1e-6)


@pytest.mark.slow
def test_the_gain_of_o1_solves_the_riccati_equation(small_membrane):
    plant = small_membrane.plant
    model, (R,) = exposure_model(plant, 200), centroid_covariance(small_membrane)
    gain = must_be(np.ndarray, steady_gain(model, model.process_noise, R))
    H, noise = model.mean_row, linalg.block_diag(*R)
    P = linalg.solve_discrete_are(model.transition.T, H.T, model.process_noise, noise)
    np.testing.assert_allclose(gain, P @ H.T @ np.linalg.inv(H @ P @ H.T + noise), atol=1e-6 * np.abs(gain).max())
    # A plant that keeps what it is never shown: two actuators in the place of each, of which only sums are seen.
    one = np.eye(80)
    unseen = dataclasses.replace(
        plant, A=one, B=one, B_w=one, C=np.repeat(np.eye(40), 2, axis=1), process_noise=one, initial_mean=np.zeros(80),
        initial_covariance=one,
    )  # fmt: skip
    model = exposure_model(unseen, 4)
    assert steady_gain(model, model.process_noise, np.tile(np.eye(2), (20, 1, 1))) is None


@pytest.fixture(scope="module")
def membrane() -> Rig:
    return load_rig("membrane-12x12")


@pytest.mark.slow
def test_288_states_are_told_by_200_slopes_with_the_certainty_that_is_claimed(membrane):
    """Path error after three exposures: o1 0.27, o3 0.24, moments 0.13, profile 0.09 slope units."""
    exposures = simulate(membrane, 9)
    found = {name: score(exposures, each, 3) for name, each in run(membrane, exposures, NAMES).items()}
    assert found["moments"].path_rmse < 0.7 * found["o1"].path_rmse
    assert found["profile"].path_rmse < 0.8 * found["moments"].path_rmse
    for name, share in (("moments", 0.1), ("profile", 0.3)):
        for consistency in (found[name].start_nees, found[name].end_nees):
            assert consistency.mean == pytest.approx(288, rel=share)
    assert found["moments"].nis.mean == pytest.approx(800, rel=0.05)
    assert found["profile"].nis.mean == pytest.approx(200, rel=0.15)


@pytest.mark.slow
def test_nothing_is_as_large_as_a_dense_basis(membrane):
    """Outputs times steps times coefficients would be 220 MB."""
    exposures = simulate(membrane, 2)
    estimators = [make_estimator(membrane, name) for name in ("o3", "moments", "profile")]
    for each in estimators:
        each.step(exposures[0])
    tracemalloc.start()
    for each in estimators:
        each.step(exposures[1])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 60e6


@pytest.mark.slow
def test_frames_in_the_wrong_order_ruin_the_estimate(membrane):
    exposures = simulate(membrane, 6)
    order = [0, 5, 2, 1, 4, 3]
    mixed = [
        dataclasses.replace(e, pixels=exposures[k].pixels, mask=exposures[k].mask)
        for e, k in zip(exposures, order, strict=True)
    ]
    right, wrong = (score(exposures, run(membrane, each, ["profile"])["profile"], 1) for each in (exposures, mixed))
    assert right.path_rmse < 0.6 * wrong.path_rmse


@pytest.mark.slow
def test_partly_lit_lenslets_have_their_share_of_the_light():
    """A pupil before the small membrane: what the pixels are expected to hold is what they do."""
    text = load_rig("membrane-12x12").toml.replace("slope_unit_rad", "pupil_m = 3.0e-3\nslope_unit_rad")
    rig = parse_rig(text)
    assert must_be(np.ndarray, spots_of(rig).spot_light).min() < 0.9
    exposures = simulate(rig, 4)
    for name in ("moments", "profile"):
        estimates = run(rig, exposures, [name])[name]
        found = score(exposures, estimates, 1)
        assert found.nis.low * 0.9 < found.nis.mean < found.nis.high * 1.2
        assert found.end_nees.mean == pytest.approx(288, rel=0.3)


def test_what_came_later_tells_more(small_membrane):
    exposures = simulate(small_membrane, 6)
    estimates = run(small_membrane, exposures, ["profile"])["profile"]
    filtered, smoothed = (
        score(exposures, each).path_rmse for each in (estimates, smooth(small_membrane.plant, exposures, estimates))
    )
    assert smoothed < 0.95 * filtered


# Trust


@pytest.mark.parametrize("name", ["o3", "moments", "profile"])
def test_whatever_the_frame_estimates_are_numbers_and_recover(small_membrane, name):
    rig = small_membrane
    exposures, rng = simulate(rig, 14), np.random.default_rng(1)
    for k in (3, 4, 5, 6):
        pixels = rng.integers(500, 2500, rig.sensor.shape).astype(np.uint16)
        exposures[k] = dataclasses.replace(exposures[k], pixels=pixels if k % 2 else exposures[k].pixels[::-1])
    estimates = run(rig, exposures, [name])[name]
    assert {e.status for e in estimates[3:7]} != {Status.OK}
    for e in estimates:
        assert np.isfinite(e.path).all()
        assert np.isfinite(e.path_sd).all()
        assert np.isfinite(e.nis).all()
        assert np.linalg.eigvalsh(e.coefficient_covariance[0]).min() > -1e-10
    assert estimates[-1].status == Status.OK


@pytest.mark.parametrize("name", ["moments", "profile"])
def test_a_part_of_a_window_that_is_missing_is_left_out(small_membrane, name):
    exposures = simulate(small_membrane, 5)
    mask = np.ones(small_membrane.sensor.shape, dtype=bool)
    mask[:3, :20] = False
    hit = [*exposures[:4], dataclasses.replace(exposures[4], mask=mask)]
    whole, found = (run(small_membrane, each, [name])[name][4] for each in (exposures, hit))
    assert found.status == Status.OK
    assert found.reason == "60 of 4096 pixels are missing: left out"
    np.testing.assert_allclose(found.path, whole.path, atol=2 * whole.path_sd.max())


@pytest.mark.parametrize("name", ["moments", "profile"])
def test_a_window_that_is_missing_costs_its_own_spot(small_membrane, name):
    rig, exposures = small_membrane, simulate(small_membrane, 5)
    mask = np.ones(rig.sensor.shape, dtype=bool)
    mask[16:32, :16] = False
    estimators = [make_estimator(rig, name) for _ in range(2)]
    for exposure in exposures[:4]:
        whole, found = (each.step(exposure) for each in estimators)
    whole = estimators[0].step(exposures[4])
    found = estimators[1].step(dataclasses.replace(exposures[4], mask=mask))
    assert found.status == Status.OK
    assert found.reason == "1 of 16 spots left out: 256 of 4096 pixels are missing"
    own = slice(8, 10)  # the fifth spot's slopes, known by those around it, and worse than before
    assert (found.path_sd[own] > whole.path_sd[own]).all()
    truth = truth_of(exposures[4]).path
    assert np.sqrt(np.mean((found.path - truth) ** 2)) < 1.5 * np.sqrt(np.mean((whole.path - truth) ** 2))
    mask[:, :32] = False
    mask[:32] = False
    gone = estimators[1].step(dataclasses.replace(exposures[4], mask=mask))
    assert gone.status == Status.INPUT_INVALID


def test_a_large_plant_that_is_not_of_equal_systems_is_refused(membrane):
    W = membrane.plant.process_noise.copy()
    W[0, 1] = W[1, 0] = 1.0
    other = dataclasses.replace(membrane, plant=dataclasses.replace(membrane.plant, process_noise=W))
    with pytest.raises(EstimatorError, match="equal systems"):
        make_estimator(other, "profile")


def test_several_copies_of_a_large_plant_are_each_as_alone(small_membrane):
    """Two copies side by side before one sensor."""
    rig = small_membrane
    two = dataclasses.replace(
        rig, plant=dataclasses.replace(rig.plant, axes=2), sensor=dataclasses.replace(rig.sensor, grid=(8, 4)),
    )  # fmt: skip
    first, second = simulate(rig, 3, seed=1), simulate(rig, 3, seed=2)
    joined = [
        dataclasses.replace(
            a,
            pixels=np.vstack([a.pixels, b.pixels]),
            mask=np.vstack([a.mask, b.mask]),
            inputs=np.hstack([a.inputs, b.inputs]),
            lead_inputs=np.hstack([a.lead_inputs, b.lead_inputs]),
            truth=None,
        )
        for a, b in zip(first, second, strict=True)
    ]
    for name in ("o3", "moments", "profile"):
        both = run(two, joined, [name])[name][-1]
        for axis, series in enumerate((first, second)):
            alone = run(rig, series, [name])[name][-1]
            np.testing.assert_allclose(both.end_state[axis], alone.end_state[0], atol=1e-9)
            np.testing.assert_allclose(both.end_covariance[axis], alone.end_covariance[0], atol=1e-9)
            np.testing.assert_allclose(both.path[32 * axis : 32 * (axis + 1)], alone.path, atol=1e-9)
