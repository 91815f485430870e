"""The readings of simulated frames against the paths that made them."""

from dataclasses import replace

import numpy as np
import pytest

import aolink
from aolink.errors import IdentificationError
from aolink.identification import Process, ProcessSum, readings
from aolink.identification.likelihood import Likelihood
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


@pytest.mark.parametrize("light", [0.8, 1.25])
def test_light_that_is_not_one_changes_no_reading(light):
    exposures = aolink.simulate("jitter", 40, seed=3)
    rig, black = exposures.rig, float(exposures.rig.sensor.black_level)
    pixels = [np.rint(black + light * (each.pixels - black)).astype(np.uint16) for each in exposures]
    brighter = [replace(each, pixels=some) for each, some in zip(exposures, pixels, strict=True)]

    def response(seen):
        path = np.array([truth_of(each).path for each in exposures]).swapaxes(0, 1) - seen.centre[:, :, None]
        true = (path**2).mean(axis=2)
        return float((seen.square * true).sum() / (true**2).sum())

    assert response(readings(rig, brighter)) == pytest.approx(response(readings(rig, list(exposures))), abs=0.03)


def test_an_exposure_of_one_step_is_an_integral():
    """A random walk's mean over its own frame period changes by two thirds of its intensity, so that a likelihood that
    took an exposure of one fast step for an instant would be highest at 0.67."""
    text = aolink.rig.load_rig("jitter").toml.replace("exposure_steps = 200", "exposure_steps = 1")
    rig = aolink.rig.parse_rig(text.replace("block_steps = 50", "block_steps = 1"))
    seen = readings(rig, list(aolink.simulate(rig, 40, seed=3)))
    assert seen.n_steps * seen.step_s == pytest.approx(rig.timing.fast_step_s)
    random, shape = np.random.default_rng(0), (60, 40)
    walk = np.cumsum(random.normal(size=(60, 40 * 64)) / 8, axis=1).reshape(*shape, 64).mean(axis=2)
    walks = replace(
        seen, mean=walk, square=walk**2, mean_noise=np.full(shape, 1e-4), square_noise=np.full(shape, 1e6),
        centre=np.zeros(shape), usable=np.ones(shape, dtype=bool), reach=10.0,
        response=np.zeros((*shape, seen.n_steps + 1)),
    )  # fmt: skip
    likelihood = Likelihood(walks, 16)
    tried = np.array([0.55, 0.67, 0.8, 1.0, 1.2])
    models = [ProcessSum((Process("random-walk", (each / rig.timing.fast_step_s,)),)) for each in tried]
    assert tried[np.argmax([likelihood(model) for model in models])] == 1.0
