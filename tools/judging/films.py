"""Films of spots whose motion is known: with a given motion, or as strangers take them, drawn by seed."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from aolink.films.film import Film, array_film
from aolink.importing.frames import FilmSettings
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
    path = middles + motion
    frames = np.empty((len(path), *shape), dtype=np.uint16)
    for k, during in enumerate(path):
        picture = ground + light * sum(_spot(shape, during[:, each], (sd, sd)) for each in range(len(middles)))
        frames[k] = np.clip(np.rint(picture + noise * rng.normal(size=shape)), 0, 65535)
    return SpotFilm(frames, path.mean(axis=1))


def _spot(
    shape: tuple[int, int], during: FloatArray, sd: tuple[float, float], weights: FloatArray | None = None
) -> FloatArray:
    """The light, one in all, of a Gaussian spot, sd along x and y, on a path (instants, 2)."""
    x, y = (
        pixel_masses(sd[d] ** 2, np.arange(-0.5, shape[1 - d]), np.ascontiguousarray(during[:, d]), 0)[0]
        for d in (0, 1)
    )
    weights = np.ones(len(during)) if weights is None else weights
    return np.asarray((y * weights[:, None] / weights.sum()).T @ x)


MOTIONS = (
    "sinusoid", "ellipse", "two lines", "growing", "square wave", "resonance", "multiple of the rate", "two spots",
    "random walk", "still",
)  # fmt: skip
FLAWS = ("", "", "", "", "fading light", "gamma", "rolling shutter", "saturated", "elliptical kernel", "Airy kernel")
"""Six in ten films have one: what the model of `aolink look` has not."""
_FINE = 48
"""Instants of an exposure."""
_NARROW = 0.5
"""Sd of the spot that an Airy pattern is laid over, pixels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stranger:
    """A film and what is true of it."""

    film: Film
    settings: FilmSettings
    motion: str
    flaw: str
    sd: float
    """Standard deviation of the kernel, pixels: the smaller one of an ellipse, of the Gaussian of an Airy pattern's
    width at half its height."""
    hz: tuple[float, ...]
    """Frequencies of the motion's lines."""
    size: float
    """Root mean square of the motion, pixels."""
    path: FloatArray
    """Of the first spot, pixels, (frames, instants, 2)."""
    text: str


def draw(seed: int, frames: int = 200, shape: tuple[int, int] = (120, 160), motion: str = "") -> Stranger:
    """The film of a seed; motions take turns from seed to seed where none is asked for."""
    rng = np.random.default_rng([57, seed])
    motion, flaw = motion or MOTIONS[seed % len(MOTIONS)], str(rng.choice(FLAWS))

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    rate, share = between(10, 200), float(rng.uniform(0.1, 1.0))
    exposure, sd, size = share / rate, float(rng.uniform(1.0, 3.0)), between(0.3, 4.0)
    spots = 2 if motion == "two spots" else int(rng.choice([1, 1, 2, 4]))
    hz = between(0.05 * rate, 2 / exposure)
    if motion == "multiple of the rate":
        hz = rate * max(1, round(hz / rate))
    times = (np.arange(frames)[:, None] + (np.arange(_FINE) + 0.5) / _FINE * share) / rate
    lines = () if motion in ("random walk", "still") else (hz, hz * between(0.3, 0.7))[: 1 + (motion == "two lines")]
    shifts = [size * _motion(rng, motion, times, lines)]
    shifts += [size * _motion(rng, motion, times, lines) if motion == "two spots" else shifts[0]] * (spots - 1)
    drift = rng.uniform(-1, 1, 2) * (rng.random() < 0.3) * np.linspace(0, 1, frames)[:, None, None]
    middles = _middles(rng, spots, shape, 4 * sd + 3 * size)
    readout = rng.uniform(0.2, 1.0) * (1 / rate - exposure if share < 0.7 else 0.3 / rate) * (flaw == "rolling shutter")
    widths = {"elliptical kernel": (sd, 1.5 * sd), "Airy kernel": (_NARROW, _NARROW)}.get(flaw, (sd, sd))
    weights = np.linspace(1.5, 0.5, _FINE) if flaw == "fading light" else np.ones(_FINE)
    pictures = np.zeros((frames, *shape))
    for middle, shift in zip(middles, shifts, strict=True):
        late = times + readout * middle[1] / shape[0]
        seen = np.stack([np.interp(late, times.ravel(), shift[..., d].ravel()) for d in (0, 1)], axis=-1)
        for picture, during in zip(pictures, middle + drift + seen, strict=True):
            picture += _spot(shape, during, widths, weights)
    if flaw == "Airy kernel":
        pictures = np.array([ndimage.convolve(each, _airy(sd), mode="constant") for each in pictures])
    y, x = np.indices(shape) / max(shape)
    ground = rng.uniform(0.02, 0.1) * (1 + rng.uniform(-1, 1) * x + rng.uniform(-1, 1) * y)
    peak = float(rng.uniform(1.2, 2.0) if flaw == "saturated" else rng.uniform(0.3, 0.9))
    light = peak * pictures * 2 * math.pi * (sd**2 + 1 / 12) + ground
    electrons = between(2e3, 2e4)
    light = rng.poisson(np.maximum(light, 0) * electrons) / electrons
    light += rng.normal(0, rng.uniform(1e-3, 5e-3), light.shape)
    light[:, rng.random(shape) < 2e-4 * (rng.random() < 0.5)] += 0.5  # hot pixels
    bits = int(rng.choice([8, 8, 12, 16]))
    webcam, compressed = bits == 8 and rng.random() < 0.5, rng.random() < 0.5
    gamma = 2.2 if webcam or flaw == "gamma" else 1.0
    values = np.rint(np.clip(light, 0, 1) ** (1 / gamma) * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    if webcam and compressed:
        values = np.stack([_jpeg(each, int(rng.integers(85, 96))) for each in values])
    said = [
        motion, *(f"{each:.4g} Hz" for each in lines), f"{size:.2g} pixels", f"{spots} spot(s) of {sd:.2g}",
        f"{rate:.3g} frames/s of {share:.2f}", f"{bits} bits", *(["JPEG"] if webcam and compressed else []), flaw,
    ]  # fmt: skip
    settings = FilmSettings(rate_hz=rate, exposure_s=exposure, gamma=1.0 if flaw == "gamma" else gamma)
    return Stranger(
        film=array_film(values, f"stranger-{seed}"), settings=settings, motion=motion, flaw=flaw, sd=sd, hz=lines,
        size=size, path=middles[0] + drift + shifts[0], text=", ".join(filter(None, said)),
    )  # fmt: skip


def _motion(rng: np.random.Generator, motion: str, times: FloatArray, lines: tuple[float, ...]) -> FloatArray:
    """A motion of rms one at instants in order, (frames, instants, 2): along a line aslant, or in an ellipse."""
    angle, at = rng.uniform(0, math.pi), times.ravel()
    along, across = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    keep, kicks = np.diff(at), rng.normal(size=(len(at), 2)) @ [1, 1j]
    if motion == "random walk":
        one = np.concatenate([[0.0], np.cumsum(kicks[1:].real * np.sqrt(keep))])
        one /= one.std()
    elif motion == "resonance":
        decay, z = np.exp(-2 * math.pi * lines[0] * rng.uniform(0.002, 0.05) * keep), kicks.copy()
        for k, each in enumerate(decay):
            z[k + 1] = z[k] * each + kicks[k + 1] * math.sqrt(1 - each**2)
        one = (z * np.exp(2j * math.pi * lines[0] * at)).real
    else:
        waves = [np.sin(2 * math.pi * each * at + rng.uniform(0, 7)) for each in lines]
        one = np.sum(waves, axis=0) * math.sqrt(2 / max(len(lines), 1)) * np.ones_like(at)
        if motion == "growing":
            one *= math.sqrt(3) * at / at[-1]
        elif motion == "square wave":
            one = np.sign(one)
    moved = one[:, None] * along
    if motion == "ellipse":
        turned = math.sqrt(2) * np.sin(2 * math.pi * lines[0] * at + rng.uniform(0, 7))
        moved = (moved + rng.uniform(0.2, 1.0) * turned[:, None] * across) / math.sqrt(2)
    return np.asarray(moved.reshape(*times.shape, 2))


def _airy(sd: float) -> FloatArray:
    """An Airy pattern, one in all, as wide at half its height as a Gaussian of this sd."""
    reach = math.ceil(8 * sd)
    y, x = np.indices((2 * reach + 1, 2 * reach + 1)) - reach
    rho = 1.3721 * np.hypot(x, y) / sd + 1e-9  # half height is at 1.6163, that of a Gaussian at 1.1774
    pattern = (2 * special.j1(rho) / rho) ** 2
    return np.asarray(pattern / pattern.sum())


def _middles(rng: np.random.Generator, spots: int, shape: tuple[int, int], margin: float) -> FloatArray:
    """Places far enough from each other and from the edges."""
    rows, columns = shape
    margin = min(margin, 0.22 * min(shape))
    while True:
        found = np.column_stack([rng.uniform(margin, n - margin, spots) for n in (columns, rows)])
        apart = np.linalg.norm(found[:, None] - found, axis=2) + 1e9 * np.eye(spots)
        if apart.min() > 1.6 * margin:
            return found


def _jpeg(values: Any, quality: int) -> Any:
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(values).save(file, "JPEG", quality=quality)
    return np.asarray(Image.open(file))


@dataclass(frozen=True, kw_only=True, eq=False)
class RowFilm:
    """A line or an edge, seen in all rows of a camera that exposes them one after the other."""

    kind: str
    """A line of light, or an edge."""
    hz: tuple[float, ...]
    amplitudes: tuple[complex, ...]
    """Of each tone, pixels across the rows: its real part is the place at the film's begin."""
    row_time_s: float
    exposure_s: float
    rest: FloatArray
    """Place at rest of each row, pixels, (rows,)."""
    sd: float
    """Of the Gaussian that the line is, or that the edge is blurred by, pixels."""
    noise: float
    """Of a pixel, over the line's peak or the edge's step."""
    columns: int
    frames: int
    rate_hz: float = 30.0
    light: FloatArray = field(default_factory=lambda: np.ones(1))
    """Of each row, (rows,) or (1,)."""

    def clean(self) -> FloatArray:
        """The frames without noise, (frames, rows, columns)."""
        rest = self.rest
        nodes, weights = np.polynomial.legendre.leggauss(10 + 6 * math.ceil(max(self.hz) * self.exposure_s))
        inside = (nodes + 1) / 2 * self.exposure_s
        first = np.floor(rest).astype(int) - _NEAR_LINE
        edges = np.arange(2 * _NEAR_LINE + 2) - 0.5 - (rest - first)[:, None]
        out = np.zeros((self.frames, len(rest), self.columns))
        y = np.arange(len(rest))[:, None]
        if self.kind == "edge":
            out += np.arange(self.columns) > rest[:, None]
        for k, picture in enumerate(out):
            t = k / self.rate_hz + (self.row_time_s * np.arange(len(rest)))[:, None] + inside
            p = sum((a * np.exp(2j * np.pi * f * t)).real for a, f in zip(self.amplitudes, self.hz, strict=True))
            u = (edges[..., None] - np.asarray(p)[:, None]) / self.sd
            whole = special.ndtr(u) if self.kind == "line" else u * special.ndtr(u) + np.exp(-(u**2) / 2) / _ROOT
            seen = np.diff(whole @ weights / 2, axis=1) * self.sd * (_ROOT if self.kind == "line" else 1.0)
            picture[y, first[:, None] + np.arange(seen.shape[1])] = seen
        return out * np.broadcast_to(self.light, len(rest))[:, None]

    def film(self, rng: np.random.Generator) -> Film:
        """With noise, in 8 bits."""
        clean = self.clean()
        values = 30 + 170 * (clean + self.noise * rng.normal(size=clean.shape))
        return array_film(np.clip(np.rint(values), 0, 255).astype(np.uint8), self.kind)

    @property
    def settings(self) -> FilmSettings:
        """What a stranger says of it."""
        return FilmSettings(rate_hz=self.rate_hz, exposure_s=self.exposure_s, row_time_s=self.row_time_s)


_NEAR_LINE, _ROOT = 20, math.sqrt(2 * math.pi)
"""Pixels to either side of a target that its motion may light."""


def draw_rows(
    seed: int, *, hz: Sequence[float] = (), seen: float | None = None, rows: int = 480, frames: int = 90
) -> RowFilm:
    """The film of a seed: 30 frames/s, readout of 8 to 30 ms, exposures of .5 to 10 ms, a tone of 200 to 1100 Hz of
    which the exposure leaves .1 to 1 pixel, ``seen``, of at most 4; the peak is 20 times the pixels' noise."""
    rng = np.random.default_rng([71, seed])
    readout, kind = float(rng.uniform(8e-3, 30e-3)), str(rng.choice(["line", "edge"]))
    while True:
        exposure = float(np.exp(rng.uniform(math.log(0.5e-3), math.log(10e-3))))
        tones = tuple(hz) or (float(rng.uniform(200, 1100)),)
        sizes = [(seen or float(np.exp(rng.uniform(math.log(0.1), 0)))) for _ in tones]
        sizes = [size / max(abs(float(np.sinc(f * exposure))), 1e-9) for size, f in zip(sizes, tones, strict=True)]
        if max(sizes) <= 4:
            break
    along = np.linspace(-1, 1, rows)
    rest = 40 + rng.uniform(-8, 8) * along + rng.uniform(-2, 2) * along**2
    return RowFilm(
        kind=kind, hz=tones, amplitudes=tuple(s * np.exp(1j * rng.uniform(0, 7)) for s in sizes),
        row_time_s=readout / rows, exposure_s=exposure, rest=rest, sd=float(rng.uniform(1.0, 2.5)), noise=0.05,
        columns=80, frames=frames, light=1 + rng.uniform(-0.2, 0.2) * along,
    )  # fmt: skip
