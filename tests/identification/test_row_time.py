"""Pairs of a frequency and a row time: the true one is among them."""

from __future__ import annotations

import numpy as np
import pytest

from aolink.identification.bands import BandFit, Bands
from aolink.identification.row_time import Pair, pairs
from aolink.numerics.arrays import FloatArray
from tests.identification.test_bands import seen

ROWS: FloatArray = 0.5 + 2 * np.arange(60.0)


def found(bands: Bands) -> list[Pair]:
    """Of a camera of 120 rows."""
    return pairs(BandFit(bands), ROWS, 120)


@pytest.mark.slow
def test_one_tone_goes_with_many_row_times_and_the_true_one_is_among_them() -> None:
    rng = np.random.default_rng(8)
    for seed in range(10):
        hz, readout = float(rng.uniform(200, 1100)), float(rng.uniform(8e-3, 30e-3))
        those = found(seen((hz, 0.4 * np.exp(6j * seed)), exposure=0.6e-3, readout=readout, seed=seed))
        assert len(those) > 3
        (right,) = [pair for pair in those if abs(pair.hz - hz) < 15]
        assert right.hz == pytest.approx(hz, abs=0.02)
        assert abs(right.row_time_s - readout / 120) < 4 * right.sd_s
        assert right.sd_s < 2e-3 * right.row_time_s
        assert max(pair.row_time_s for pair in those) < 1 / 30 / 120


@pytest.mark.slow
def test_two_tones_leave_few() -> None:
    those = found(seen((431.7, 0.6), (709.3, 0.6j), exposure=0.6e-3, readout=0.02, frames=90))
    assert len(those) < 10  # of some 90
    assert min(abs(pair.hz - 431.7) for pair in those) < 0.05
    assert min(abs(pair.row_time_s - 0.02 / 120) for pair in those) < 1e-3 * 0.02 / 120


@pytest.mark.slow
def test_without_a_tone_there_are_none() -> None:
    assert not found(seen((431.7, 0j)))
