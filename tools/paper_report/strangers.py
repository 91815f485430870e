"""Films as strangers take them, with the motion known: the judge of `aolink look`.

Each seed draws a camera, its flaws, one to four spots and a motion. A fifth of the films violates the model: light that
fades within an exposure, a kernel that is no Gaussian, a gamma curve that is not undone, or rows that are exposed one
after the other.
"""

from __future__ import annotations

import io
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from aolink.films.film import Film, array_film
from aolink.importing.frames import FilmSettings
from aolink.numerics.arrays import FloatArray
from aolink.optics.kernel import pixel_masses

MOTIONS = ("sinusoid", "two lines", "resonance", "random walk", "turbulence", "nothing")
FLAWS = ("fading light", "ring", "gamma", "rolling shutter")
_FINE = 48
"""Instants of an exposure."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stranger:
    """A film and what is true of it."""

    film: Film
    settings: FilmSettings
    motion: str
    flaw: str
    """How it violates the model; empty where it does not."""
    rate_hz: float
    exposure_s: float
    sd: float
    """Standard deviation of the kernel, pixels."""
    hz: tuple[float, ...]
    """Frequencies of the motion's lines."""
    size: float
    """Root mean square of the motion, pixels."""
    path: FloatArray
    """Of the first spot, pixels, (frames, instants, 2)."""
    text: str


def draw(seed: int, frames: int = 200, shape: tuple[int, int] = (120, 160)) -> Stranger:
    """The film of a seed."""
    rng = np.random.default_rng([57, seed])
    rate = float(np.exp(rng.uniform(math.log(10), math.log(200))))
    share = float(rng.uniform(0.1, 1.0))
    exposure = share / rate
    sd, spots = float(rng.uniform(1.0, 3.0)), int(rng.choice([1, 1, 2, 4]))
    motion, size = str(rng.choice(MOTIONS)), float(np.exp(rng.uniform(math.log(0.3), math.log(4.0))))
    flaw = str(rng.choice(FLAWS)) if rng.random() < 0.2 else ""
    angle, hz = (
        float(rng.uniform(0, math.pi)),
        float(np.exp(rng.uniform(math.log(0.05 * rate), math.log(2 / exposure)))),
    )
    times = (np.arange(frames)[:, None] + (np.arange(_FINE) + 0.5) / _FINE * share) / rate
    lines: tuple[float, ...] = ()
    if motion in ("sinusoid", "two lines"):
        lines = (hz,) if motion == "sinusoid" else (hz, hz * float(rng.uniform(0.3, 0.7)))
        along = sum(np.sin(2 * math.pi * each * times + rng.uniform(0, 7)) for each in lines)
        along = np.asarray(along) / math.sqrt(len(lines) / 2)
    elif motion == "resonance":
        lines, along = (hz,), _rung(rng, times, hz, float(np.exp(rng.uniform(math.log(0.002), math.log(0.05)))))
    elif motion == "nothing":
        along = np.zeros_like(times)
    else:
        along = _wandering(rng, times, walk=motion == "random walk")
    shift = size * along[..., None] * [math.cos(angle), math.sin(angle)]
    bits, peak = int(rng.choice([8, 10, 12, 16])), float(rng.uniform(0.3, 0.9))
    middles = _middles(rng, spots, shape, 4 * sd + 3 * size)
    drift = rng.uniform(-1, 1, 2) * (rng.random() < 0.3) * np.linspace(0, 1, frames)[:, None]
    readout = rng.uniform(0.2, 1.0) * (1 / rate - exposure if share < 0.7 else 0.3 / rate) * (flaw == "rolling shutter")
    pictures = np.zeros((frames, *shape))
    for middle in middles:
        seen = shift
        if readout:
            late = readout * middle[1] / shape[0]
            seen = np.stack([np.interp(times + late, times.ravel(), shift[..., d].ravel()) for d in (0, 1)], axis=-1)
        weights = np.linspace(1.5, 0.5, _FINE) if flaw == "fading light" else np.ones(_FINE)
        _add(pictures, middle + drift[:, None] + seen, sd, weights / _FINE)
    if flaw == "ring":
        pictures = 0.75 * pictures + 0.25 * (2 * ndimage.gaussian_filter(pictures, (0, 1.2 * sd, 1.2 * sd)) - pictures)
    pictures /= 1 / (2 * math.pi * (sd**2 + 1 / 12))
    y, x = np.indices(shape) / max(shape)
    ground = rng.uniform(0.02, 0.1) * (1 + rng.uniform(-1, 1) * x + rng.uniform(-1, 1) * y)
    light = peak * pictures + ground
    electrons = float(np.exp(rng.uniform(math.log(2e3), math.log(2e4))))
    light = rng.poisson(np.maximum(light, 0) * electrons) / electrons + rng.normal(
        0, rng.uniform(1e-3, 5e-3), light.shape
    )
    hot = rng.random(shape) < 2e-4 * (rng.random() < 0.5)
    light[:, hot] += rng.uniform(0.3, 0.6)
    webcam = bits == 8 and rng.random() < 0.5
    gamma = 2.2 if webcam or flaw == "gamma" else 1.0
    full = 2**bits - 1
    values = np.rint(np.clip(light, 0, 1) ** (1 / gamma) * full).astype(np.uint8 if bits == 8 else np.uint16)
    compressed = webcam and rng.random() < 0.5
    if compressed:
        values = np.stack([_jpeg(each, int(rng.integers(85, 96))) for each in values])
    settings = FilmSettings(rate_hz=rate, exposure_s=exposure, gamma=1.0 if flaw == "gamma" else gamma)
    lines_said = "".join(f" {each:.4g} Hz" for each in lines)
    text = (
        f"{motion}{lines_said}, {size:.2g} pixels, {spots} spot(s) of {sd:.2g}, {rate:.3g} frames/s of {share:.2f},"
        f" {bits} bits{', gamma' * (gamma != 1)}{', JPEG' * compressed}{f', {flaw}' if flaw else ''}"
    )
    return Stranger(
        film=array_film(values, f"stranger-{seed}"), settings=settings, motion=motion, flaw=flaw, rate_hz=rate,
        exposure_s=exposure, sd=sd, hz=lines, size=size, path=middles[0] + shift, text=text,
    )  # fmt: skip


def _add(pictures: FloatArray, path: FloatArray, sd: float, weights: FloatArray) -> None:
    """Add the light of a spot on a path (frames, instants, 2)."""
    rows, columns = pictures.shape[1:]
    for k, during in enumerate(path):
        x, y = (pixel_masses(sd**2, np.arange(-0.5, size), during[:, d], 0)[0] for d, size in ((0, columns), (1, rows)))
        pictures[k] += (y * weights[:, None]).T @ x


def _middles(rng: np.random.Generator, spots: int, shape: tuple[int, int], margin: float) -> FloatArray:
    """Places far enough from each other and from the edges."""
    rows, columns = shape
    margin = min(margin, 0.22 * min(shape))
    while True:
        found = np.column_stack([rng.uniform(margin, n - margin, spots) for n in (columns, rows)])
        apart = np.linalg.norm(found[:, None] - found, axis=2) + 1e9 * np.eye(spots)
        if apart.min() > 1.6 * margin:
            return found


def _rung(rng: np.random.Generator, times: FloatArray, hz: float, damping: float) -> FloatArray:
    """A resonance driven by white noise, of standard deviation one, at times in order."""
    at = times.ravel()
    decay, kicks = np.exp(-2 * math.pi * hz * damping * np.diff(at)), rng.normal(size=(len(at), 2)) @ [1, 1j]
    z = np.empty(len(at), dtype=np.complex128)
    z[0] = kicks[0]
    for k, keep in enumerate(decay):
        z[k + 1] = z[k] * keep + kicks[k + 1] * math.sqrt(1 - keep**2)
    return np.asarray((z * np.exp(2j * math.pi * hz * at)).real.reshape(times.shape))


def _wandering(rng: np.random.Generator, times: FloatArray, *, walk: bool) -> FloatArray:
    """A random walk, or an Ornstein-Uhlenbeck process that forgets in some frames, of standard deviation about one."""
    at = times.ravel()
    period = times[1, 0] - times[0, 0]
    forgets = period * (1e6 if walk else float(np.exp(rng.uniform(math.log(0.5), math.log(10)))))
    keep, kicks = np.exp(-np.diff(at) / forgets), rng.normal(size=len(at))
    x = np.empty(len(at))
    x[0] = 0.0 if walk else kicks[0]
    for k, each in enumerate(keep):
        x[k + 1] = x[k] * each + kicks[k + 1] * math.sqrt(max(1 - each**2, 0.0))
    if walk:
        x = np.concatenate([[0.0], np.cumsum(kicks[1:] * np.sqrt(np.diff(at)))])
        x /= x.std()
    return np.asarray(x.reshape(times.shape))


def _jpeg(values: Any, quality: int) -> Any:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(values).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file))
