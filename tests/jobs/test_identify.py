"""The job of `aolink identify`, from exposures to a model and its sets."""

from pathlib import Path

import numpy as np
import pytest

import aolink
from aolink.errors import IdentificationError
from aolink.identification import Process, ProcessSum, identified_text, readings
from aolink.jobs.identify import Wanted, from_readings, identify
from aolink.recording.reader import Recording
from aolink.rig import load_rig, parse_rig

RIG = load_rig("loop")
DRIFT_SD, HZ = 0.16, 48.0  # 2.4 cycles an exposure


@pytest.mark.rare
def test_the_set_of_a_vibration_beside_a_drift_is_without_the_frequencies_that_the_pixels_rule_out():
    """The drift moves the centroid so much more that centroid and width alone rule out few frequencies."""
    drift = Process("ornstein-uhlenbeck", (0.5, 2 * DRIFT_SD**2 / 0.5))
    vibration = Process("resonance", (HZ, 0.002, 0.08))
    rig = parse_rig(identified_text(RIG.toml, RIG, [ProcessSum((drift, vibration))]))
    exposures = list(aolink.simulate(rig, 32, seed=3))
    wanted = Wanted(models=("ornstein-uhlenbeck+resonance",), highest_hz=60.0)
    (found,) = from_readings(RIG, [readings(RIG, exposures)], exposures, wanted).found
    frequency = next(each for each in found.parameters if each.name.endswith("frequency_hz"))
    assert frequency.best == pytest.approx(HZ, rel=0.01)
    assert frequency.holds(HZ)
    assert not any(frequency.holds(hz) for hz in np.arange(6.0, 18.0))


@pytest.mark.rare
def test_the_pixels_do_not_rule_out_a_vibration_whose_amplitude_goes_with_its_damping():
    """The maximum at the truth, 12 Hz, never changes; a vibration there that does has another amplitude."""
    exposures = aolink.simulate("jitter", 48, seed=2)
    wanted = Wanted(models=("resonance",))
    (found,) = from_readings(exposures.rig, [readings(exposures.rig, list(exposures))], list(exposures), wanted).found
    frequency, damping, sd = found.parameters
    assert frequency.best == pytest.approx(12.0, abs=0.1)
    assert damping.holds(0.005)
    assert sd.best == pytest.approx(0.2, rel=0.25)


def test_a_plant_that_cannot_be_identified_is_refused_before_any_work():
    recording = Recording(Path(__file__).parents[2] / "recordings" / "tip-tilt.mcap")
    with pytest.raises(IdentificationError, match="this rig's has 2 inputs and 2 outputs"):
        identify([recording], None, Wanted(models=(), plant="second-order"), lambda what, done, of: pytest.fail(what))
