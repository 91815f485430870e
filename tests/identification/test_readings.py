"""The readings of simulated frames against the paths that made them."""

from dataclasses import replace

import numpy as np
import pytest

import aolink
from aolink.errors import IdentificationError
from aolink.identification import readings
from tests.kinds import truth_of


@pytest.mark.parametrize("name", ["jitter", "section-vi-lively", "tip-tilt"])
def test_readings_are_right_to_their_noise(name):
    exposures = aolink.simulate(name, 60, seed=3)
    seen = readings(exposures.rig, list(exposures))
    path = np.array([truth_of(each).path for each in exposures]).swapaxes(0, 1) - seen.centre[:, :, None]
    for value, true, noise in (
        (seen.mean, path.mean(axis=2), seen.mean_noise),
        (seen.square, (path**2).mean(axis=2), seen.square_noise),
    ):
        z = (value - true) / np.sqrt(noise)
        assert abs(z.mean()) < 4 / np.sqrt(z.size)
        assert z.std() == pytest.approx(1, abs=4 / np.sqrt(2 * z.size))


def test_the_response_is_that_of_the_plant_over_all_exposures():
    exposures = aolink.simulate("section-vi-lively", 30, seed=3)
    quiet = aolink.rig.parse_rig(exposures.rig.toml.replace("process_noise = 10 ", "process_noise = 1e-12 "))
    still = aolink.simulate(quiet, 30, seed=3)
    seen = readings(exposures.rig, list(exposures))
    expected = np.array([truth_of(each).path for each in still]).swapaxes(0, 1)
    np.testing.assert_allclose(seen.response[:, :, :-1], expected, atol=1e-4)


def test_a_lost_frame_is_an_empty_slot():
    exposures = list(aolink.simulate("jitter", 40, seed=3))
    lost = exposures.pop(20)
    after = replace(exposures[20], lead_inputs=lost.inputs)
    seen = readings(aolink.rig.load_rig("jitter"), [*exposures[:20], after, *exposures[21:]])
    assert seen.slots == 40
    assert np.flatnonzero(~seen.usable[0]).tolist() == [20]


def test_too_short_a_recording_is_refused():
    exposures = aolink.simulate("jitter", 10, seed=3)
    with pytest.raises(IdentificationError, match="10 exposures are too short a recording"):
        readings(exposures.rig, list(exposures))


def test_dark_frames_are_refused():
    rig = aolink.rig.load_rig("jitter")
    dark = [
        replace(each, pixels=np.full_like(each.pixels, int(rig.sensor.black_level)))
        for each in aolink.simulate(rig, 30, seed=3)
    ]
    with pytest.raises(IdentificationError, match="0 exposures show a spot"):
        readings(rig, dark)
