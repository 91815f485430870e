"""Compiled code for pixels and mixtures against its twins in NumPy, on frames of every kind."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from aolink.estimation import exposure_model, make_estimator
from aolink.estimation.compiled import modes as compiled_modes
from aolink.estimation.compiled.pixels import information_of_row, places_of
from aolink.estimation.frames.frame_data import Needs, Profile, SpotWindows
from aolink.estimation.frames.measure import measure
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.pixels import likelihood, modes
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture
from aolink.estimation.pixels.levenberg_marquardt import FIRST_DAMPING, FREE_DAMPING, LARGEST_DAMPING
from aolink.estimation.pixels.modes import (
    Modes,
    modes_of,
    spread_starts,
    without_repeats,
)
from aolink.estimation.pixels.profile import ProfileFilter
from aolink.numerics import batched
from aolink.numerics.covariance import cholesky
from aolink.optics.camera import to_density
from aolink.optics.sensor import Kernel
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.estimation.pixels import plain
from tests.estimation.pixels.plain import PlainView, by_moments, settled_modes, whitened
from tests.kinds import must_be, truth_of

LIVELY = load_rig("section-vi-lively")


def changed(rig, **sensor):
    return dataclasses.replace(rig, sensor=dataclasses.replace(rig.sensor, **sensor))


def exposures_of(rig, count, seed):
    steps = count * rig.timing.exposure_steps
    return simulate(rig, count, seed=seed, inputs=np.zeros((steps, rig.n_inputs)))


def side_by_side(rig, axes):
    return dataclasses.replace(rig, plant=dataclasses.replace(rig.plant, axes=axes))


AXES = 12
KINDS = {
    "lively": changed(LIVELY, noise_density=0.01),
    "bright": changed(LIVELY, noise_density=0.001),
    "shot noise": changed(LIVELY, noise_density=0.001, photoelectrons=300.0),
    "few pixels": changed(LIVELY, pixels=16, kernel=dataclasses.replace(LIVELY.sensor.kernel, sigma=0.1)),
    "fine pixels": changed(LIVELY, pixels=160, noise_density=0.001),
    "dark pixels": changed(LIVELY, noise_density=0.01),
    "between steps": dataclasses.replace(
        changed(LIVELY, noise_density=0.01), timing=dataclasses.replace(LIVELY.timing, exposure_offset=0.4)
    ),
    "jitter": load_rig("jitter"),
}


def looked_at(kind):
    """A view of many axes and a prior of their start states; the first of them is of a spot beyond the sensor."""
    rig = side_by_side(KINDS[kind], AXES)
    (exposure,) = exposures_of(rig, 1, 5)
    sensor = rig.sensor
    density = to_density(sensor, exposure.pixels).reshape(AXES, -1)
    mask = np.ones(density.shape, dtype=bool)
    if kind == "dark pixels":
        mask[:, ::7], mask[3], mask[4, :20] = False, False, False
    model = exposure_model(rig.plant, exposure.n_steps, exposure.start_offset)
    measured = Profile(density=np.where(mask, density, 0.0), mask=mask)
    view = likelihood.PixelView(
        sensor, model, model.response(exposure.inputs), measured, likelihood.reduction(model, sensor)
    )  # fmt: skip
    assert view.on_line
    n, P = rig.plant.n_states, rig.plant.initial_covariance / 9
    away = np.random.default_rng(1).standard_normal((AXES, n)) @ np.linalg.cholesky(P + 1e-12 * np.eye(n)).T
    mean = exposure.truth.start_state.reshape(AXES, n) + away
    mean[0, 0] += 30.0
    return view, PlainView.of(view), Gaussian(mean, np.tile(P, (AXES, 1, 1)))


@pytest.fixture(scope="module", params=KINDS)
def pair(request):
    return looked_at(request.param)


def test_places_beside_the_edges_of_pixels_beyond_the_sensor_and_without_a_number():
    edges = np.linspace(-0.8, 1.2, 41)
    beside = np.nextafter(edges, -9), np.nextafter(edges, 9)
    paths = np.concatenate([edges, *beside, [np.nan, np.inf, -1e300, 1e19]])
    firsts, nearest = np.empty(paths.shape, np.int64), np.empty(paths.shape, np.int64)
    away = np.empty(paths.shape)
    places_of(paths, -0.3, 20.0, 16, 12, 8, firsts, nearest, away)
    v = (paths + 0.3) * 20.0
    lit = (v > -4) & (v < 20)
    assert 20 < lit.sum() < paths.size - 20
    np.testing.assert_array_equal(firsts >= 0, lit)
    np.testing.assert_allclose((firsts - 4 + (nearest + 0.5) / 12 + away)[lit], v[lit], atol=1e-13)
    assert np.abs(away[lit]).max() < 0.5 / 12 + 1e-12


def test_the_search_starts_where_its_twin_does(pair):
    view, in_numpy, state = pair
    prior = view.reduced.prior(state)
    wide = by_moments(in_numpy, prior)
    (ours, squares), (theirs, their_squares) = (
        starts_of(each, prior, wide) for starts_of, each in ((spread_starts, view), (plain.spread_starts, in_numpy))
    )
    np.testing.assert_allclose(squares, their_squares, atol=1e-9 * their_squares.max())
    np.testing.assert_allclose(ours[:, 0], theirs[:, 0], atol=1e-6)
    # A direction is one whichever way it points.
    both = np.sort(ours[:, 1:3], axis=1), np.sort(theirs[:, 1:3], axis=1)
    assert np.quantile(np.abs(both[0] - both[1]), 0.9) < 1e-4


def test_every_start_leads_to_the_same_mode(pair):
    view, in_numpy, state = pair
    prior = view.reduced.prior(state)
    starts, _ = plain.spread_starts(in_numpy, prior, by_moments(in_numpy, prior))
    for k in range(starts.shape[1]):
        ours, theirs = (settled_modes(each, prior, starts[:, k : k + 1]) for each in (view, in_numpy))
        # A long search may end in another mode, as one that begins 1e-6 away may.
        settled = np.abs(ours.objective - theirs.objective) < 0.02
        assert settled.mean() > 0.6
        sd = np.sqrt(np.einsum("asii->asi", theirs.covariance))
        apart = np.abs(ours.mean - theirs.mean) / sd
        assert np.quantile(apart[settled], 0.95) < 0.15
        assert np.quantile(np.abs(ours.log_evidence - theirs.log_evidence)[settled], 0.95) < 0.15
        scaled = (ours.covariance - theirs.covariance) / (sd[..., :, None] * sd[..., None, :])
        assert np.quantile(np.abs(scaled[settled]), 0.95) < 0.1


def test_searches_that_end_early_find_the_modes_that_matter(pair):
    """With searches that end next to a mode that is known: the same modes that matter."""
    view, in_numpy, state = pair
    prior, some = view.reduced.prior(state), slice(1, None)  # not the one beyond the sensor
    prior = Gaussian(prior.mean[some], prior.covariance[some])
    wide, at_length = by_moments(in_numpy.part(some), prior), np.arange(AXES - 1) % 4 > 0
    ours, theirs = (
        without_repeats(found(each.part(some), prior, wide, at_length))
        for found, each in ((modes_of, view), (plain.modes_of, in_numpy))
    )
    found = 0
    for axis in range(AXES - 1):
        most = theirs.log_evidence[axis].max()
        for k in np.flatnonzero(theirs.log_evidence[axis] > most - 3):
            white = np.linalg.solve(
                np.linalg.cholesky(theirs.covariance[axis, k]), (ours.mean - theirs.mean[:, [k]])[axis].T
            )
            near = np.isfinite(ours.log_evidence[axis]) & ((white**2).sum(axis=0) < 1)
            found += near.any()
            assert near.any() or k != np.argmax(theirs.log_evidence[axis]) or ours.log_evidence[axis].max() > most - 0.5
    assert found > 0.8 * np.sum(theirs.log_evidence > theirs.log_evidence.max(axis=1)[:, None] - 3)


def test_a_mode_is_where_the_gradient_is_zero(pair):
    view, in_numpy, state = pair
    prior = view.reduced.prior(state)
    start = whitened(prior, by_moments(view, prior).mean[:, None])
    found = settled_modes(view, prior, start)
    t, root = found.mean[1:], np.linalg.cholesky(found.covariance[1:, 0])
    inverse, rest = np.linalg.inv(prior.covariance[1:]), in_numpy.part(slice(1, None))

    def objective(points):
        away = points - prior.mean[1:, None]
        return 0.5 * np.einsum("aki,aij,akj->ak", away, inverse, away) - rest.log_likelihood(rest.predicted(points))

    np.testing.assert_allclose(objective(t), found.objective[1:], atol=1e-3)
    for k in range(t.shape[2]):
        step = 1e-3 * root[:, None, :, k]
        slope = (objective(t + step) - objective(t - step)) / 2e-3
        # So near to the mode the objective is higher by 0.01, where a search ends at steps that change it by 0.03.
        assert np.quantile(np.abs(slope), 0.9) < 0.15


def test_modes_that_repeat_another_are_left_out():
    rng = np.random.default_rng(3)
    mean, root = rng.standard_normal((20, 7, 3)) * 0.4, np.linalg.cholesky(0.3 * np.eye(3) + 0.1)
    evidence, total, residual, objective = rng.standard_normal((4, 20, 7))
    evidence[0, 2] = -np.inf
    modes = Modes(mean, np.tile(root @ root.T, (20, 7, 1, 1)), evidence, total, residual, objective)
    ours, kept = without_repeats(modes), []
    for axis in range(20):
        own: list[int] = []
        for j in range(7):
            white = np.linalg.solve(root, (mean[axis, own] - mean[axis, j]).T)
            if np.isfinite(evidence[axis, j]) and not np.any(np.sum(white**2, axis=0) < 0.49):
                own.append(j)
        kept.append(own)
        there = slice(0, len(own))
        for field in ("mean", "covariance", "log_evidence", "total", "residual", "objective"):
            np.testing.assert_array_equal(getattr(ours, field)[axis, there], getattr(modes, field)[axis, own])
        assert np.all(ours.log_evidence[axis, len(own) :] == -np.inf)
        assert ours.best[axis] == np.argmin(objective[axis, own])
    assert ours.mean.shape[1] == max(map(len, kept))
    assert 20 < 140 - sum(map(len, kept)) < 120


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "shot noise"])  # whose dim pixels count otherwise
def test_chi_squares_at_a_mode_are_those_of_the_twin(kind):
    view, in_numpy, state = looked_at(kind)
    prior = view.reduced.prior(state)
    starts = whitened(prior, by_moments(view, prior).mean[:, None])
    ours, theirs = settled_modes(view, prior, starts), settled_modes(in_numpy, prior, starts)
    same = np.abs(ours.objective - theirs.objective) < 0.02
    assert same.mean() > 0.8
    np.testing.assert_allclose(ours.total[same], theirs.total[same], rtol=0.01, atol=0.1)
    np.testing.assert_allclose(ours.residual[same], theirs.residual[same], rtol=0.01, atol=0.1)


SPOTS = load_rig("single-lenslet")
PLANES: dict[str, dict[str, Any]] = {
    "round": {},
    "aslant": {"kernel": Kernel(shape="gaussian", sigma=0.13, matrix=((0.15, 0.05), (0.05, 0.09)))},
    "shot noise": {"photoelectrons": 300.0},
}


def looked_at_plane(kind, masked):
    """A view of one spot on a plane that moves along both directions, and the prior of t."""
    own = SPOTS.plant
    A, B, B_w, C, P = (linalg.block_diag(m, m) for m in (own.A, own.B, own.B_w, own.C, own.initial_covariance))
    plant = dataclasses.replace(
        own, A=A, B=B, B_w=B_w, C=C, initial_covariance=P, process_noise=0.1 * np.eye(2), initial_mean=np.zeros(4),
        axes=1,
    )  # fmt: skip
    rig = changed(dataclasses.replace(SPOTS, plant=plant), **PLANES[kind])
    (exposure,) = exposures_of(rig, 1, 3)
    mask = exposure.mask.copy()
    mask[:masked, ::3] = False
    measured, _ = measure(rig, dataclasses.replace(exposure, mask=mask), Needs(what="windows", least_usable=0.5))
    model, windows = exposure_model(plant, exposure.n_steps), must_be(SpotWindows, measured)
    view = likelihood.PixelView(
        rig.sensor, model, model.response(exposure.inputs), windows, likelihood.reduction(model, rig.sensor)
    )
    assert not view.on_line
    truth = exposure.truth.start_state.reshape(1, 4)
    return view, PlainView.of(view), Gaussian(truth, plant.initial_covariance[None] / 20)


def three_spots(one):
    """Three spots, each with a frame, a path and bad pixels of its own, made from one; and all of them together."""
    spots = [
        one._replace(
            y=one.y * (1 + spot), usable=np.roll(one.usable, spot, axis=3), inputs=one.inputs + 0.1 * spot,
            basis=np.ascontiguousarray(one.basis[:: -1 if spot == 1 else 1]),
        )
        for spot in range(3)
    ]  # fmt: skip
    joined = {
        name: np.concatenate([getattr(spot, name) for spot in spots], axis=axis)
        for name, axis in (("y", 1), ("usable", 1), ("inputs", 1), ("basis", 0))
    }
    return spots, one._replace(**joined)


def informed(seen, row, t):
    """Lower half of the information of coefficients t (n,), the score, the log-likelihood, and sum of score^2 / I."""
    path = seen.inputs[row] + np.einsum("oim,i->om", seen.basis, t)
    H, pull = np.zeros((len(t), len(t))), np.zeros(len(t))
    return H, pull, *information_of_row(seen, row, path, seen.basis, H, pull)


@pytest.mark.parametrize("gain", [0.0, 0.01])
def test_the_likelihood_of_several_spots_is_the_product_of_theirs(gain):
    view, _, state = looked_at_plane("round", 9)
    t = view.reduced.prior(state).mean[0]
    spots, joined = three_spots(view.seen._replace(gain=gain * view.seen.y.max()))
    together, *apart = (informed(each, 0, t) for each in (joined, *spots))
    for whole, *each in zip(together, *apart, strict=True):
        np.testing.assert_allclose(whole, sum(each), rtol=1e-9, atol=1e-9 * np.abs(whole).max())
    assert len({each[2] for each in apart}) == 3


@pytest.mark.parametrize("kind", [*KINDS, *PLANES])
def test_the_information_of_the_pixels_is_the_twins(kind):
    """With a spot in the window, one half outside and one quite outside."""
    view, in_numpy, state = looked_at_plane(kind, 9) if kind in PLANES else looked_at(kind)
    t = np.tile(view.reduced.prior(state).mean[-1:, None], (1, 3, 1))
    t[0, 1, 0] += 1.0
    t[0, 2, :4] += 7.0
    seen, last = view.seen, len(view.y) - 1
    twin = in_numpy.part(slice(last, None))
    f, J = twin.linearised(t)
    score, information = twin.information(f)
    residual = np.abs(view.y[last] - f[0]).sum(axis=1) / np.sqrt(view.read_noise)
    for k in range(3):
        H, pull, log_likelihood, square = informed(seen, last, t[0, k])
        expected = (J[0, k] * information[0, k][:, None]).T @ J[0, k]
        np.testing.assert_allclose(np.tril(H), np.tril(expected), atol=1e-4 * np.abs(expected).max() + 1e-12)
        scale = np.abs(score[0, k]) @ np.abs(J[0, k])
        np.testing.assert_allclose(pull, score[0, k] @ J[0, k], atol=1e-4 * scale.max() + 1e-9)
        # An error of the light by 4e-7 of the brightest pixel, times the residuals, in units of the pixels' noise.
        off = 4e-7 * f.max() / np.sqrt(view.read_noise) * (residual[k] + 1)
        assert log_likelihood == pytest.approx(twin.log_likelihood(f)[0, k], rel=1e-9, abs=off)
        lit = information[0, k] > 0
        # With shot noise a pixel of next to no light counts otherwise than one of none.
        assert view.gain or square == pytest.approx((score[0, k][lit] ** 2 / information[0, k][lit]).sum(), rel=1e-4)


@pytest.mark.parametrize("kind", [*KINDS, *PLANES])
def test_reversals_of_the_best_are_those_of_the_twin(kind):
    """With no pass of the search modes are where it starts, and after them the reversals of the best."""
    view, in_numpy, state = looked_at_plane(kind, 0) if kind in PLANES else looked_at(kind)
    axes = len(view.y)
    if kind in PLANES:  # a start state that hardly anything is known of: its path may well be the reverse
        state = Gaussian(state.mean, 100 * state.covariance)
    prior = view.reduced.prior(state)
    starts, _ = plain.spread_starts(in_numpy, prior, by_moments(in_numpy, prior))
    starts = np.ascontiguousarray(starts[:, :3])
    found = Modes.none(axes, 6, starts.shape[2])
    compiled_modes.find_modes(
        view.seen, prior.mean, prior.covariance, starts, np.full(axes, 3), view.whole_nodes,
        modes.precision_of_reversal(view), 0, FIRST_DAMPING, LARGEST_DAMPING, FREE_DAMPING, 0.0, *found,
    )  # fmt: skip
    ends = prior.mean[:, None] + batched.matmul(starts, batched.transpose(cholesky(prior.covariance)))
    best = ends[np.arange(axes), np.argmin(found.objective[:, :3], axis=1)]
    expected = plain.reversed_starts(in_numpy, prior, best[:, None])
    ours = whitened(prior, found.mean[:, 3:])
    there = np.isfinite(found.log_evidence[:, 3:])
    assert there.mean() > 0.3
    assert axes == 1 or len(set(np.argmin(found.objective[1:, :3], axis=1))) > 1
    np.testing.assert_allclose(ours[there], expected[there], atol=1e-4 * np.abs(expected[there]).max())


@pytest.mark.parametrize("kind", PLANES)
def test_the_modes_of_a_spot_on_a_plane_are_those_of_the_twin(kind):
    view, in_numpy, state = looked_at_plane(kind, 0)
    prior = view.reduced.prior(state)
    wide, at_length = by_moments(view, prior), np.ones(1, dtype=bool)
    ours, theirs = (
        without_repeats(found(each, prior, wide, at_length))
        for found, each in ((modes_of, view), (plain.modes_of, in_numpy))
    )
    assert ours.objective.min() == pytest.approx(theirs.objective.min(), abs=0.05)
    sd = np.sqrt(np.diag(theirs.covariance[0, theirs.best[0]]))
    found, expected = (each.mean[0, each.best[0]] / sd for each in (ours, theirs))
    np.testing.assert_allclose(found, expected, atol=0.2)


def merged_once(m):
    """The two components whose merger costs least are one, in each axis."""
    axes, count = m.log_weight.shape
    first, second = np.triu_indices(count, 1)
    w = np.exp(m.log_weight)
    total = w[:, first] + w[:, second]
    share = w[:, second] / np.where(total > 0, total, 1.0)
    away = m.mean[:, second] - m.mean[:, first]
    P, Q = m.covariance[:, first], m.covariance[:, second]
    outer = away[..., :, None] * away[..., None, :]
    a, b = share[..., None, None], (share * (1 - share))[..., None, None]
    merged = (1 - a) * P + a * Q + b * outer
    logs = np.linalg.slogdet(m.covariance)[1]
    cost = 0.5 * (total * np.linalg.slogdet(merged)[1] - w[:, first] * logs[:, first] - w[:, second] * logs[:, second])
    chosen = np.argmin(cost, axis=1)
    rows, i, j = np.arange(axes), first[chosen], second[chosen]
    mean, covariance, log_weight = m.mean.copy(), m.covariance.copy(), m.log_weight.copy()
    mean[rows, i] += share[rows, chosen][:, None] * away[rows, chosen]
    covariance[rows, i] = merged[rows, chosen]
    log_weight[rows, i] = np.logaddexp(log_weight[rows, i], log_weight[rows, j])
    keep = np.ones((axes, count), dtype=bool)
    keep[rows, j] = False

    def kept(values):
        return values[keep].reshape(axes, count - 1, *values.shape[2:])

    return GaussianMixture(kept(log_weight), kept(mean), kept(covariance))


@pytest.mark.parametrize("seed", range(4))
def test_components_are_merged_as_pair_by_pair(seed):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((9, 8, 3, 3)) * 0.5
    weight = rng.uniform(0.1, 1, (9, 8))
    m = GaussianMixture(
        np.log(weight / weight.sum(axis=1)[:, None]), rng.standard_normal((9, 8, 3)),
        root @ root.swapaxes(-1, -2) + 0.1 * np.eye(3),
    )  # fmt: skip
    slow = m
    for _ in range(5):
        slow = merged_once(slow)
    fast, order = m.reduced(3), np.argsort(-slow.log_weight, axis=1)
    rows = np.arange(9)[:, None]
    np.testing.assert_allclose(fast.log_weight, slow.log_weight[rows, order], rtol=1e-9)
    np.testing.assert_allclose(fast.mean, slow.mean[rows, order], rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(fast.covariance, slow.covariance[rows, order], rtol=1e-7, atol=1e-9)
    # What costs nothing to merge is merged, however few there are.
    twice = GaussianMixture(
        *(np.concatenate([each, each], axis=1) for each in (m.log_weight - np.log(2), m.mean, m.covariance))
    )
    assert twice.reduced(16, 1e-6).mean.shape[1] == 8


def test_a_plant_without_process_noise():
    plant = dataclasses.replace(LIVELY.plant, process_noise=0.0 * LIVELY.plant.process_noise)
    ProfileFilter(plant, LIVELY.sensor).warm_up()
    rig = dataclasses.replace(LIVELY, plant=plant)
    estimator = make_estimator(rig, "profile")
    for exposure in simulate(rig, 12, seed=2):
        estimate = estimator.step(exposure)
    assert np.sqrt(np.mean((estimate.path - truth_of(exposure).path) ** 2)) < 0.03
