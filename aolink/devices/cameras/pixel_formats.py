"""Pixel formats of GenICam's Pixel Format Naming Convention (PFNC) with one value for each pixel: bytes to counts."""

from __future__ import annotations

import math
from dataclasses import dataclass

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

    def size(self, n_pixels: int) -> int:
        """Bytes that a number of pixels takes."""
        return -(-n_pixels * self.stored_bits // 8)

    def counts(self, data: NDArray[np.uint8], shape: tuple[int, int]) -> NDArray[np.uint16]:
        """Counts (rows, columns) from bytes: a view of ``data`` where each takes two bytes, otherwise a new array."""
        n_pixels = shape[0] * shape[1]
        data = data[: self.size(n_pixels)]
        if self.stored_bits in (8, 16):
            return data.view(f"<u{self.stored_bits // 8}").astype(np.uint16, copy=False).reshape(shape)
        # The fewest counts that fill whole bytes; each of 10 or 12 bits lies in two bytes.
        group = 8 // math.gcd(self.bits, 8)
        padded = np.zeros((-(-n_pixels // group), group * self.bits // 8), dtype=np.uint16)
        padded.ravel()[: len(data)] = data
        counts = np.empty((len(padded), group), dtype=np.uint16)
        for k in range(group):
            byte, shift = divmod(k * self.bits, 8)
            counts[:, k] = (padded[:, byte] | padded[:, byte + 1] << 8) >> shift & (1 << self.bits) - 1
        return counts.ravel()[:n_pixels].reshape(shape)

    def whole(self, arrived: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
        """Mask (rows, columns) of the pixels whose bytes have all ``arrived``, which has one element for each byte."""
        bits = np.repeat(arrived, 8)[: shape[0] * shape[1] * self.stored_bits]
        return np.asarray(bits.reshape(*shape, self.stored_bits).all(axis=2))


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
