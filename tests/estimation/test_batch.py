"""Batches of exposures: inputs that are not numbers are noticed, whatever the plant and its form."""

import dataclasses

import numpy as np
import pytest

import aolink
from aolink.estimation.batch import Batch


@pytest.mark.parametrize("step", [0, 7, -1])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["section-vi", "loop", "tip-tilt", "sh-4x4", "membrane-12x12"])
def test_an_input_that_is_not_a_number_is_noticed_at_any_step_of_any_plant(name, value, step):
    first, second = aolink.simulate(name, 2, seed=1)
    rig = aolink.load_rig(name)
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
