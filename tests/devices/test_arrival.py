"""Frames without a time: their arrival stands for it, smoothed, with its uncertainty."""

from __future__ import annotations

import numpy as np
import pytest

from aolink.devices.arrival import Arrivals

PERIOD_NS = 50_000_000


@pytest.mark.parametrize(("jitter_ns", "drift"), [(2e6, 0.0), (1e6, 0.01), (5e6, -0.003)])
def test_arrivals_are_smoothed_and_their_error_is_known(jitter_ns: float, drift: float) -> None:
    rng = np.random.default_rng(3)
    scores = []
    for _ in range(30):
        arrivals = Arrivals(PERIOD_NS)
        for k in range(1, 60):
            true_ns = 10**15 + round(k * PERIOD_NS * (1 + drift))
            late_ns = round(rng.normal(0.0, jitter_ns)) + (30_000_000 if rng.random() < 0.03 else 0)
            smoothed_ns, sd_ns = arrivals.add(k, true_ns + late_ns)
            if k > 20:
                scores.append((smoothed_ns - true_ns) / sd_ns)
                assert sd_ns < jitter_ns
    assert abs(np.mean(scores)) < 0.5  # late ones, which are few, are left out
    assert 0.5 < np.std(scores) < 1.6


def test_frames_that_are_not_counted_are_counted_by_their_arrival() -> None:
    arrivals = Arrivals(PERIOD_NS)
    counts = []
    for k in (1, 2, 3, 6, 7):
        counts.append(arrivals.count_at(k * PERIOD_NS + 3_000_000 * (k % 2)))
        arrivals.add(counts[-1], k * PERIOD_NS)
    assert counts == [1, 2, 3, 6, 7]


@pytest.mark.parametrize("held_up", [0.6, 0.9, 1.4])
def test_a_frame_that_was_held_up_does_not_move_those_after_it(held_up: float) -> None:
    """What is held up for long looks like the frame after a lost one, but only until the next arrives."""
    rng = np.random.default_rng(5)
    arrivals, counts = Arrivals(PERIOD_NS), []
    for k in range(1, 60):
        true_ns = k * PERIOD_NS
        at_ns = true_ns + round(rng.normal(0.0, 1e6)) + round(held_up * PERIOD_NS) * (k == 30)
        at_ns = max(at_ns, true_ns + round((held_up - 1) * PERIOD_NS) + 1_000_000 if k == 31 else 0)
        counts.append(arrivals.count_at(at_ns))
        smoothed_ns, sd_ns = arrivals.add(counts[-1], at_ns)
        if k > 31:
            assert abs(smoothed_ns - true_ns) < max(6 * sd_ns, 2e6)
            assert sd_ns < 2e6
    assert (np.diff(counts) >= 1).all()
    assert counts[-1] == (59 if held_up < 0.75 else 60)


def test_another_rhythm_begins_anew() -> None:
    arrivals = Arrivals(PERIOD_NS)
    for k in range(1, 20):
        arrivals.add(k, k * PERIOD_NS)
    at_ns = 20 * PERIOD_NS + 3 * PERIOD_NS // 2
    for k in range(20, 30):
        smoothed_ns, sd_ns = arrivals.add(k, at_ns + (k - 20) * PERIOD_NS)
    assert abs(smoothed_ns - at_ns - 9 * PERIOD_NS) < 1000
    assert sd_ns < 1000
