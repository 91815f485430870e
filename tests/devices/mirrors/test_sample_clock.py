"""A clock by counts of samples: it follows a drifting device to a part of a sample, and notices lost ones."""

from __future__ import annotations

import random

import pytest

from aolink.devices.mirrors.sample_clock import SampleClock

START_NS = 1_000_000_000_000
PERIOD_NS = 1_000_000


class Device:
    """A device with a queue, and a host that counts; no time passes but what `count` lets pass."""

    def __init__(self, seed: int, drift: float, trip_ns: int) -> None:
        self._random, self._drift, self._trip_ns = random.Random(seed), drift, trip_ns
        self.now_ns = START_NS
        self.lost = 0
        self.clock = SampleClock(PERIOD_NS)

    @property
    def true_ns(self) -> float:
        return (self.now_ns - START_NS + 12_345_678) * (1 + self._drift)

    def count(self, pause_ns: int = 10_000_000) -> float:
        self.now_ns += round(self._random.uniform(0.5, 1.5) * pause_ns)
        asked_ns = self.now_ns
        self.now_ns += self._way()
        taken = int(self.true_ns // PERIOD_NS) + 1 + self.lost
        self.now_ns += self._way()
        return self.clock.add(taken, asked_ns, self.now_ns)

    def _way(self) -> int:
        return round(self._trip_ns * self._random.uniform(0.3, 0.7))


@pytest.mark.parametrize("drift", [-100e-6, 0.0, 50e-6])
@pytest.mark.parametrize("seed", [1, 2])
def test_the_time_is_known_to_a_part_of_a_sample(seed: int, drift: float) -> None:
    device = Device(seed, drift, 200_000)
    assert not any(device.count() for _ in range(30))
    device.clock.settle()
    before, scores = None, []
    for _ in range(2000):
        assert device.count() == 0
        told_ns = device.clock.time_ns(device.now_ns)
        assert abs(told_ns - device.true_ns) < 0.15 * PERIOD_NS  # 0.04 of it is the line's asymmetry
        if before is not None:  # it never jumps, and is never far from the host's rate
            assert abs((told_ns - before[0]) / (device.now_ns - before[1]) - 1) < 1e-3
        before = told_ns, device.now_ns
        scores.append((told_ns - device.true_ns) / device.clock.sigma_ns)
    assert sum(abs(score) < 3 for score in scores) > 0.95 * len(scores)


@pytest.mark.parametrize("lost", [1, 3, -2])
def test_samples_that_are_missing_or_too_many_are_noticed(lost: int) -> None:
    device = Device(1, 20e-6, 100_000)
    assert not any(device.count() for _ in range(100))
    device.lost = lost
    slips = [slip for slip in (device.count() for _ in range(10)) if slip]
    assert slips
    assert all(0 < -slip / lost <= 1.01 for slip in slips)


def test_a_device_that_stood_still_is_followed_again() -> None:
    device = Device(1, 20e-6, 100_000)
    assert not any(device.count() for _ in range(100))
    device.lost = 1
    device.clock.doubt(PERIOD_NS)
    assert not any(device.count() for _ in range(2000))
    assert abs(device.clock.time_ns(device.now_ns) - device.true_ns - PERIOD_NS) < 0.15 * PERIOD_NS
