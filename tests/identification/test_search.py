"""The search for the highest maximum of the likelihood."""

import sys
from pathlib import Path

import numpy as np
import pytest

import aolink
from aolink.identification import maxima, readings, space_of
from aolink.identification.likelihood import Likelihood
from aolink.identification.search import climb
from aolink.jobs.closed_loop import closed_loop
from aolink.rig import load_rig, parse_rig
from tests.needs import needed

needed("pyrtc")
sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from bench_rows.loop import Cell  # noqa: E402 # where that is installed


@pytest.mark.rare
def test_a_sharp_vibration_beside_a_drift_is_found():
    """The vibration is at 14.4 Hz, where the rig file has 12."""
    rig = load_rig("loop")
    faster = parse_rig(rig.toml.replace("frequency_hz = 12.0", "frequency_hz = 14.4"))
    seen = [readings(rig, list(aolink.simulate(faster, 96, seed=30_001)))]
    kinds = ("ornstein-uhlenbeck", "resonance")
    space = space_of(kinds, seen)
    found = maxima(space, seen)
    highest = dict(zip(space.names, np.exp(found[0].x), strict=True))
    assert highest["resonance.frequency_hz"] == pytest.approx(14.4, rel=0.01)
    assert found == sorted(found, key=lambda each: -each.log_likelihood)


@pytest.mark.rare
@pytest.mark.parametrize(
    ("cycles", "seed"), [(2.4, 703), (2.7, 705)], ids=["between the points of the grid", "an alias of the second best"]
)
def test_a_sharp_vibration_in_turbulence_is_among_the_maxima(cycles, seed, tmp_path):
    """In the first recording the grid and its aliases alone lead to 0.856, 26 nats below; in the second the
    vibration is an alias of the highest maximum that is no alias of the highest of all."""
    cell, past = Cell(True, cycles), 200
    run = cell.disturbance((past + 101) * cell.steps, past * cell.steps, seed)
    np.save(tmp_path / "path.npy", run.slopes[: past * cell.steps, None])
    table = '[disturbance]\nplant_noise = false\nrecorded = "path.npy"\n\n[simulation]'
    (tmp_path / "rig.toml").write_text(cell.rig(run.model).toml.replace("[simulation]", table, 1))
    rig = load_rig(tmp_path / "rig.toml")
    seen = [readings(rig, [each.exposure for each in closed_loop(rig, "", "", past, seed=10_000 + seed)])]
    kinds = ("ornstein-uhlenbeck", "resonance")
    space = space_of(kinds, seen)
    lines = [np.exp(each.x[space.names.index("resonance.frequency_hz")]) * 0.05 for each in maxima(space, seen)]
    assert min(abs(each - cycles) for each in lines) < 0.03


def test_a_climb_with_fixed_parameters_moves_the_others_to_their_maximum():
    exposures = aolink.simulate("jitter", 32, seed=2)
    seen = [readings(exposures.rig, list(exposures))]
    space = space_of(("resonance",), seen)
    of = [Likelihood(each, 16) for each in seen]
    start = np.log([8.0, 0.01, 0.05])
    free, top = climb(space, start, of), climb(space, start, of, fixed=(0, 1))
    np.testing.assert_array_equal(top.x[:2], start[:2])
    assert top.log_likelihood == pytest.approx(space.log_likelihood(top.x, of, top.nodes))
    assert top.log_likelihood < free.log_likelihood
    for sd in (0.95, 1.05):  # the only one that is free
        assert space.log_likelihood(np.add(top.x, [0, 0, np.log(sd)]), of, top.nodes) < top.log_likelihood
