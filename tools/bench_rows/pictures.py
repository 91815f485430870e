"""Blurred pictures to restore: scikit-image's own, cut out of larger scenes, by five motions."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from skimage import color, data, transform

from aolink.numerics.arrays import FloatArray
from aolink.optics.sensor import Kernel
from aolink.restoration import Psf, motion_psf
from aolink.restoration.deblur import psnr
from aolink.rig import load_rig
from bench_rows.row import Effort

PICTURES = ("camera", "astronaut", "brick", "coins", "text", "moon", "page")
FRESH = ("chelsea", "coffee", "rocket")
"""Other pictures than those of `PICTURES`."""
NOISE_SD = 0.01
_MARGIN = 44
KERNEL = Kernel(shape="gaussian", sigma=0.3)


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """A blurred picture and its scene."""

    name: str
    image: FloatArray
    scene: FloatArray
    psf: Psf


def _centred(values: FloatArray) -> Psf:
    """The PSF with an odd number of taps about the origin, as the peers expect it."""
    values = np.concatenate([np.zeros(1 - len(values) % 2), values])
    return Psf(values=values, origin=(len(values) // 2,))


def paths() -> dict[str, FloatArray]:
    """Motions over an exposure, 20 pixels wide."""
    t, rig = np.linspace(0, 1, 200), load_rig("section-vi")
    damped = np.exp(-1.5 * t) * np.sin(3 * math.pi * t)
    state, response = np.array([0.0, 1.0]), np.empty(200)
    for k in range(200):
        response[k] = state[0]
        state = rig.plant.A @ state
    return {name: 20 * p / np.ptp(p) for name, p in (("damped sinusoid", damped), ("plant's response", response))}


def psfs() -> dict[str, Psf]:
    """PSFs that are uniform over 9, 15 and 31 pixels, and those of the two paths."""
    moved = {
        name: _centred(np.trim_zeros(motion_psf(path, None, KERNEL, 1.0).values)) for name, path in paths().items()
    }
    return {**{f"uniform {n}": _centred(np.full(n, 1 / n)) for n in (9, 15, 31)}, **moved}


def wide_scene(name: str, size: int = 256) -> FloatArray:
    """A picture ``size`` high, and wider by a margin, grey in [0, 1]."""
    image = getattr(data, name)() / 255.0
    if image.ndim == 3:
        image = color.rgb2gray(image[..., :3])
    rows, columns = image.shape
    scale = max(size / rows, (size + _MARGIN) / columns)
    shape = (math.ceil(rows * scale), math.ceil(columns * scale))
    image = transform.resize(image, shape, anti_aliasing=scale < 1)
    top, left = (shape[0] - size) // 2, (shape[1] - size - _MARGIN) // 2
    return np.asarray(image[top : top + size, left : left + size + _MARGIN])


def blurred(name: str, psf: Psf, size: int = 256, noise_sd: float = NOISE_SD) -> Case:
    """The picture of a scene that continues beyond the frame."""
    scene, (origin,), first = wide_scene(name, size), psf.origin, _MARGIN // 2
    image = np.zeros((size, size))
    for j, tap in enumerate(psf.values):
        start = first + origin - j
        image += tap * scene[:, start : start + size]
    image += noise_sd * np.random.default_rng(0).standard_normal(image.shape)
    return Case(name=name, image=image, scene=scene[:, first : first + size], psf=psf)


def cases(names: tuple[str, ...], effort: Effort) -> Iterator[Case]:
    """Every picture with every PSF; with less effort fewer and smaller ones."""
    motions = list(psfs().values())
    for psf in motions[: effort.of(len(motions))]:
        for name in names[: effort.of(len(names))]:
            yield blurred(name, psf, picture_size(effort))


def picture_size(effort: Effort, whole: int = 256) -> int:
    """Rows of a picture, enough for the widest motion."""
    return effort.of(whole, 96)


@dataclass(frozen=True, kw_only=True)
class Quality:
    """Mean PSNR over pictures, dB: of all pixels, and separately of those more and less than 32 from left and right."""

    whole: float
    inside: float
    border: float

    def __str__(self) -> str:
        return f"{self.whole:.2f} dB ({self.inside:.1f} in, {self.border:.1f} edge)"


def quality(pairs: list[tuple[FloatArray, FloatArray]]) -> Quality:
    """Quality of restored pictures and their scenes."""

    def border(image: FloatArray) -> FloatArray:
        return np.concatenate([image[:, :32], image[:, -32:]], axis=1)

    values = [
        (psnr(found, scene), psnr(found[:, 32:-32], scene[:, 32:-32]), psnr(border(found), border(scene)))
        for found, scene in pairs
    ]
    whole, inside, edge = np.mean(values, axis=0)
    return Quality(whole=float(whole), inside=float(inside), border=float(edge))
