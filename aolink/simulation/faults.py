"""The damage of a bad serial line to bytes, by rate and by seed: the faults of ``[simulation.faults]`` that need no
clock."""

from __future__ import annotations

import numpy as np

from aolink.rig import Faults

_BURST = 64
"""Longest burst of noise, bytes."""


class Way:
    """One direction of one serial line: it damages bytes, and gives their delay.

    It takes whole packets, so that its faults depend on the bytes sent and not on how they are read.
    """

    def __init__(self, faults: Faults, rng: np.random.Generator, *, to_host: bool) -> None:
        self._faults, self._rng = faults, rng
        self._loss = faults.packet_loss_rate if to_host else faults.command_loss_rate
        self._flip = faults.bit_flip_rate if to_host else 0.0
        self._duplicate = faults.duplicate_rate if to_host else 0.0
        self._delay_s = faults.delay_to_host_s if to_host else faults.delay_to_device_s

    def damage(self, packet: bytes) -> bytes:
        """The bytes that arrive at the other end for a packet and its delimiter."""
        if self.hits(self._loss):
            return b""
        if self.hits(self._flip):  # the size of the packet, not of its delimiter
            packet = _flipped(packet, self._rng.integers(8 * (len(packet) - 1), size=1))
        if self.hits(self._duplicate):
            packet *= 2
        return self._damage_bytes(packet)

    def delay_ns(self) -> int:
        """The delay of a packet beyond that of a good line, ns."""
        delay_s = self._delay_s
        if self._faults.jitter_s:
            delay_s += self._faults.jitter_s * float(self._rng.standard_exponential())
        if self.hits(self._faults.stall_rate):
            delay_s += self._faults.stall_s
        return round(delay_s * 1e9)

    def vanishes(self) -> bool:
        """Whether the port vanishes with a packet."""
        return self.hits(self._faults.vanish_rate)

    def hits(self, rate: float) -> bool:
        return rate > 0 and float(self._rng.random()) < rate

    def _damage_bytes(self, data: bytes) -> bytes:
        faults, rng = self._faults, self._rng
        if faults.bit_error_rate and (n := rng.binomial(8 * len(data), faults.bit_error_rate)):
            data = _flipped(data, rng.choice(8 * len(data), size=n, replace=False))
        for start in self._some(len(data), faults.burst_rate):
            end = min(start + int(rng.integers(1, _BURST + 1)), len(data))
            data = data[:start] + rng.bytes(end - start) + data[end:]
        # From the end backwards, so that earlier places stay valid.
        for k in self._some(len(data), faults.byte_loss_rate)[::-1]:
            data = data[:k] + data[k + 1 :]
        for k in self._some(len(data), faults.byte_repeat_rate)[::-1]:
            data = data[: k + 1] + data[k:]
        for k in self._some(len(data), faults.byte_insert_rate)[::-1]:
            data = data[:k] + rng.bytes(1) + data[k:]
        return data

    def _some(self, size: int, rate: float) -> list[int]:
        """Places among ``size``, each with probability ``rate``, in order."""
        if not rate:
            return []
        n = self._rng.binomial(size, rate)
        return sorted(self._rng.choice(size, size=n, replace=False).tolist()) if n else []


def _flipped(data: bytes, bits: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> bytes:
    damaged = bytearray(data)
    for bit in bits.tolist():
        damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)
