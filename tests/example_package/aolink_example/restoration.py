"""A restoration method: Richardson and Lucy's iteration, for light that is counted (Richardson 1972, Lucy 1974)."""

import numpy as np
from scipy.signal import fftconvolve

from aolink.restoration import Blurred, Method, Restored


def _restore(picture: Blurred, *, iterations: int = 20) -> Restored:
    values, origin = np.atleast_2d(picture.psf.values), (0, *picture.psf.origin)[-2:]
    reach = max(values.shape)
    kernel = np.zeros((1, 2 * reach + 1, 2 * reach + 1))
    row, column = reach - origin[0], reach - origin[1]
    kernel[0, row : row + values.shape[0], column : column + values.shape[1]] = values
    around = ((0, 0), (reach, reach), (reach, reach))
    image = scene = np.pad(np.maximum(picture.whole, 1e-6), around, mode="edge")
    for _ in range(iterations):
        expected = np.maximum(fftconvolve(scene, kernel, "same", axes=(1, 2)), 1e-9)
        scene = scene * fftconvolve(image / expected, kernel[:, ::-1, ::-1], "same", axes=(1, 2))
    return Restored(image=scene[:, reach:-reach, reach:-reach])


def _why_not(picture: Blurred) -> str | None:
    return "richardson_lucy needs one PSF for the whole picture: use tv" if picture.psf.varies else None


richardson_lucy = Method(name="richardson_lucy", restore=_restore, why_not=_why_not, parameters=("iterations",))
