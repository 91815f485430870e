"""Gradients of compiled log-likelihoods, against the twin in NumPy and against the log-likelihoods themselves."""

import numpy as np
import pytest

from aolink.estimation.compiled.pixels import log_likelihoods_and_gradients, log_likelihoods_of_row
from tests.estimation.compiled.test_pixels import (
    KINDS,
    MANY,
    PLANES,
    log_likelihoods,
    looked_at,
    looked_at_plane,
    three_spots,
)

ALL = pytest.mark.parametrize("kind", [*KINDS, *PLANES])


def looked(kind, masked=9):
    return looked_at_plane(kind, masked) if kind in PLANES else looked_at(kind)


def drawn(view, state, seed=2):
    """Points about the prior's mean; a few far from it, where hardly a pixel is lit or none."""
    prior = view.reduced.prior(state)
    rng = np.random.default_rng(seed)
    t = prior.mean[:, None] + rng.standard_normal((len(prior.mean), MANY, view.reduced.size)) * 0.3
    t[:, -20:-10, 0] += 1.0
    t[:, -10:, : min(4, view.reduced.size)] += 7.0
    return t


@pytest.mark.slow
@ALL
def test_gradients_are_the_twins_and_log_likelihoods_those_without(kind):
    view, in_numpy, state = looked(kind)
    t = drawn(view, state)
    with_them, gradients = view.log_likelihoods_and_gradients(t)
    np.testing.assert_allclose(with_them, log_likelihoods(view.seen, t), rtol=1e-11)
    f, J = in_numpy.linearised(t)
    score, _ = in_numpy.information(f)
    expected = np.einsum("akp,akpi->aki", score, J)
    # The light's slopes of the table are right to 3e-5 of the steepest, those of whole frames to a little more.
    size = np.einsum("akp,akpi->aki", np.abs(score), np.abs(J)).max(axis=1, keepdims=True)
    worst = (np.abs(gradients - expected) / (size + 1e-300)).max()
    assert worst < 5e-5


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["lively", "dark pixels", "round", "aslant", "shot noise"])
def test_points_have_the_same_gradient_wherever_they_are_among_others(kind):
    view, _, state = looked(kind)
    t = np.ascontiguousarray(drawn(view, state)[-1].T)
    whole, part = np.zeros_like(t), np.zeros_like(t)
    out = np.empty(MANY)
    log_likelihoods_of_row(view.seen, len(view.y) - 1, t, 0, MANY, out, whole)
    log_likelihoods_of_row(view.seen, len(view.y) - 1, t, 37, 133, out, part)
    np.testing.assert_allclose(part[:, 37:133], whole[:, 37:133], rtol=1e-12, atol=1e-9 * np.abs(whole).max())
    assert not part[:, :37].any()
    assert not part[:, 133:].any()


@pytest.mark.slow
def test_the_gradient_of_several_spots_is_the_sum_of_theirs():
    view, _, state = looked_at_plane("round", 9)
    one, t = view.seen, np.ascontiguousarray(drawn(view, state).transpose(0, 2, 1))
    spots, joined = three_spots(one)
    out, apart, together = np.empty((1, MANY)), np.zeros_like(t), np.zeros_like(t)
    for spot in spots:
        log_likelihoods_and_gradients(spot, t, out, apart)  # which adds them
    log_likelihoods_and_gradients(joined, t, out, together)
    np.testing.assert_allclose(together, apart, rtol=1e-9, atol=1e-9 * np.abs(apart).max())


@pytest.mark.rare
@ALL
def test_rough_log_likelihoods_and_gradients_are_near_the_exact_ones(kind):
    view, _, state = looked(kind)
    t, rough = drawn(view, state)[:, :-20], view.rough()
    exact, slopes = view.log_likelihoods_and_gradients(t)
    found, rough_slopes = rough.log_likelihoods_and_gradients(t)
    # The light that is left out hides in the noise of a pixel where the path is that of the frame; elsewhere an error
    # of the light counts as often as the frame is away from it.
    for each in (found, log_likelihoods(rough.seen, t)):
        worst = (np.abs(each - exact) / (0.02 * np.sqrt(np.maximum(1.0, -exact)) + 3e-6 * np.abs(exact))).max()
        assert worst < 1.0
        assert each.tobytes() != exact.tobytes()
    worst = (np.abs(rough_slopes - slopes) / np.abs(slopes).max()).max()
    assert worst < 0.02
