"""Wavefront reconstruction: against dense least squares and known wavefronts."""

from collections.abc import Callable

import numpy as np
import pytest

from aolink.optics.lenslets import Lenslets
from aolink.optics.turbulence import FrozenFlow, Layer
from aolink.optics.wavefront import (
    SpotReconstructor,
    lenslet_zernike_slopes,
    modal_reconstructor,
    wavefront_rms,
    zernike_slopes,
)
from aolink.optics.zernike import zernike_gradient
from tests.optics.frozen_flow import wavefront
from tests.spot_frames import nodes_and_places, square_lattice

ROUND = Lenslets(grid=(14, 14), pitch_m=0.1, focal_length_m=1.0, pupil_diameter_m=1.4, obstruction=0.3)
LIT = (ROUND.light > 0.5).reshape(ROUND.grid)


def grid_slopes(lenslets: Lenslets, gradient: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    return lenslets.mean_slopes(gradient).reshape(*lenslets.grid, 2)


def test_zonal_is_the_shortest_dense_least_squares_solution():
    rng = np.random.default_rng(1)
    lit = rng.random((5, 6)) < 0.8
    slopes = rng.standard_normal((*lit.shape, 2))
    # The equations written down one by one.
    rows, right = [], []
    for y, x in np.ndindex(*lit.shape):
        for axis, (b, a) in enumerate([(y, x + 1), (y + 1, x)]):
            if b < lit.shape[0] and a < lit.shape[1] and lit[y, x] and lit[b, a]:
                row = np.zeros(lit.shape)
                row[b, a], row[y, x] = 1, -1
                rows.append(row.ravel())
                right.append(slopes[y, x, axis] + slopes[b, a, axis])
    expected = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0].reshape(lit.shape)
    positions, edges = square_lattice(lit, 2.0)
    found = SpotReconstructor(positions, edges)(slopes[lit])
    np.testing.assert_allclose(found, expected[lit], atol=1e-10)


def test_zonal_is_exact_for_tilt_and_focus():
    square = Lenslets(grid=(14, 14), pitch_m=0.1, focal_length_m=1.0)  # means over whole lenslets
    slopes = grid_slopes(square, lambda p: 2 * p + [0.3, -0.1])
    found = SpotReconstructor(*square_lattice(LIT, 0.1))(slopes[LIT])
    true = ((square.centres_m**2).sum(1) + square.centres_m @ [0.3, -0.1])[LIT.ravel()]
    np.testing.assert_allclose(found, true - true.mean(), atol=1e-12)


@pytest.mark.slow
def test_zonal_finds_turbulence_but_for_what_lenslets_cannot_resolve():
    pitch, layer = 0.1, Layer(r0_m=0.2, wind_m_s=(0, 0))
    square = Lenslets(grid=(30, 30), pitch_m=pitch, focal_length_m=1.0)
    flow = FrozenFlow(layer, np.random.default_rng(5), shortest_m=0.1)
    slopes = (flow.slope_waves(square) @ flow.blown(np.zeros(1))).real.reshape(900, 2)
    true = wavefront(flow, square.centres_m)
    found = SpotReconstructor(*square_lattice(np.ones((30, 30), dtype=bool), pitch))(slopes)
    unresolved = wavefront_rms(found - true) * 2 * np.pi / layer.wavelength_m
    # Fitting and aliasing together, some 0.3 to 0.5 (d/r0)^(5/3) rad^2.
    assert unresolved**2 < 0.5 * (pitch / layer.r0_m) ** (5 / 3)
    assert wavefront_rms(true) * 2 * np.pi / layer.wavelength_m > 8 * unresolved


def lattice_of(kind, pitch=1.0, radius=8.2, turn=13.0):
    """Positions of a round pupil's lenslets and the pairs that are a pitch apart, found by their distance alone."""
    positions = nodes_and_places(kind, pitch, turn, None, radius)[1]
    distance = np.linalg.norm(positions[:, None] - positions, axis=-1)
    return positions, np.argwhere(np.triu(abs(distance - pitch) < 0.01 * pitch))


def smooth_waves(seed, shortest):
    """A random smooth wavefront as a sum of plane waves: its value and its exact gradient at points (..., 2)."""
    rng = np.random.default_rng(seed)
    k = 2 * np.pi / shortest * rng.uniform(-0.7, 0.7, (12, 2))
    phase, height = rng.uniform(0, 2 * np.pi, 12), rng.standard_normal(12)
    return (
        lambda p: np.cos(p @ k.T + phase) @ height,
        lambda p: (-np.sin(p @ k.T + phase) * height) @ k,
    )


def cell_means(gradient, positions, kind, pitch, turn):
    """Mean of a gradient over each square or hexagon, by random points of the cell, that is nearest to its middle."""
    points = np.random.default_rng(0).uniform(-pitch, pitch, (4000, 2))
    around = nodes_and_places(kind, pitch, turn, None, 1.9 * pitch)[1]
    points = points[np.linalg.norm(points[:, None] - around, axis=-1).min(axis=1) >= np.hypot(*points.T) - 1e-12]
    return np.stack([gradient(p + points).mean(axis=0) for p in positions])


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_spots_are_exact_for_focus_astigmatism_and_tilt_however_the_lattice_is_turned(kind):
    positions, edges = lattice_of(kind)
    A, tilt = np.array([[0.5, 0.2], [0.2, -0.1]]), np.array([0.3, -0.4])
    found = SpotReconstructor(positions, edges)(positions @ (2 * A) + tilt)
    true = np.einsum("ni,ij,nj->n", positions, A, positions) + positions @ tilt
    np.testing.assert_allclose(found, true - true.mean(), atol=1e-10)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_spots_find_a_smooth_wavefront_to_a_thirtieth(kind, seed):
    positions, edges = lattice_of(kind)
    value, gradient = smooth_waves(seed, shortest=10.0)  # ten lenslets
    slopes = cell_means(gradient, positions, kind, 1.0, 13.0)
    true = value(positions)
    assert wavefront_rms(SpotReconstructor(positions, edges)(slopes) - true) < wavefront_rms(true) / 30


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_parts_that_do_not_touch_have_mean_zero_each_and_are_told(kind):
    positions, edges = lattice_of(kind)
    side = np.where(abs(positions[:, 0]) > 1.2, np.sign(positions[:, 0]), 0)
    lone = np.argmin(np.hypot(*(positions - [0, 0]).T))
    kept = (side != 0) | (np.arange(len(positions)) == lone)  # two halves, and one lenslet between them by itself
    number = np.cumsum(kept) - 1
    inner = edges[kept[edges].all(axis=1)]
    focus = (positions**2).sum(axis=1)[kept]
    reconstruct = SpotReconstructor(positions[kept], number[inner])
    found = reconstruct(2 * positions[kept])
    assert reconstruct.parts.max() == 2
    for part in range(3):
        mine = reconstruct.parts == part
        np.testing.assert_allclose(found[mine], focus[mine] - focus[mine].mean(), atol=1e-10)
        assert len(set(side[kept][mine])) == 1
    # Modes go on across the gap: they have all of it.
    modes = zernike_slopes(positions[kept], tuple(range(2, 11)), 9.0)
    modal = modal_reconstructor(modes, np.ones(kept.sum())) @ (2 * positions[kept]).ravel()
    assert modal[2] == pytest.approx(81 / (2 * np.sqrt(3)))
    np.testing.assert_allclose(np.delete(modal, 2), 0, atol=1e-9)


def test_spots_without_slopes_of_their_own_are_refused():
    positions, edges = lattice_of("hexagonal", radius=3)
    with pytest.raises(ValueError, match="expected"):
        SpotReconstructor(positions, edges)(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="not a number"):
        SpotReconstructor(positions, edges)(np.full((len(positions), 2), np.nan))
    with pytest.raises(ValueError, match="no spots"):
        SpotReconstructor(np.zeros((0, 2)), np.zeros((0, 2), dtype=int))


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_modes_come_back_from_means_over_the_lenslets(kind):
    positions, _ = lattice_of(kind, radius=5.2)
    true = np.random.default_rng(8).standard_normal(14)
    radius = 6.0

    def gradient(points):
        return sum(c * zernike_gradient(i, points / radius) / radius for i, c in enumerate(true, 2))

    slopes = cell_means(gradient, positions, kind, 1.0, 13.0)
    middle = modal_reconstructor(zernike_slopes(positions, tuple(range(2, 16)), radius), np.ones(len(positions)))
    np.testing.assert_allclose(middle @ slopes.ravel(), true, atol=0.15)


def test_many_frames_at_once_are_each_by_itself():
    slopes = np.random.default_rng(0).standard_normal((3, int(LIT.sum()), 2))
    reconstruct = SpotReconstructor(*square_lattice(LIT, 0.1))
    np.testing.assert_allclose(reconstruct(slopes)[1], reconstruct(slopes[1]), atol=1e-12)


def test_modal_finds_its_own_modes_and_weights_partly_lit_lenslets():
    modes = lenslet_zernike_slopes(ROUND, 15)
    assert modes.shape == (196, 2, 14)
    true = np.random.default_rng(2).standard_normal(14)
    reconstruct = modal_reconstructor(modes, ROUND.light)
    np.testing.assert_allclose(reconstruct @ np.nan_to_num(modes @ true).ravel(), true, atol=1e-9)


def test_more_modes_than_slopes_are_refused():
    few = Lenslets(grid=(3, 3), pitch_m=0.1, focal_length_m=1.0)
    with pytest.raises(ValueError, match="do not determine the modes"):
        modal_reconstructor(lenslet_zernike_slopes(few, 40), few.light)


def test_points_without_a_value_do_not_count():
    assert wavefront_rms(np.array([1.0, 3.0, np.nan])) == 1.0


def test_gradients_of_modes_are_slopes():
    # One mode by hand: Noll 4 is sqrt(3) (2 r^2 - 1).
    p = np.array([[0.2, -0.1]])
    np.testing.assert_allclose(zernike_gradient(4, p), 4 * np.sqrt(3) * p)
