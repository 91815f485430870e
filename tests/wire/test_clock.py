"""The clock regression, on exchanges whose truth is known."""

from __future__ import annotations

import numpy as np

from aolink.wire.clock import QUERY_PERIOD_S, ClockExchange, ClockRegression

START = 1_767_225_600_000_000_000
OFFSET = -7_000_000_000_123


class Line:
    """A device's clock and a line with delays, without waiting."""

    def __init__(self, seed: int, drift_ppm: float, step_ns: int = 0, step_at: int = 10**9) -> None:
        self.rng = np.random.default_rng(seed)
        self.drift_ppm, self.step_ns, self.step_at = drift_ppm, step_ns, step_at

    def device_ns(self, host_ns: int) -> int:
        elapsed = host_ns - START
        stepped = self.step_ns if elapsed >= self.step_at * 10**9 else 0
        return host_ns + OFFSET + stepped + round(elapsed * self.drift_ppm * 1e-6)

    def exchange(self, second: float, extra_ns: int = 0) -> ClockExchange:
        there, back = (80_000 + self.rng.exponential(20_000, 2)).astype(int).tolist()
        sent = START + round(second * 1e9)
        arrived = sent + there + extra_ns
        return ClockExchange(sent, self.device_ns(arrived), self.device_ns(arrived + 5000), arrived + 5000 + back)


def settled(line: Line, queries: int = 60) -> tuple[ClockRegression, int]:
    clock = ClockRegression()
    for k in range(queries):
        assert clock.add(line.exchange(k * QUERY_PERIOD_S))
    return clock, START + round(queries * QUERY_PERIOD_S * 1e9)


def test_offset_and_frequency_are_found_within_their_sigma() -> None:
    errors = []
    for seed in range(40):
        line = Line(seed, drift_ppm=20.0)
        clock, now = settled(line)
        device_ns, sigma = clock.device_ns(now)
        errors.append((device_ns - line.device_ns(now)) / sigma)
        assert abs(clock.frequency_ppm - 20.0) < 1.0
    assert np.max(np.abs(errors)) < 3


def test_there_and_back_is_the_same_time() -> None:
    clock, now = settled(Line(3, drift_ppm=-35.0))
    for later_s in (-3600, 0, 3600):
        host_ns = now + later_s * 10**9
        assert abs(clock.host_ns(clock.device_ns(host_ns)[0])[0] - host_ns) <= 1


def test_sigma_grows_away_from_the_samples() -> None:
    clock, now = settled(Line(4, drift_ppm=5.0))
    assert clock.device_ns(now + 36 * 10**11)[1] > 2 * clock.device_ns(now)[1]


def test_slow_round_trips_and_outliers_are_refused() -> None:
    line = Line(5, drift_ppm=0.0)
    clock, now = settled(line)
    before = clock.device_ns(now)
    assert not clock.add(line.exchange(61.0, extra_ns=5_000_000))
    exchange = line.exchange(62.0)
    lie = 50_000_000
    outlier = ClockExchange(
        exchange.host_send_ns, exchange.device_receive_ns + lie, exchange.device_send_ns + lie, exchange.host_receive_ns
    )
    assert not clock.add(outlier)
    assert clock.device_ns(now) == before


def test_a_clock_that_was_set_is_followed_after_some_refusals() -> None:
    line = Line(6, drift_ppm=10.0, step_ns=3_000_000_000, step_at=60)
    clock, _ = settled(line)
    taken = [clock.add(line.exchange(60 + k)) for k in range(6)]
    assert taken == [False, False, False, True, True, True]
    now = START + 66 * 10**9
    device_ns, sigma = clock.device_ns(now)
    assert abs(device_ns - line.device_ns(now)) < 4 * sigma


def test_a_reply_from_before_its_query_is_refused() -> None:
    assert not ClockRegression().add(ClockExchange(START, 0, 10_000, START + 5000))


def test_a_line_that_has_become_slower_for_good_is_taken_as_it_is() -> None:
    line = Line(7, drift_ppm=10.0)
    clock, _ = settled(line)
    slow = []
    for k in range(8):
        exchange = line.exchange(60 + k)
        late = 2_000_000  # there and back alike
        slow.append(
            clock.add(
                ClockExchange(
                    exchange.host_send_ns - late,
                    exchange.device_receive_ns,
                    exchange.device_send_ns,
                    exchange.host_receive_ns + late,
                )
            )
        )
    assert slow == [False, False, False, True, True, True, True, True]
    now = START + 68 * 10**9
    device_ns, sigma = clock.device_ns(now)
    assert abs(device_ns - line.device_ns(now)) < 2 * sigma
    assert 1e6 < sigma < 2e6
