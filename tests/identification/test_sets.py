"""Sets of a recording that shows an alias; the choice of a model; what a recording without input says."""

import numpy as np
import pytest

import aolink
from aolink.errors import IdentificationError
from aolink.identification import (
    IdentifiedPlant,
    chosen,
    identified,
    maxima,
    readings,
    space_of,
    tried,
)
from aolink.recording.reader import Recording
from aolink.session import record
from aolink.session.excitation import excitation
from tests.commands import simulated_rig
from tests.kinds import must_be


@pytest.fixture(scope="module")
def seen():
    exposures = aolink.simulate("jitter", 48, seed=2)
    return [readings(exposures.rig, list(exposures))]


@pytest.mark.rare
def test_the_sets_hold_the_truth_and_the_aliases_that_remain(seen):
    """The spot swings at 12 Hz; to centroids at 5 Hz, 2, 3, 7, 8 and 13 Hz look the same."""
    of = space_of(["resonance"], seen)
    sets = dict(zip(of.names, identified(of, maxima(of, seen), seen), strict=True))
    assert sets["frequency_hz"].holds(12.0)
    assert not any(sets["frequency_hz"].holds(alias) for alias in (2.0, 3.0, 7.0, 8.0))
    assert sets["damping"].holds(0.005)
    assert sets["sd"].holds(0.2)


@pytest.mark.rare
def test_a_resonance_is_chosen_where_there_is_one(seen):
    names = ("random-walk", "ornstein-uhlenbeck", "resonance")
    assert chosen([tried(name, lambda kinds: space_of(kinds, seen), seen) for name in names]).name == "resonance"


def test_without_input_there_is_no_plant_to_identify(seen):
    with pytest.raises(IdentificationError, match="no input to identify a plant from"):
        space_of([], seen, plant="second-order")


SLOW = """
name = "slow"
[plant]
A = [[0.995]]
B = [[0.004]]
B_w = [[1.0]]
C = [[1.0]]
process_noise = 1e-6
[timing]
fast_step_s = 0.001
exposure_steps = 100
[sensor]
kind = "line"
pixels = 32
field = [-1.0, 1.0]
noise_density = 1e-4
black_level = 5000
counts_per_density = 2000
kernel = { shape = "gaussian", sigma = 0.08 }
[mirror]
input_min = -1.0
input_max = 1.0
[drive]
kind = "sine"
amplitude = 0.5
period_s = 1.5
"""


@pytest.mark.slow
def test_a_plant_that_is_driven_is_identified():
    rig = aolink.rig.parse_rig(SLOW)
    seen = [readings(rig, list(aolink.simulate(rig, 48, seed=2)), plant_known=False)]
    of = space_of([], seen, plant="first-order")
    best = must_be(IdentifiedPlant, of.fitted_plant(maxima(of, seen)[0].x))
    assert best["gain"] == pytest.approx(0.8, rel=0.05)
    assert best["correlation_s"] == pytest.approx(-1e-3 / np.log(0.995), rel=0.05)
    assert best["sd"] == pytest.approx(np.sqrt(1e-6 / (1 - 0.995**2)), rel=0.5)


@pytest.mark.slow
def test_a_plant_is_identified_from_a_session_that_plays_a_pseudo_random_sequence(tmp_path):
    (tmp_path / "slow.toml").write_text(SLOW)
    rig, path = aolink.load_rig(tmp_path / "slow.toml"), tmp_path / "a.mcap"
    with simulated_rig(tmp_path / "slow.toml") as ports:
        record(rig, *ports, path, exposures=48, inputs=excitation(["prbs:amplitude=0.5,to=2,seed=3"], rig))
    seen = [readings(rig, list(Recording(path).exposures()), plant_known=False)]
    of = space_of([], seen, plant="first-order")
    best = must_be(IdentifiedPlant, of.fitted_plant(maxima(of, seen)[0].x))
    assert best["gain"] == pytest.approx(0.8, rel=0.05)
    assert best["correlation_s"] == pytest.approx(-1e-3 / np.log(0.995), rel=0.05)
