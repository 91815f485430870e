"""AOT telemetry, read back with aotpy; what it has no name for, with astropy."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import aolink
from aolink.exporting.files import export
from aolink.optics.sensor import SpotSensor
from aolink.rig import parse_rig
from aolink.series import Series
from tests.needs import needed
from tests.recording.small import write_small

aotpy = needed("aotpy")
fits = needed("astropy.io.fits")


def read_system(path: Path) -> Any:
    with warnings.catch_warnings():
        # It warns of each table that is not of its own format, and of nothing else.
        warnings.filterwarnings("ignore", r".*HDU '\S+' is not an AOT binary table nor an image")
        return aotpy.AOSystem.read_from_file(path)


@pytest.fixture(scope="module")
def written(series: Series, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("aot") / "out.fits"
    export(series, path)
    return path


def test_frames_and_when_they_were_made(series: Series, written: Path) -> None:
    system = read_system(written)
    (sensor,) = system.wavefront_sensors
    frames = sensor.detector.pixel_intensities
    assert frames.data.dtype == np.uint16
    np.testing.assert_array_equal(frames.data, [e.pixels for e in series])
    assert frames.time.frame_numbers == [e.frame_id for e in series]
    np.testing.assert_allclose(frames.time.timestamps, [e.host_start_ns / 1e9 for e in series], rtol=0, atol=1e-6)
    timing = series.rig.timing
    assert sensor.detector.integration_time == pytest.approx(timing.exposure_steps * timing.fast_step_s)
    assert sensor.detector.frame_rate == pytest.approx(1 / (timing.frame_period_steps * timing.fast_step_s))
    assert system.name == series.rig.name


def test_measurements_are_the_spots_centres(series: Series, written: Path) -> None:
    """By another sum: over the columns' and the rows' positions of every window."""
    system, sensor = read_system(written), series.rig.sensor
    (wfs,) = system.wavefront_sensors
    spots = sensor.spots if isinstance(sensor, SpotSensor) else 1
    assert wfs.measurements.data.shape == (len(series), 2, spots)
    assert wfs.n_valid_subapertures == spots
    assert sorted(wfs.subaperture_mask.data[wfs.subaperture_mask.data >= 0]) == list(range(spots))
    places = sensor.field[0] + (np.arange(sensor.profile.pixels) + 0.5) * sensor.pixel_width
    for found, exposure in zip(wfs.measurements.data, series, strict=True):
        light = exposure.pixels.astype(float) - sensor.black_level
        if isinstance(sensor, SpotSensor) and spots == 1:
            np.testing.assert_allclose(found[1, 0], (light * places[:, None]).sum() / light.sum(), rtol=1e-9)
        elif not isinstance(sensor, SpotSensor):
            assert np.isnan(found[1]).all()
        if spots == 1:
            np.testing.assert_allclose(found[0, 0], (light * places).sum() / light.sum(), rtol=1e-9)


def test_commands_are_the_inputs_of_every_fast_step(series: Series, written: Path) -> None:
    (loop,) = read_system(written).loops
    np.testing.assert_array_equal(loop.commands.data, np.concatenate([e.inputs for e in series]))
    steps = np.concatenate([np.arange(e.first_step, e.first_step + e.n_steps) for e in series])
    assert loop.time.frame_numbers == steps.tolist()
    assert loop.framerate == pytest.approx(1 / series.rig.timing.fast_step_s)
    assert loop.commanded_corrector.n_valid_actuators == series.rig.n_inputs
    # Each exposure's start is an estimate of its own by the clock regression, with a sigma of some 50 us here.
    between = np.diff(loop.time.timestamps)
    assert (between > 0).all()
    np.testing.assert_allclose(between, series.rig.timing.fast_step_s, rtol=0, atol=2e-4)


def test_the_picture_sensor_is_a_scoring_camera(series: Series, written: Path) -> None:
    cameras = read_system(written).scoring_cameras
    assert len(cameras) == (series.rig.scene is not None)
    for camera in cameras:
        scenes = [e.scene.pixels for e in series if e.scene]
        np.testing.assert_array_equal(camera.detector.pixel_intensities.data, scenes)


def test_estimates_truth_and_rig_are_tables(series: Series, written: Path) -> None:
    with fits.open(written) as hdus:
        for name in series.estimators:
            table, estimates = hdus[f"ESTIMATE_{name}"].data, series.estimates(name)
            shape = (len(series), *estimates[0].path.shape)
            np.testing.assert_array_equal(table["path"].reshape(shape), [e.path for e in estimates])
            np.testing.assert_array_equal(
                table["end_state"].reshape(len(series), *estimates[0].end_state.shape), [e.end_state for e in estimates]
            )
            assert table["status"].tolist() == [e.status.name for e in estimates]
            assert table["frame_id"].tolist() == [e.frame_id for e in estimates]
        truth = np.array([e.truth.path for e in series if e.truth])
        np.testing.assert_array_equal(hdus["TRUTH"].data["truth_path"].reshape(truth.shape), truth)
        rig = bytes(hdus["RIG"].data["toml_utf8"][0]).decode()
        assert parse_rig(rig).digest == series.rig.digest
        facts = dict(zip(hdus["FACTS"].data["key"], hdus["FACTS"].data["value"], strict=True))
        assert facts["rig_digest"] == series.rig.digest
        assert hdus["EXPOSURES"].data["host_receive_ns"].tolist() == [e.host_receive_ns for e in series]


def test_commands_between_exposures_and_windows_without_light(tmp_path: Path) -> None:
    recording = aolink.read(write_small(tmp_path / "small.mcap", 5, "nothing", missing=True))[::2]
    export(recording, tmp_path / "out.fits")
    system = read_system(tmp_path / "out.fits")
    assert np.isnan(system.wavefront_sensors[0].measurements.data).all()
    exposures = list(recording)
    steps = [np.arange(e.first_step - len(e.lead_inputs), e.first_step + e.n_steps) for e in exposures]
    assert system.loops[0].time.frame_numbers == np.concatenate(steps).tolist()
    rows = [np.concatenate([e.lead_inputs, e.inputs]) for e in exposures]
    np.testing.assert_array_equal(system.loops[0].commands.data, np.concatenate(rows))
