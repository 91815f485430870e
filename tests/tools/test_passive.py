"""The passive output: its transfer against the plant step by step, its claim against energies."""

import sys
from pathlib import Path

import numpy as np
import pytest

from aolink.estimation.frames.frame_data import Measurement
from aolink.estimation.model.exposure_model import exposure_model
from aolink.rig import load_rig

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from paper_report.passive import passive_output

RIG = load_rig("section-vi")
N = 200
MODEL = exposure_model(RIG.plant, N)
# A spot that passes through, and one that rests off centre.
POINTS = [(np.zeros((N, 1)), np.array([0.2, 3.0])), (np.full((N, 1), 0.00985), np.array([0.5, 0.0]))]


def small_signal(inputs, state, held, scale=1e-6):
    """Moments less those of the operating point, over their scale, for inputs held over exposures, by recursion.

    Each exposure starts from the operating point, moved by the lifted deviation of the state.
    """
    plant, deviation, out = RIG.plant, np.zeros(2), []
    for u in held:
        paths = []
        for d, v in ((0 * deviation, 0.0), (scale * deviation, scale * u)):
            x, path = state + d, []
            for k in range(N):
                path.append(x[0])
                x = plant.A @ x + plant.B[:, 0] * (inputs[k, 0] + v)
            paths.append((np.array(path), x))
        (rest, rest_end), (moved, moved_end) = paths
        out.append([np.mean(moved - rest), np.mean(moved**2 - rest**2)])
        deviation = (moved_end - rest_end) / scale
    return np.array(out) / scale


@pytest.mark.parametrize(("inputs", "state"), POINTS)
def test_energy_that_goes_in_comes_out_to_within_the_index(inputs, state):
    """Passivity: the sum of u y_P is at least the index times the sum of u^2, from rest."""
    output = passive_output(MODEL, inputs, state)
    rng = np.random.default_rng(1)
    for held in (rng.standard_normal(60), np.cos(np.pi * np.arange(60)), np.sin(0.8 * np.arange(60))):
        u = np.append(held, np.zeros(60))
        y = small_signal(inputs, state, u) @ output.weights
        assert u @ y >= (output.index - 1e-3) * (u @ u)


@pytest.mark.parametrize(("inputs", "state"), POINTS)
def test_a_constant_input_moves_it_by_itself(inputs, state):
    output = passive_output(MODEL, inputs, state)
    y = small_signal(inputs, state, np.ones(80)) @ output.weights
    assert y[-1] == pytest.approx(1, abs=1e-3)


def test_no_other_combination_of_unit_gain_is_more_passive():
    inputs, state = POINTS[0]
    output = passive_output(MODEL, inputs, state)
    step = small_signal(inputs, state, np.append(1.0, np.zeros(400)))  # impulse response, an exposure a step
    z = np.exp(-1j * np.outer(np.linspace(0, np.pi, 200), np.arange(401)))
    gain = (z @ step).real
    constant = gain[0] / (gain[0] @ gain[0])
    across = np.array([-constant[1], constant[0]])
    best = max((gain @ (constant + t * across)).min() for t in np.linspace(-10, 10, 4001))
    assert output.index == pytest.approx(best, abs=2e-3)
    centroid_alone = (gain[:, 0] / gain[0, 0]).min()
    assert output.index > centroid_alone + 1e-3


def test_a_resting_spot_gives_little_to_combine():
    at_rest = passive_output(MODEL, *POINTS[1])
    passing = passive_output(MODEL, *POINTS[0])
    assert passing.index > at_rest.index


def test_the_outputs_value_and_noise_are_those_of_its_weights():
    output = passive_output(MODEL, *POINTS[0])
    R = np.array([[0.02, 0.001], [0.001, 0.01]])
    y = output.expected + np.array([[0.1, 0.2], [0.0, 0.0]])
    value, sd = output.value(Measurement(value=y, covariance=np.tile(R, (2, 1, 1))))
    np.testing.assert_allclose(value, [output.weights @ np.array([0.1, 0.2]), 0.0], atol=1e-12)
    np.testing.assert_allclose(sd, np.sqrt(output.weights @ R @ output.weights))
