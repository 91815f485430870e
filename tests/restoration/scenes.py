"""Scenes and blurs for the tests, and the plain sums that the solvers are compared with."""

from __future__ import annotations

import numpy as np
from scipy import signal

from aolink.numerics.arrays import FloatArray

DECAYING = np.exp(-np.arange(12) / 3.0) / np.exp(-np.arange(12) / 3.0).sum()
UNIFORM = np.full(7, 1 / 7)
LOPSIDED = np.array([0.05, 0.5, 0.0, 0.2, 0.25])


def blocks(rows: int, columns: int, seed: int = 0) -> FloatArray:
    """A scene of overlapping rectangles on a slope."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:rows, :columns]
    scene = 0.2 + 0.2 * x / columns
    for _ in range(14):
        top, left = rng.integers(0, rows), rng.integers(0, columns)
        high, wide = rng.integers(2, max(3, rows // 2)), rng.integers(4, max(5, columns // 3))
        scene[(y >= top) & (y < top + high) & (x >= left) & (x < left + wide)] += rng.uniform(-0.4, 0.5)
    return np.asarray(scene)


def blurred(scene: FloatArray, values: FloatArray, origin: tuple[int, ...]) -> tuple[FloatArray, FloatArray]:
    """The picture that a larger scene gives, and the part of the scene that lies in its frame."""
    taps = np.atleast_2d(values)
    down, right = (0, *origin)[-2:]
    image: FloatArray = np.asarray(signal.convolve(scene, taps, mode="valid", method="direct"))
    top, left = taps.shape[0] - 1 - down, taps.shape[1] - 1 - right
    rows, columns = image.shape
    return image, scene[top : top + rows, left : left + columns]


def blur_matrix(shape: tuple[int, int], values: FloatArray) -> FloatArray:
    """All of the blur of a small frame as one dense matrix, by blurring unit scenes."""
    taps = np.atleast_2d(values)
    wide = (shape[0] + taps.shape[0] - 1, shape[1] + taps.shape[1] - 1)
    units = np.eye(wide[0] * wide[1]).reshape(-1, *wide)
    return np.array([signal.convolve2d(u, taps, mode="valid").ravel() for u in units]).T


def roughness_matrix(shape: tuple[int, int]) -> FloatArray:
    """Dx'Dx + Dy'Dy as one dense matrix."""
    index = np.arange(shape[0] * shape[1]).reshape(shape)
    pairs = np.concatenate([
        np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], 1),
        np.stack([index[:-1].ravel(), index[1:].ravel()], 1),
    ])  # fmt: skip
    D = np.zeros((len(pairs), index.size))
    D[np.arange(len(pairs)), pairs[:, 0]], D[np.arange(len(pairs)), pairs[:, 1]] = -1, 1
    return D.T @ D
