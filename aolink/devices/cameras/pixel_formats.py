"""Pixel formats of GenICam's Pixel Format Naming Convention (PFNC) with one value for each pixel: bytes to counts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PixelFormat:
    """How the counts of one picture lie in bytes, row after row."""

    name: str
    code: int
    """The PFNC's number for it."""
    bits: int
    """Bits of a count."""
    stored_bits: int
    """Bits that each takes: 8 or 16, the least significant byte first, or ``bits`` where they are packed."""

    @property
    def packed(self) -> bool:
        """Whether counts follow each other without a gap, the least significant bit first."""
        return self.stored_bits not in (8, 16)

    def size(self, n_pixels: int) -> int:
        """Bytes that a number of pixels takes."""
        return -(-n_pixels * self.stored_bits // 8)

    def counts(self, data: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint16]:
        """Counts (rows, columns) from bytes: a view of ``data`` where each takes two bytes, otherwise a new array."""
        n_pixels = shape[0] * shape[1]
        data = data[: self.size(n_pixels)]
        if not self.packed:
            return data.view(f"<u{self.stored_bits // 8}").astype(np.uint16, copy=False).reshape(shape)
        padded = self._padded(data, n_pixels).astype(np.uint16)
        counts = np.empty((len(padded), self._group), dtype=np.uint16)
        for k in range(self._group):
            byte, shift = divmod(k * self.bits, 8)
            counts[:, k] = (padded[:, byte] | padded[:, byte + 1] << 8) >> shift & (1 << self.bits) - 1
        return counts.ravel()[:n_pixels].reshape(shape)

    def whole(self, arrived: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Mask (rows, columns) of the pixels whose bytes have all ``arrived``, which has one element for each byte."""
        n_pixels = shape[0] * shape[1]
        arrived = arrived[: self.size(n_pixels)]
        if self.packed:
            padded = self._padded(arrived, n_pixels)
            first = [k * self.bits // 8 for k in range(self._group)]
            whole = padded[:, first] & padded[:, [byte + 1 for byte in first]]
        else:
            whole = arrived.reshape(-1, self.stored_bits // 8).all(axis=1)
        return np.asarray(whole).ravel()[:n_pixels].reshape(shape)

    @property
    def _group(self) -> int:
        """Fewest packed counts that fill whole bytes; each of 10 or 12 bits lies in two bytes."""
        return 8 // math.gcd(self.bits, 8)

    def _padded(self, data: NDArray[Any], n_pixels: int) -> NDArray[Any]:
        """Groups of packed counts, (groups, bytes of a group), the last one filled up with zeros."""
        groups = -(-n_pixels // self._group)
        padded = np.zeros((groups, self._group * self.bits // 8), dtype=data.dtype)
        padded.ravel()[: len(data)] = data
        return padded


PIXEL_FORMATS = {
    each.name: each
    for each in (
        PixelFormat("Mono8", 0x01080001, 8, 8),
        PixelFormat("Mono10p", 0x010A0046, 10, 10),
        PixelFormat("Mono10", 0x01100003, 10, 16),
        PixelFormat("Mono12p", 0x010C0047, 12, 12),
        PixelFormat("Mono12", 0x01100005, 12, 16),
        PixelFormat("Mono14", 0x01100025, 14, 16),
        PixelFormat("Mono16", 0x01100007, 16, 16),
    )
}
"""Pixel formats that a driver may ask a camera for, by name, packed ones before others with the same number of bits."""
