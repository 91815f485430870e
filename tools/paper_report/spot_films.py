"""Films of Gaussian spots with a given motion, so that everything about them is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aolink.numerics.arrays import FloatArray
from aolink.optics.kernel import pixel_masses


@dataclass(frozen=True, eq=False)
class SpotFilm:
    """Frames and their true motion."""

    frames: NDArray[np.uint16]
    """(frames, rows, columns)"""
    places: FloatArray
    """Mean place of each spot in each frame, (frames, spots, 2) as (x, y), pixels."""


def random_walk(rng: np.random.Generator, frames: int, spots: int, step: float, fine: int = 8) -> FloatArray:
    """Places about zero at ``fine`` times in each frame, (frames, fine, spots, 2); ``step`` is the rms of one frame."""
    steps = rng.normal(size=(frames * fine, spots, 2)) * step / np.sqrt(fine)
    return np.asarray(np.cumsum(steps, axis=0).reshape(frames, fine, spots, 2))


def resonance(
    rng: np.random.Generator, frames: int, spots: int, rms: float, period: float, lasts: float = 50.0, fine: int = 8
) -> FloatArray:
    """A vibration with a period in frames, whose amplitude decays to 1/e after ``lasts`` periods; shapes are as of
    `random_walk`."""
    a = np.exp((-1 / lasts + 2j * np.pi) / (period * fine))
    x = np.zeros((frames * fine, spots, 2), dtype=np.complex128)
    state = rms * (rng.normal(size=(spots, 2)) + 1j * rng.normal(size=(spots, 2)))
    kick = rms * np.sqrt(1 - abs(a) ** 2)
    for k in range(len(x)):
        state = a * state + kick * (rng.normal(size=(spots, 2)) + 1j * rng.normal(size=(spots, 2)))
        x[k] = state
    return np.asarray(x.real.reshape(frames, fine, spots, 2))


def spot_film(
    rng: np.random.Generator, motion: FloatArray, middles: FloatArray, shape: tuple[int, int] = (64, 96), *,
    sd: float = 1.8, light: float = 20_000.0, noise: float = 20.0, ground: float = 1000.0,
) -> SpotFilm:  # fmt: skip
    """A film of spots that move about their middles (spots, 2), each frame exposed throughout."""
    rows, columns = shape
    path = middles + motion
    frames = np.empty((len(path), rows, columns), dtype=np.uint16)
    for k, during in enumerate(path):
        picture = np.full(shape, ground)
        for places in during:
            x, y = (
                pixel_masses(sd**2, np.arange(-0.5, size), places[:, d], 0)[0] for d, size in ((0, columns), (1, rows))
            )
            picture += light / len(during) * (y.T @ x)
        frames[k] = np.clip(np.rint(picture + noise * rng.normal(size=shape)), 0, 65535)
    return SpotFilm(frames, path.mean(axis=1))
