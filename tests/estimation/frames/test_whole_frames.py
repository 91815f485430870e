"""Frames without a flaw are measured together by compiled code: as each is measured alone, in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aolink.estimation.compiled.frames import brightest_stretches, window_sums
from aolink.estimation.frames.frame_data import Measurement, Needs
from aolink.estimation.frames.measure import Measurements, measure
from aolink.estimation.frames.moments import significance_scale, spot_significance
from aolink.estimation.frames.spots import profiles
from aolink.optics.sensor import SpotSensor
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.kinds import must_be


@pytest.mark.parametrize("photoelectrons", [0.0, 2000.0])
def test_as_each_frame_alone(photoelectrons: float) -> None:
    rig = load_rig("sh-4x4")
    assert isinstance(rig.sensor, SpotSensor)
    rig = replace(rig, sensor=replace(rig.sensor, photoelectrons=photoelectrons))
    exposures = simulate(rig, 6)
    exposures[1].pixels[40, 50] = 0
    exposures[2].pixels[3, 4] = rig.sensor.full_scale
    exposures[4].pixels[24:48, 24:48] = round(rig.sensor.black_level)  # a spot without light
    needs = Needs(what="moments", orders=(1, 2))
    together = Measurements(rig, exposures, needs)
    alone = [measure(rig, each, needs) for each in exposures]
    assert [row >= 0 for row in together.rows] == [not remark for _, remark in alone]
    assert [row >= 0 for row in together.rows[:3]] == [True, False, False]
    assert together.rows[4] < 0
    for k, (expected, remark) in enumerate(alone):
        if not remark:
            ours, theirs = must_be(Measurement, together[k][0]), must_be(Measurement, expected)
            np.testing.assert_array_equal(ours.value, theirs.value)
            np.testing.assert_array_equal(ours.covariance, theirs.covariance)


@pytest.mark.parametrize(("frames", "rows", "columns", "side"), [(1, 1, 1, 4), (3, 2, 5, 7), (2, 3, 1, 256)])
def test_sums_are_those_of_the_windows(frames: int, rows: int, columns: int, side: int) -> None:
    rng = np.random.default_rng(side)
    pixels = rng.integers(1, 65_536, (frames, rows * side, columns * side)).astype(np.uint16)
    pixels[0, :side, :side] = 65_535
    sensor = must_be(SpotSensor, load_rig("sh-4x4").sensor)
    sensor = replace(sensor, grid=(rows, columns), window=(side, side))
    sums, ends = np.empty((side, frames, rows, columns, 2)), np.empty((frames, 2), dtype=np.int64)
    window_sums(pixels, side, sums, ends)
    for k, frame in enumerate(pixels):
        alone = profiles(sensor, frame, np.ones(frame.shape, dtype=bool)).counts
        np.testing.assert_array_equal(sums[:, k].reshape(side, -1).T, alone)
        assert ends[k].tolist() == [frame.min(), frame.max()]


@pytest.mark.parametrize(("pixels", "count"), [(1, 3), (7, 64), (16, 130)])
def test_the_brightest_stretch_is_that_of_numpy(pixels: int, count: int) -> None:
    density = np.random.default_rng(pixels).standard_normal((pixels, count))
    line = replace(must_be(SpotSensor, load_rig("sh-4x4").sensor).profile, pixels=pixels)
    found = np.empty(count)
    brightest_stretches(density, found)
    np.testing.assert_allclose(found * significance_scale(line), spot_significance(line, density.T), rtol=1e-14)
