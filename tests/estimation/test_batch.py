"""Batches of exposures: inputs that are not numbers are noticed, whatever the plant and its form."""

import dataclasses

import numpy as np
import pytest

import aolink
from aolink.estimation.batch import Batch
from aolink.simulation.model import simulate


@pytest.mark.parametrize(
    ("name", "value", "step"),
    [
        ("section-vi", np.nan, 0),
        ("loop", np.inf, 7),
        ("tip-tilt", -np.inf, -1),
        ("sh-4x4", np.nan, 7),
        ("membrane", np.inf, -1),
    ],
)
def test_an_input_that_is_not_a_number_is_noticed_at_any_step_of_any_plant(name, value, step, small_membrane):
    rig = small_membrane if name == "membrane" else aolink.load_rig(name)
    first, second = simulate(rig, 2, seed=1)
    for k in (0, rig.n_inputs - 1):
        inputs = second.inputs.copy()
        inputs[step, k] = value
        broken = dataclasses.replace(second, inputs=inputs)
        batch = Batch(rig, [first, broken])
        assert batch.finite == [True, False]
        inputs = inputs.copy()
        inputs[step, k] = 0.0
        zero = Batch(rig, [first, dataclasses.replace(second, inputs=inputs)])
        np.testing.assert_array_equal(batch.response_to(1).end, zero.response_to(1).end)


def test_inputs_near_the_largest_numbers_are_numbers():
    (exposure,) = aolink.simulate("section-vi", 1, seed=1)
    large = dataclasses.replace(exposure, inputs=np.full_like(exposure.inputs, 1e308))
    assert Batch(aolink.load_rig("section-vi"), [large]).finite == [True]
