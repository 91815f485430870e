"""The device's clock seen from the host: a regression over clock queries, in which the frequency is a random walk."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

QUERY_PERIOD_S = 0.9839
"""Time between two queries: no multiple of a loop's period, so that queries and loop do not resonate."""
SUSPICION_PERIOD_S = 0.0419
"""Time between two queries while a clock is suspected of having been set: `_STEP_AFTER` of them settle it."""
WARM_UP_QUERIES = 8
"""Queries in a row at the start: one alone does not show how much of its round trip is chance."""
_WINDOW = 64
_FREQUENCY_PRIOR = 200e-6
"""Standard deviation of a crystal's frequency error before anything is known."""
_MOST_FREQUENCY = 1e-3
"""No crystal's frequency is off by more; replies that would need more are refused."""
_FREQUENCY_WALK = 1e-6 / math.sqrt(60.0)
"""Random walk of the frequency, 1/sqrt(s): temperature moves a crystal by some 1e-6 in a minute."""
_RESOLUTION_NS = 1000.0
"""Least standard deviation of a sample: interrupts and schedulers on both sides."""
_SLOW_FACTOR = 4.0
"""A sample whose round trip is longer than this many times the shortest is too inaccurate to be used."""
_GATE_SIGMA = 6.0
_STEP_AFTER = 4
"""When this many refused samples agree, they are right: the device's clock was set, or the serial line has become
slower."""
_REFUSED_KEPT = 16
_STAMP_NS = 50_000.0
"""The most by which a device's time stamp may differ from the end of a fast step without raising suspicion, ns:
interrupt latency."""


@dataclass(frozen=True, slots=True)
class ClockExchange:
    """One query and its reply; the four times, ns."""

    host_send_ns: int
    device_receive_ns: int
    device_send_ns: int
    host_receive_ns: int

    @property
    def round_trip_ns(self) -> int:
        """Time from query to reply on the host, less the time that the device took, ns."""
        return (self.host_receive_ns - self.host_send_ns) - (self.device_send_ns - self.device_receive_ns)

    @property
    def host_ns(self) -> int:
        return (self.host_send_ns + self.host_receive_ns) // 2

    @property
    def device_ns(self) -> int:
        return (self.device_receive_ns + self.device_send_ns) // 2


@dataclass(frozen=True, slots=True)
class ClockStep:
    """A step of a device's clock that queries have found: it was set."""

    after_ns: int
    """Host time of the last query before that agreed with the old clock."""
    before_ns: int
    """Host time of the first query that agreed with the new one."""
    size_ns: int
    """Step by which the device's clock was set forward, ns."""


class ClockRegression:
    """Offset and frequency of a device's clock, with their uncertainty.

    device = host + offset + frequency * (host - reference). A sample has more weight if its round trip is close to the
    shortest, and if it is new: the frequency is a random walk, so that the offset's variance grows with the cube of the
    time since the newest sample. No query can show how the shortest round trip divides into the two directions: sigma
    includes that, as a uniform error of half the round trip to either side. This error is common to all times between
    two steps of the clock; it does not average out.

    A reply that contradicts the regression makes the clock suspect, and so does a call of `suspect`. Until newer
    queries have settled it, both clocks count, before and after the step: times follow the clock before the step, and
    sigma is wide enough to cover the clock after it.
    """

    def __init__(self) -> None:
        self._samples: deque[ClockExchange] = deque(maxlen=_WINDOW)
        self._refused: deque[ClockExchange] = deque(maxlen=_REFUSED_KEPT)
        self._trips: deque[int] = deque(maxlen=_WINDOW)
        """Round trips of samples, ns: they are kept after a step of the clock, because the serial line has not
        changed."""
        self._reference_ns: tuple[int, int] | None = None
        """Host time and device time of the newest sample."""
        self._solution = np.zeros(2)
        self._covariance = np.full((2, 2), np.nan)
        self._asymmetry_ns = math.nan
        self._doubt_ns = 0.0
        """Size of a suspected step, ns; 0 where there is no suspicion."""
        self._doubt_since_ns = 0
        self.step: ClockStep | None = None
        """The newest step of the clock, once it is certain."""
        self.settled = 0
        """Number of suspicions that have been settled, one way or the other."""

    @property
    def ready(self) -> bool:
        """Whether there is an estimate."""
        return self._reference_ns is not None

    @property
    def suspected(self) -> bool:
        """Whether the clock may have been set, so that queries should be sent until that is settled."""
        return self._doubt_ns > 0

    def suspect(self, size_ns: float, host_ns: int) -> None:
        """Suspect a step of ``size_ns``, for another reason than a query's reply, at ``host_ns``."""
        self._doubt_ns = max(self._doubt_ns, size_ns)
        self._doubt_since_ns = host_ns

    def add(self, exchange: ClockExchange) -> bool:
        """Take an exchange into account; False if it was refused as slow, as an outlier or as impossible."""
        if exchange.round_trip_ns < 0 or exchange.device_send_ns < exchange.device_receive_ns:
            return False
        if self._samples:
            slow = exchange.round_trip_ns > _SLOW_FACTOR * max(min(self._trips), _RESOLUTION_NS)
            predicted, sigma = self._by_line(exchange.host_ns)
            apart = exchange.device_ns - predicted
            outlier = abs(apart) > _GATE_SIGMA * math.hypot(sigma, _RESOLUTION_NS) + exchange.round_trip_ns / 2
            if outlier:
                self.suspect(math.hypot(apart, exchange.round_trip_ns / 2), exchange.host_send_ns)
            if slow or outlier:
                self._refused.append(exchange)
                agreeing = [each for each in self._refused if _agree(each, exchange)]
                if len(agreeing) < _STEP_AFTER:
                    return False
                if outlier:
                    self.step = ClockStep(self._samples[-1].host_ns, agreeing[0].host_ns, apart)
                self._samples.clear()
                self._samples.extend(agreeing[:-1])
                if slow:
                    self._trips.clear()
                self._trips.extend(each.round_trip_ns for each in agreeing[:-1])
        self._refused.clear()
        if self.suspected and exchange.host_send_ns >= self._doubt_since_ns:
            self._doubt_ns = 0.0
            self.settled += 1
        self._samples.append(exchange)
        self._trips.append(exchange.round_trip_ns)
        self._solve()
        return True

    def _solve(self) -> None:
        # Integers of ns since 1970 do not fit into a float: everything is relative to the newest sample.
        reference = self._samples[-1]
        host = np.array([s.host_ns - reference.host_ns for s in self._samples], dtype=np.float64)
        offset = np.array(
            [(s.device_ns - reference.device_ns) - (s.host_ns - reference.host_ns) for s in self._samples],
            dtype=np.float64,
        )
        trips = np.array([s.round_trip_ns for s in self._samples], dtype=np.float64)
        # All samples may have taken longer than the line's shortest time; their spread and number show by how much.
        shortest = min(self._trips)
        longer = (sum(self._trips) / len(self._trips) - shortest) / math.sqrt(len(self._trips))
        sd = np.maximum((trips - shortest) / 2, max(_RESOLUTION_NS, longer / 2))
        # The walk of the frequency, integrated twice, backwards from the newest sample.
        age = np.abs(host) / 1e9
        near, far = np.minimum.outer(age, age), np.maximum.outer(age, age)
        walked = (1e9 * _FREQUENCY_WALK) ** 2 * near**2 * (3 * far - near) / 6
        weight = np.linalg.inv(walked + np.diag(sd**2))
        design = np.column_stack([np.ones_like(host), host])
        information = design.T @ weight @ design + np.diag([0.0, _FREQUENCY_PRIOR**-2])
        # The two columns differ by ten orders of magnitude: scale before inverting.
        scale = 1 / np.sqrt(np.diag(information))
        self._covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
        self._solution = self._covariance @ (design.T @ (weight @ offset))
        self._solution[1] = np.clip(self._solution[1], -_MOST_FREQUENCY, _MOST_FREQUENCY)
        residual = offset - design @ self._solution
        if len(self._samples) > 2:
            excess = float(residual @ weight @ residual) / (len(self._samples) - 2)
            self._covariance = self._covariance * max(1.0, excess)
        self._asymmetry_ns = shortest / 2 / math.sqrt(3)
        self._reference_ns = reference.host_ns, reference.device_ns

    def _by_line(self, host_ns: int) -> tuple[int, float]:
        """Device time at a host time by the regression, and its standard deviation if the clock has not been set,
        ns."""
        assert self._reference_ns is not None, "ask `ready` first"
        reference_ns, device_ns = self._reference_ns
        elapsed = host_ns - reference_ns
        row = np.array([1.0, float(elapsed)])
        walked = 1e9 * _FREQUENCY_WALK * math.sqrt(abs(elapsed / 1e9) ** 3 / 3)
        sigma = math.hypot(math.sqrt(float(row @ self._covariance @ row)), self._asymmetry_ns, walked)
        return device_ns + elapsed + round(float(row @ self._solution)), sigma

    def device_ns(self, host_ns: int) -> tuple[int, float]:
        """Device time at a host time, and its standard deviation, ns."""
        (device_ns, sigma), doubt_ns = self._by_line(host_ns), self._doubt_ns
        if not doubt_ns and self.step is not None and host_ns < self.step.before_ns:
            doubt_ns = abs(self.step.size_ns)  # the clock had been set, which was found only after this time
        return device_ns, math.hypot(sigma, doubt_ns)

    def host_ns(self, device_ns: int) -> tuple[int, float]:
        """Host time at a device time, and its standard deviation, ns."""
        assert self._reference_ns is not None, "ask `ready` first"
        reference_ns, reference_device_ns = self._reference_ns
        elapsed = device_ns - reference_device_ns
        host = (elapsed - float(self._solution[0])) / (1 + float(self._solution[1]))
        # elapsed may be hours: keep the integer part exact, the correction is small.
        host_ns = reference_ns + elapsed + round(host - elapsed)
        return host_ns, self.device_ns(host_ns)[1]

    @property
    def frequency_ppm(self) -> float:
        """Relative frequency error of the device's clock, parts per million; positive where it runs fast."""
        return float(self._solution[1]) * 1e6

    def offset_ns(self, host_ns: int) -> float:
        """Device clock minus host clock at a host time, ns."""
        return float(self.device_ns(host_ns)[0] - host_ns)


def _agree(one: ClockExchange, other: ClockExchange) -> bool:
    """Whether two exchanges can belong to one unchanged clock."""
    apart = (one.device_ns - one.host_ns) - (other.device_ns - other.host_ns)
    drifted = _MOST_FREQUENCY * abs(one.host_ns - other.host_ns)
    return abs(apart) <= (one.round_trip_ns + other.round_trip_ns) / 2 + _RESOLUTION_NS + drifted


class StepClock:
    """A device's clock beside its count of fast steps.

    A device stamps its frames and reports with both. Both run from one crystal, so where they disagree, the clock was
    set: the stamps show that at once, up to a second before the next query does.
    """

    def __init__(self, clock: ClockRegression, step_zero_ns: int, fast_step_ns: int) -> None:
        self._clock, self._fast_step_ns = clock, fast_step_ns
        self._zero_ns = self._seen_ns = step_zero_ns
        self._settled = clock.settled

    @property
    def step_zero_ns(self) -> int:
        """Device time at which fast step 0 began, on the clock that the regression knows."""
        if self._settled != self._clock.settled and not self._clock.suspected:
            self._settled, self._zero_ns = self._clock.settled, self._seen_ns
        return self._zero_ns

    def host_ns(self, device_ns: int, since_zero_ns: int, now_ns: int) -> tuple[int, float]:
        """Host time of a stamp that came by ``now_ns``, and its standard deviation, ns.

        Parameters
        ----------
        device_ns:
            The stamp, on the device's clock.
        since_zero_ns:
            Time from the beginning of fast step 0 to the stamp, by the count of fast steps.
        now_ns:
            Host time.
        """
        stamped_zero_ns = device_ns - since_zero_ns
        apart = abs(stamped_zero_ns - self.step_zero_ns)
        self._seen_ns = stamped_zero_ns
        if apart > _STAMP_NS:
            self._clock.suspect(apart, now_ns)
        elif not self._clock.suspected:
            self._zero_ns = stamped_zero_ns
        host_ns, sigma = self._clock.host_ns(device_ns)
        if host_ns - now_ns > _GATE_SIGMA * sigma:  # a stamp that has come cannot be from the future
            self._clock.suspect(host_ns - now_ns, now_ns)
            sigma = math.hypot(sigma, host_ns - now_ns)
        return host_ns, sigma
