"""The search for the highest maximum of the likelihood."""

import sys
from pathlib import Path

import numpy as np
import pytest

from aolink.identification import maxima, readings, space_of
from aolink.rig import load_rig

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from bench_rows.identification import DisturbanceChange, changed


@pytest.mark.long
def test_a_sharp_line_beside_a_drift_is_found_although_only_an_alias_is_found_at_first():
    """The line is at 14.4 Hz; the best that the grid and its aliases lead to is at 34.4 Hz, 20 nats below."""
    rig = load_rig("loop")
    seen = [readings(rig, changed(DisturbanceChange("", frequency=1.2), 180, 30_001)[84:])]
    kinds = ("ornstein-uhlenbeck", "resonance")
    space = space_of(kinds, seen, rig.sensor.kernel.variance, with_noise=False, with_kernel=False)
    found = maxima(space, seen)
    highest = dict(zip(space.names, np.exp(found[0].x), strict=True))
    assert highest["resonance.frequency_hz"] == pytest.approx(14.4, rel=0.01)
    assert found == sorted(found, key=lambda each: -each.log_likelihood)
