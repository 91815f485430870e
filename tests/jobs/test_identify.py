"""The job of `aolink identify`, from exposures to a model and its sets."""

from pathlib import Path

import pytest

import aolink
from aolink.errors import IdentificationError
from aolink.identification import readings
from aolink.jobs.identify import Wanted, from_readings, identify
from aolink.recording.reader import Recording


@pytest.mark.slow
def test_a_vibration_is_found_with_its_amplitude():
    exposures = aolink.simulate("jitter", 48, seed=2)
    wanted = Wanted(models=("resonance",))
    (found,) = from_readings(exposures.rig, [readings(exposures.rig, list(exposures))], wanted).found
    frequency, damping, sd = found.parameters
    assert frequency.holds(12.0)
    assert damping.holds(0.005)
    assert sd.holds(0.2)


def test_a_plant_that_cannot_be_identified_is_refused_before_any_work():
    recording = Recording(Path(__file__).parents[2] / "recordings" / "tip-tilt.mcap")
    with pytest.raises(IdentificationError, match="this rig's has 2 inputs and 2 outputs"):
        identify([recording], None, Wanted(models=(), plant="second-order"), lambda what, done, of: pytest.fail(what))
