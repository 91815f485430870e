"""Moments of the path of a picture of anything, against pictures that were moved along known paths."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from aolink.numerics.arrays import FloatArray
from aolink.optics.texture import MARGIN, Texture

INSIDE = np.s_[24:72, 24:72]


def scene(detail: float = 1.6) -> FloatArray:
    rough = ndimage.gaussian_filter(np.random.default_rng(3).standard_normal((96, 96)), detail)
    return np.asarray((rough - rough.min()) / np.ptp(rough))


def edge() -> FloatArray:
    x, y = np.meshgrid(np.arange(96.0), np.arange(96.0))
    return np.asarray(1 / (1 + np.exp(-((x - 48) + 0.5 * (y - 48)) / 1.5)))


def exposed(whole: FloatArray, path: FloatArray) -> FloatArray:
    """The middle of a scene that moves along a path, (2, steps)."""
    return np.asarray(np.mean([ndimage.shift(whole, at[::-1]) for at in path.T], axis=0)[INSIDE])


def arc(amplitude: float, phase: float, rest: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
    turn = 2 * np.pi * 1.15 * (np.arange(40) + 0.5) / 40 + phase
    moved = amplitude * np.stack([np.sin(turn), 0.5 * np.cos(turn + 0.6)])
    return np.asarray(moved + np.array(rest)[:, None])


@pytest.mark.parametrize("amplitude", [0.3, 0.8])
@pytest.mark.parametrize("rest", [(0.0, 0.0), (2.3, -1.7)])
def test_mean_and_covariance_are_those_of_the_path(amplitude: float, rest: tuple[float, float]) -> None:
    texture = Texture(scene()[INSIDE])
    for phase in (0.0, 2.0):
        path = texture.axes @ arc(amplitude, phase, rest)
        seen = texture.seen(exposed(scene(), arc(amplitude, phase, rest)))
        assert seen is not None
        covariance = np.cov(path, bias=True)
        assert seen.mean == pytest.approx(path.mean(axis=1), abs=0.01)
        truth = [covariance[0, 0], covariance[0, 1], covariance[1, 1]]
        assert seen.spread == pytest.approx(truth, abs=max(0.08 * np.trace(covariance), 0.006))
        assert seen.gain == pytest.approx(1.0, abs=0.03)


def test_noise_is_told_from_what_the_fit_leaves() -> None:
    texture, noise = Texture(scene()[INSIDE]), np.random.default_rng(5)
    path = arc(0.3, 1.0)
    still = exposed(scene(), path)
    found = [texture.seen(still + 0.02 * noise.standard_normal(still.shape)) for _ in range(40)]
    values = np.array([[*each.mean, *each.spread] for each in found if each])
    said = np.array([[*each.mean_variance, *each.spread_variance] for each in found if each])
    assert len(values) == 40
    assert values.std(axis=0) / np.sqrt(said.mean(axis=0)) == pytest.approx(np.ones(5), abs=0.35)


def test_an_edge_shows_the_motion_across_it() -> None:
    texture = Texture(edge()[INSIDE])
    assert texture.edge
    path = texture.axes @ arc(0.7, 0.5)
    seen = texture.seen(exposed(edge(), arc(0.7, 0.5)))
    assert seen is not None
    assert seen.mean[0] == pytest.approx(path[0].mean(), abs=0.02)
    assert seen.spread[0] == pytest.approx(path[0].var(), rel=0.1)
    assert np.isinf([seen.mean_variance[1], *seen.spread_variance[1:]]).all()
    assert (len(texture.known_means), len(texture.known_spreads)) == (1, 1)


def test_something_else_or_too_far_is_not_taken_for_it() -> None:
    texture = Texture(scene()[INSIDE])
    other = ndimage.gaussian_filter(np.random.default_rng(9).standard_normal((48, 48)), 1.6)
    assert texture.seen(other) is None
    assert texture.seen(exposed(scene(), arc(0.1, 0.0, (MARGIN + 2.0, 0.0)))) is None
    assert texture.seen(np.full((48, 48), 0.5)) is None


def test_a_fit_beside_the_mean_gives_the_same_moments() -> None:
    texture, path = Texture(scene(2.5)[INSIDE]), arc(0.3, 1.0, (0.4, -0.3))
    image = ndimage.gaussian_filter(exposed(scene(2.5), path), texture.smooth)
    beside, about = texture.fit(image, np.zeros(2)), texture.fit(image, path.mean(axis=1))
    assert beside.mean == pytest.approx(about.mean, abs=0.02)
    assert beside.spread == pytest.approx(about.spread, abs=0.03)
