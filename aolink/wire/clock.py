"""The device's clock seen from the host: a decayed linear regression over clock queries."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

QUERY_PERIOD_S = 0.9839
"""Between two queries: no multiple of a loop's period, so that queries and loop do not resonate."""
WARM_UP_QUERIES = 8
"""Asked at once at the start: one alone says nothing about its own round trip."""
_WINDOW = 64
_DECAY_S = 30.0
"""Age at which a sample counts 1/e: temperature moves a crystal in minutes."""
_FREQUENCY_PRIOR = 200e-6
"""Standard deviation of a crystal's frequency error before anything is known."""
_RESOLUTION_NS = 1000.0
"""No sample is taken to be better than this: interrupts and schedulers on both sides."""
_SLOW_FACTOR = 4.0
"""A round trip longer than this many times the shortest says too little to be used."""
_GATE_SIGMA = 6.0
_STEP_AFTER = 4
"""So many refused in a row are right: the device's clock was set, or the line has become slower for good."""


@dataclass(frozen=True, slots=True)
class ClockExchange:
    """One query and its reply; the four times, ns."""

    host_send_ns: int
    device_receive_ns: int
    device_send_ns: int
    host_receive_ns: int

    @property
    def round_trip_ns(self) -> int:
        """Less the time that the device took."""
        return (self.host_receive_ns - self.host_send_ns) - (self.device_send_ns - self.device_receive_ns)

    @property
    def host_ns(self) -> int:
        return (self.host_send_ns + self.host_receive_ns) // 2

    @property
    def device_ns(self) -> int:
        return (self.device_receive_ns + self.device_send_ns) // 2


class ClockRegression:
    """Offset and frequency of a device's clock, with their uncertainty.

    device = host + offset + frequency * (host - reference). The samples are weighted by how much
    longer than the shortest their round trip was, and by age. What no query can see is how the
    shortest round trip divides into there and back: its half-width, taken as uniform, is in sigma.
    """

    def __init__(self) -> None:
        self._samples: deque[ClockExchange] = deque(maxlen=_WINDOW)
        self._refused: list[ClockExchange] = []
        self._reference: ClockExchange | None = None
        self._solution = np.zeros(2)
        self._covariance = np.full((2, 2), np.nan)
        self._asymmetry_ns = math.nan

    @property
    def ready(self) -> bool:
        """Whether there is an estimate."""
        return self._reference is not None

    def add(self, exchange: ClockExchange) -> bool:
        """Take an exchange into account; False if it was refused as slow or as an outlier."""
        if exchange.round_trip_ns < 0:
            return False
        if self._samples:
            shortest = min(s.round_trip_ns for s in self._samples)
            slow = exchange.round_trip_ns > _SLOW_FACTOR * max(shortest, _RESOLUTION_NS)
            predicted, sigma = self.device_ns(exchange.host_ns)
            slack = _GATE_SIGMA * math.hypot(sigma, _RESOLUTION_NS) + exchange.round_trip_ns / 2
            if slow or abs(exchange.device_ns - predicted) > slack:
                self._refused.append(exchange)
                if len(self._refused) < _STEP_AFTER:
                    return False
                self._samples.clear()
                self._samples.extend(self._refused[:-1])
        self._refused.clear()
        self._samples.append(exchange)
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
        sd = np.maximum((trips - trips.min()) / 2, _RESOLUTION_NS)
        weight = np.exp(host / 1e9 / _DECAY_S) / sd**2
        design = np.column_stack([np.ones_like(host), host])
        information = design.T @ (weight[:, None] * design) + np.diag([0.0, _FREQUENCY_PRIOR**-2])
        # The two columns differ by ten orders of magnitude: scale before inverting.
        scale = 1 / np.sqrt(np.diag(information))
        self._covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
        self._solution = self._covariance @ (design.T @ (weight * offset))
        residual = offset - design @ self._solution
        if len(self._samples) > 2:
            excess = float(np.sum(weight * residual**2) / np.sum(weight * sd**2))
            self._covariance = self._covariance * max(1.0, excess)
        self._asymmetry_ns = float(trips.min()) / 2 / math.sqrt(3)
        self._reference = reference

    def device_ns(self, host_ns: int) -> tuple[int, float]:
        """Device time at a host time, and its standard deviation, ns."""
        assert self._reference is not None, "ask `ready` first"
        elapsed = host_ns - self._reference.host_ns
        row = np.array([1.0, float(elapsed)])
        sigma = math.sqrt(float(row @ self._covariance @ row) + self._asymmetry_ns**2)
        return self._reference.device_ns + elapsed + round(float(row @ self._solution)), sigma

    def host_ns(self, device_ns: int) -> tuple[int, float]:
        """Host time at a device time, and its standard deviation, ns."""
        assert self._reference is not None, "ask `ready` first"
        elapsed = device_ns - self._reference.device_ns
        host = (elapsed - float(self._solution[0])) / (1 + float(self._solution[1]))
        # elapsed may be hours: keep the integer part exact, the correction is small.
        host_ns = self._reference.host_ns + elapsed + round(host - elapsed)
        return host_ns, self.device_ns(host_ns)[1]

    @property
    def frequency_ppm(self) -> float:
        """By how much the device's clock runs fast, parts per million."""
        return float(self._solution[1]) * 1e6

    def offset_ns(self, host_ns: int) -> float:
        """Device clock minus host clock at a host time, ns."""
        return float(self.device_ns(host_ns)[0] - host_ns)
