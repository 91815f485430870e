"""The row time of a camera from a film of blinking light."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aolink.calibration.row_time import IN_STEP, row_time
from aolink.errors import CalibrationError
from aolink.numerics.arrays import FloatArray

PERIOD_S, ROWS = 1 / 30, 120


def blinking(
    row_time_s: float,
    blink_hz: float,
    seed: int,
    *,
    exposure_s: float = 2e-3,
    frames: int = 30,
    noise: float = 0.02,
    duty: float = 0.4,
) -> FloatArray:
    """Rows of a film of a light that is switched on for a part of each blink, integrated over each row's exposure."""
    rng = np.random.default_rng(seed)
    start = rng.uniform() / blink_hz + PERIOD_S * np.arange(frames)[:, None] + row_time_s * np.arange(ROWS)

    def lit(t: FloatArray) -> FloatArray:  # light since time zero
        blinks = np.floor(t * blink_hz)
        return (blinks * duty + np.minimum(t * blink_hz - blinks, duty)) / blink_hz

    light = (lit(start + exposure_s + 1) - lit(start + 1)) / exposure_s
    light = light * (1 + 0.3 * np.sin(np.arange(ROWS) / 30)) * 1000
    return np.asarray(light + noise * 400 * rng.standard_normal(light.shape))


@pytest.mark.parametrize("row_time_s", [2.1e-4, -2.1e-4, 3e-5, 0.0])
def test_it_is_found_with_its_standard_deviation(row_time_s):
    off = []
    for seed in range(20):
        found = row_time(blinking(row_time_s, 197.0, seed), np.arange(30), PERIOD_S, 197.0)
        off.append((found.row_time_s - row_time_s) / found.sd_s)
        assert found.sd_s < 2e-6
    assert np.abs(off).max() < 5
    assert 0.1 < np.sqrt(np.mean(np.square(off))) < 2.5


@settings(max_examples=15, deadline=None)
@given(blink=st.floats(110, 380), readout=st.floats(-0.9, 0.9))
def test_its_sign_follows_from_the_rate_of_the_light(blink, readout):
    phase = blink * PERIOD_S % 1
    if min(abs(phase - each) for each in IN_STEP) < 0.04 or abs(readout) < 0.05:
        return
    true = readout * PERIOD_S / ROWS
    found = row_time(blinking(true, blink, 3), np.arange(30), PERIOD_S, blink)
    assert found.row_time_s == pytest.approx(true, rel=0.01, abs=4 * found.sd_s)
    assert found.row_time_s * true > 0


def test_lost_frames_are_gaps():
    light, kept = blinking(2e-4, 197.0, 1), np.delete(np.arange(30), [3, 4, 17])
    found = row_time(light[kept], kept, PERIOD_S, 197.0)
    assert found.row_time_s == pytest.approx(2e-4, rel=0.01)
    assert found.frames == 27


@pytest.mark.parametrize(
    ("light", "blink", "says"),
    [
        (np.ones((4, 100)), 197.0, "8 frames"),
        (1000 + np.random.default_rng(0).standard_normal((30, 100)), 197.0, "do not blink"),
        (np.ones((30, 100)), 210.0, "in step"),
        (np.zeros((30, 100)), 197.0, "no light"),
        (blinking(2e-4, 197.0, 1), 203.0, "check blink_hz"),
    ],
)
def test_what_cannot_give_it_is_refused(light, blink, says):
    with pytest.raises(CalibrationError, match=says):
        row_time(light, np.arange(len(light)), PERIOD_S, blink)
