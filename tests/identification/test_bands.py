"""Vibrations from bands of rows: images of a known profile, moved by sums over many instants, with noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aolink.identification.bands import Bands, BandsFound, find
from aolink.numerics.arrays import FloatArray

FINE, NOISE = 400, 0.02


def seen(
    *tones: tuple[float, complex], exposure: float = 1e-3, readout: float = 0.02, frames: int = 40, seed: int = 0,
    bend: FloatArray | float = 0.0, leaning: float = 2.0, sd: float = 1.6,
) -> Bands:  # fmt: skip
    """A Gaussian line in 60 bands of two rows, at 30 frames/s."""
    rng = np.random.default_rng(seed)
    delays = np.arange(120).reshape(60, 2) * readout / 120
    rest = 15.3 + leaning * np.linspace(-1, 1, 120).reshape(60, 2) + np.reshape(bend, (-1, 1))
    times = np.arange(frames) / 30
    inside = ((np.arange(FINE) + 0.5) / FINE - 0.5) * exposure
    images = np.empty((frames, 60, 32))
    for k, t in enumerate(times):
        at = t + delays[..., None] + inside
        p = np.sum([(a * np.exp(2j * np.pi * hz * at)).real for hz, a in tones], axis=0) + rest[..., None]
        images[k] = np.exp(-((np.arange(32) - p[..., None]) ** 2) / (2 * sd**2)).mean(axis=(1, 2))
    images = 5 + 3 * (images + NOISE * rng.normal(size=images.shape))
    straight = rest - np.reshape(bend, (-1, 1))
    return Bands(images=images, rest=straight + 0.3, times_s=times, delays_s=delays, exposure_s=exposure, rate_hz=30.0)


def amplitude_of(found: BandsFound, number: int = 0) -> complex:
    """At time zero."""
    a, hz = found.tones[number]
    return complex(a * np.exp(-2j * np.pi * hz * found.times_s.mean()))


@pytest.mark.slow
@pytest.mark.parametrize(("hz", "a", "exposure"), [(431.7, 0.3 - 0.1j, 1e-3), (613.0, 2.5j, 4.1e-3), (12.3, 0.2, 1e-3)])
def test_a_line_is_found_in_its_alias_and_with_its_size(hz: float, a: complex, exposure: float) -> None:
    found = find(seen((hz, a), exposure=exposure))
    ((_, best),), ((part, *others),) = found.tones, found.sets
    assert not others
    assert best == pytest.approx(hz, abs=0.01)
    assert part.low < hz < part.high
    assert part.high - part.low < 0.02
    assert abs(amplitude_of(found) - a) < 0.02 * abs(a)
    assert found.misfit == pytest.approx(1, abs=0.1)
    assert not found.bent


@pytest.mark.slow
def test_a_motion_that_hides_the_profile_is_found_with_its_size() -> None:
    found = find(seen((467.84, 3.1j), exposure=8.04e-3, readout=0.0098, frames=60, sd=1.0))
    ((_, hz),) = found.tones
    assert hz == pytest.approx(467.84, abs=0.01)
    assert abs(amplitude_of(found) - 3.1j) < 0.06


@pytest.mark.slow
def test_a_target_that_meets_all_rows_of_pixels_alike_is_measured() -> None:
    found = find(replace(seen((431.7, 0.3), leaning=0.0), rest=np.full((60, 2), 15.0)))
    ((a, hz),) = found.tones
    assert hz == pytest.approx(431.7, abs=0.01)
    assert abs(a) == pytest.approx(0.3, rel=0.03)


@pytest.mark.slow
def test_two_lines_are_found_beside_each_other() -> None:
    found = find(seen((431.7, 0.5), (702.0, 0.3j)))
    assert [hz for _, hz in found.tones] == pytest.approx([431.7, 702.0], abs=0.01)
    assert abs(amplitude_of(found, 1) - 0.3j) < 0.01


@pytest.mark.slow
def test_a_multiple_of_the_frame_rate_is_seen_in_a_straight_target_only() -> None:
    found = find(seen((600.0, 0.3)))
    assert [hz for _, hz in found.tones] == pytest.approx([600.0], abs=0.02)
    rough = 0.3 * np.random.default_rng(3).normal(size=60)
    found = find(seen((600.0, 0.3), bend=rough))
    assert found.bent
    assert not found.tones


@pytest.mark.slow
def test_a_bent_target_shows_other_lines_all_the_same() -> None:
    rough = 0.3 * np.random.default_rng(3).normal(size=60)
    found = find(seen((431.7, 0.3), bend=rough))
    assert found.bent
    ((a, hz),) = found.tones
    assert hz == pytest.approx(431.7, abs=0.01)
    assert abs(a) == pytest.approx(0.3, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("tones", [((1000.0, 1.0 + 0j),), ((431.7, 0j),)], ids=["whole swings", "still"])
def test_where_nothing_tells_no_line_is_found(tones: tuple[tuple[float, complex], ...]) -> None:
    assert not find(seen(*tones)).tones
