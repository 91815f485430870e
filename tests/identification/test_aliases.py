"""Aliases of a vibration's frequency, distinguished by all pixels."""

import numpy as np
import pytest

import aolink
from aolink.errors import EstimatorError
from aolink.identification import Maximum, Process, ProcessSum, by_pixels, identified_text
from aolink.rig import load_rig, parse_rig


def shaken(cycles):
    """A rig with a drift, and a vibration of so many cycles in an exposure."""
    rig = load_rig("loop")
    line = Process("resonance", (cycles / (rig.timing.exposure_steps * rig.timing.fast_step_s), 0.002, 0.08))
    drift = Process("ornstein-uhlenbeck", (0.5, 2 * 0.08**2 / 0.5))
    return parse_rig(identified_text(rig.toml, rig, [ProcessSum((drift, line))]))


def maximum(cycles, log_likelihood):
    return Maximum(np.array([cycles]), log_likelihood, 12)


@pytest.mark.long
@pytest.mark.parametrize("cycles", [1.51, 2.4])
def test_the_pixels_decide_whatever_the_likelihood_of_centroid_and_width_says(cycles):
    """Of the two aliases one is a cycle below, and one as far from a whole or half number of cycles, on the other
    side."""
    exposures = list(aolink.simulate(shaken(cycles), 48, seed=3))
    whole = round(2 * cycles)
    found = [maximum(whole - cycles, 0.0), maximum(cycles - 1, -1.0), maximum(cycles, -9.0)]
    left = by_pixels(found, lambda each: shaken(each.x[0]), exposures)
    assert left[0].x[0] == cycles
    assert maximum(cycles - 1, -1.0).x[0] not in [each.x[0] for each in left]


def test_without_evidence_the_order_stays():
    def refused(each):
        raise EstimatorError("profile follows the posterior's modes for at most 24 states")

    found = [maximum(2.6, 0.0), maximum(2.4, -1.0)]
    assert by_pixels(found, lambda each: shaken(each.x[0]), []) == found
    assert by_pixels(found, refused, []) == found
    assert by_pixels(found[:1], refused, []) == found[:1]
