"""Pixel formats: bytes as the Pixel Format Naming Convention lays them down become counts."""

from __future__ import annotations

from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.devices.cameras.pixel_formats import PIXEL_FORMATS


@pytest.mark.parametrize(
    ("name", "data", "counts"),
    [
        ("Mono8", "00 7f ff", [0x00, 0x7F, 0xFF]),
        ("Mono10", "01 00 ff 03", [0x001, 0x3FF]),
        ("Mono12", "bc 0a 23 01", [0xABC, 0x123]),
        ("Mono16", "34 12 ff ff", [0x1234, 0xFFFF]),
        # By hand: the first count's low bits come first, each next one begins where the one before ended.
        ("Mono12p", "bc 3a 12", [0xABC, 0x123]),
        ("Mono12p", "bc 3a 12 f0 0f", [0xABC, 0x123, 0xFF0]),
        ("Mono10p", "01 08 30 c0 ff", [0x001, 0x002, 0x003, 0x3FF]),
        ("Mono10p", "ff 03 f0 3f 00", [0x3FF, 0x000, 0x3FF, 0x000]),
    ],
)
def test_counts_of_bytes(name: str, data: str, counts: list[int]) -> None:
    read = PIXEL_FORMATS[name].counts(np.frombuffer(bytes.fromhex(data), np.uint8), (1, len(counts)))
    assert read.dtype == np.uint16
    assert read.tolist() == [counts]


@given(st.sampled_from(["Mono10p", "Mono12p"]), st.integers(1, 5), st.integers(1, 7), st.randoms(use_true_random=False))
def test_packed_counts_are_one_long_binary_number(name: str, rows: int, columns: int, random: Random) -> None:
    """The lowest bit first: pixel k stands at bit k times its bits, in a picture of any size."""
    pixel_format = PIXEL_FORMATS[name]
    counts = [random.getrandbits(pixel_format.bits) for _ in range(rows * columns)]
    number = sum(count << k * pixel_format.bits for k, count in enumerate(counts))
    size = pixel_format.size(len(counts))
    data = np.frombuffer(number.to_bytes(size, "little"), np.uint8)
    assert pixel_format.counts(data, (rows, columns)).ravel().tolist() == counts
    for k in range(size):  # a byte that is missing makes those pixels incomplete that have a bit in it
        arrived = np.arange(size) != k
        first, last = 8 * k // pixel_format.bits, min((8 * k + 7) // pixel_format.bits, len(counts) - 1)
        missing = np.flatnonzero(~pixel_format.whole(arrived, (rows, columns)).ravel())
        assert missing.tolist() == [*range(first, last + 1)]


def test_counts_of_two_bytes_are_not_copied() -> None:
    data = np.arange(8, dtype=np.uint8)
    assert np.shares_memory(PIXEL_FORMATS["Mono16"].counts(data, (2, 2)), data)
