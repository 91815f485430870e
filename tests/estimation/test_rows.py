"""Estimates where a camera exposes its rows one after the other: the row time known, said to be unknown, ignored."""

from dataclasses import replace

import numpy as np
import pytest

from aolink.errors import RigError
from aolink.estimation import run
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.rig import Rig, parse_rig
from aolink.rig.rows import possible_skew_ns
from aolink.simulation.model import simulate
from tests.kinds import truth_of
from tests.simulation.rolling import COUPLED, rolling

EXPOSURES, FIRST = 16, 4


def calm(rig: Rig) -> Rig:
    """The rig with a hundredth of its process noise: the mirror moves the spots more than they do themselves."""
    return replace(rig, plant=replace(rig.plant, process_noise=0.01 * rig.plant.process_noise))


def coverage(rig: Rig, exposures: list[Exposure]) -> float:
    """Share of the true path's points within 95 % of the estimates of moments."""
    pairs = list(zip(exposures, run(rig, exposures, ["moments"])["moments"], strict=True))[FIRST:]
    return float(np.mean([np.abs(e.path - truth_of(x).path) < 1.96 * e.path_sd for x, e in pairs]))


def at_once(rig: Rig, exposures: list[Exposure], inputs: FloatArray, sigma: FloatArray | None) -> list[Exposure]:
    """The exposures with the inputs of all axes at once, as where the row time is not known."""
    n = rig.timing.exposure_steps
    cut = [inputs[each.first_step : each.first_step + n] for each in exposures]
    none = np.zeros((0, rig.n_inputs))
    return [
        replace(each, inputs=own, lead_inputs=none, row_sigma_ns=sigma)
        for each, own in zip(exposures, cut, strict=True)
    ]


def test_intervals_hold_the_truth_where_the_row_time_is_known_and_mostly_where_it_is_not() -> None:
    rig, plain = (calm(rolling("sh-4x4", row_time)) for row_time in (1.6e-3, 0.0))
    # Frames follow each other without a gap: the windows of neighbours overlap.
    rng = np.random.default_rng(9)
    inputs = np.repeat(rng.uniform(-0.015, 0.015, (200, rig.n_inputs)), 40, axis=0)
    exposures = simulate(rig, EXPOSURES, 11, inputs=inputs)
    known = coverage(rig, exposures)
    unknown = coverage(plain, at_once(rig, exposures, inputs, possible_skew_ns(rig)))
    ignored = coverage(plain, at_once(rig, exposures, inputs, None))
    assert 0.93 < known < 0.97
    assert unknown > 0.85
    assert ignored < 0.8


@pytest.mark.slow
def test_one_plant_of_several_spots_is_estimated_in_their_own_intervals() -> None:
    rig = parse_rig(COUPLED)
    assert 0.9 < np.mean([coverage(rig, simulate(rig, 40, seed)) for seed in (1, 2, 3)]) < 0.98


def test_windows_of_one_plant_that_reach_into_the_next_frames_are_refused() -> None:
    with pytest.raises(RigError, match=r"needs timing\.frame_period_steps of at least 140$"):
        parse_rig(COUPLED.replace("frame_period_steps = 150", "frame_period_steps = 139"))
