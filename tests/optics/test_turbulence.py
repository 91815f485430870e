"""Turbulence: structure function against the analytic one of another library, wind, slopes."""

import numpy as np
import pytest

from aolink.optics.lenslets import Lenslets
from aolink.optics.turbulence import FrozenFlow, Layer
from tests.optics.frozen_flow import wavefront
from tests.structure_function import structure_function

LAYER = Layer(r0_m=0.15, wind_m_s=(8.0, -3.0), outer_scale_m=20.0)
LENSLETS = Lenslets(grid=(4, 4), pitch_m=0.1, focal_length_m=1.0)


@pytest.mark.slow
def test_screens_have_the_analytic_structure_function():
    separations = np.array([0.05, 0.15, 0.5, 1.5, 5.0, 15.0])
    turn = np.linspace(0, np.pi, 8, endpoint=False)
    ahead = separations[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    points = np.concatenate([np.zeros((1, 2)), ahead.reshape(-1, 2)])
    squares, seeds = np.zeros((len(separations), len(turn))), 400
    for seed in range(seeds):
        flow = FrozenFlow(LAYER, np.random.default_rng(seed), shortest_m=0.01)
        w = wavefront(flow, points) * 2 * np.pi / LAYER.wavelength_m
        squares += (w[1:] - w[0]).reshape(squares.shape) ** 2 / seeds
    # Eight directions of one screen are hardly independent: sd by the seeds alone, sqrt(2/400) = 7 %.
    np.testing.assert_allclose(squares.mean(axis=1) / structure_function(LAYER, separations), 1, atol=0.15)


def test_the_wind_carries_the_wavefront():
    flow = FrozenFlow(LAYER, np.random.default_rng(1), shortest_m=0.05)
    points = np.random.default_rng(2).uniform(-1, 1, (20, 2))
    later = wavefront(flow, points + 0.3 * np.array(LAYER.wind_m_s), 0.3)
    np.testing.assert_allclose(later, wavefront(flow, points), atol=1e-15)


def test_slopes_are_the_wavefronts_own_in_time():
    flow = FrozenFlow(LAYER, np.random.default_rng(3), shortest_m=0.05)
    times = np.array([0.0, 0.01, 0.5])
    slopes = (flow.slope_waves(LENSLETS) @ flow.blown(times)).real
    assert slopes.shape == (16, 2, 3)
    nodes, weights = np.polynomial.legendre.leggauss(24)
    along = nodes * LENSLETS.pitch_m / 2
    for spot, when in ((0, 0), (6, 1), (15, 2)):
        for axis in (0, 1):
            sides = []
            for end in (LENSLETS.pitch_m / 2, -LENSLETS.pitch_m / 2):
                side = np.stack([np.full(24, end), along], axis=1)
                points = LENSLETS.centres_m[spot] + (side if axis == 0 else side[:, ::-1])
                sides.append(wavefront(flow, points, times[when]))
            expected = weights @ (sides[0] - sides[1]) / 2 / LENSLETS.pitch_m
            assert slopes[spot, axis, when] == pytest.approx(expected, rel=1e-6)


def test_the_same_seed_gives_the_same_flow_and_another_another():
    first, again, other = (FrozenFlow(LAYER, np.random.default_rng(s), 0.05).amplitudes for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
