"""Spots of a film that may be blurred by their motion: where they are, their kernel, light and noise.

A blurred spot is the kernel moved along the path: the image of a density of places that is nowhere negative. So the
kernel is found without knowing the motion. A narrower kernel than the true one still explains every frame, with other
densities; a wider one leaves residuals, at the steep sides of the blur. The widest that explains the frames as well as
narrow ones is the kernel. Where frames are sharp, that is the width of the spot itself; where the motion is along one
direction, the width across it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import islice

import numpy as np
from scipy import ndimage, optimize

from aolink.errors import ImportingError
from aolink.films.film import Film
from aolink.importing.brightness import brightness_of
from aolink.importing.defects import find_defects
from aolink.importing.frames import FilmLight, FilmSettings
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray
from aolink.optics.kernel import pixel_masses

MOST_SPOTS = 4
_SHOWING = 150
"""Frames, at equal distances, whose brightest values show where each spot goes."""
_SMOOTH = 1.5
"""Standard deviation of the Gaussian that these frames are smoothed by, pixels."""
_SIGNIFICANT = 8.0
"""A spot is this many standard deviations of a smoothed frame's noise above the ground, ..."""
_FAINTEST = 0.2
"""... and has this share of the brightest one's height; it goes where it has half of the latter."""
_SHARPEST = 0.8
"""Smallest standard deviation of a spot, pixels: sharper light is a hot pixel."""
_REACH = 4.0
"""Standard deviations of the kernel beyond the path that belong to a window."""
_LARGEST = 128
"""Most pixels along a side of a window."""
_SMALLEST = 12
_KERNEL_FRAMES = 100
"""Frames that decide on the kernel."""
_WIDTHS = 1.02 ** np.arange(-40, 92)
"""Standard deviations of the kernels that are tried, pixels: .45 to 6."""
_FINE = 3
"""Places in a pixel at which a density may be: with one, a sharp spot between two pixels looks wider than it is."""
_NARROWER, _WORSE, _SHARE, _SURE = 8, 1.0, 0.1, 2.5
"""A kernel is too wide where the squares of a profile's residuals exceed those with one so many steps narrower by so
many squares of the noise, and by so many standard deviations of chance. The first too wide is looked for with a rise by
such a share, since they rise a little with every width where the noise is larger than it is taken for."""
_BRIGHT, _SHOT, _FEWEST_PIXELS = 0.3, 0.3, 100
"""Shot noise is looked for in pixels of profiles with this share of the brightest one's light; the share of the dark
noise's variance that shows; and how many such pixels are enough."""
_NOISIEST, _TURNS, _SETTLED = 0.05, 6, 0.1
"""Shot noise of the brightest pixel, over its light, from which turns begin in which kernel and shot noise are found;
how many there are at most, and the change of the latter that ends them."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Spots:
    """What the first frames of a film show of its spots; places are (x, y), pixels of the film."""

    light: FloatArray
    """Light above the ground in each spot's window, over the spot's light, (frames, n, side, side); NaN where a pixel
    cannot be used, zero where it is nearer to another spot or beyond the picture."""
    corners: IntArray
    """First pixel of each window, (n, 2)."""
    sd: float
    """Standard deviation of the kernel, pixels; infinite where every kernel explains the frames."""
    noise: float
    """Standard deviation of a dark pixel's noise, over a spot's light."""
    electrons: float
    """Photoelectrons of a spot; zero where shot noise does not show."""
    mean: FloatArray
    """Mean picture, (rows, columns)."""
    saturated: float
    """Share of the pixels in the windows that are saturated or hot."""
    left_out: int
    """Number of fainter spots."""
    at_edge: bool
    """Whether a spot reaches the edge of the picture."""


def find_spots(
    film: Film, settings: FilmSettings, frames: int, progress: Callable[[int], None] = lambda done: None
) -> Spots:
    """Find up to four bright spots in the first ``frames`` of a film and measure them.

    Raises `ImportingError` where there is none, or one goes so far that it does not fit into a window of 128 pixels.
    """
    count = min(frames, film.count)
    light = FilmLight(film, settings)
    defects = find_defects(film, light, _SHARPEST)
    light = FilmLight(film, settings, defects)
    brightest, mean, noise = _seen(film, light, count, progress)
    boxes, left_out = _boxes(film, brightest, noise)
    side = max(_SMALLEST, *(2 * math.ceil(half) for _, half in boxes))
    if side > _LARGEST:
        raise ImportingError(
            f"{film.name}: a spot goes over {side} pixels, {_LARGEST} at most can be looked at: take a part of the film"
        )
    middles = np.array([middle for middle, _ in boxes])
    corners = np.rint(middles - (side - 1) / 2).astype(np.int64)
    windows, bad, outside = _windows(film, light, defects, count, corners, side, lambda done: progress(count + done))
    others = _nearer_to_others(corners, side, middles) | outside
    windows[:, others] = np.nan
    windows -= _ground(windows)
    amounts = np.nansum(windows, axis=(2, 3))
    windows /= brightness_of(np.maximum(amounts, 0.0))[:, None, None, None]
    usual = np.median(np.nansum(windows, axis=(2, 3)), axis=0)
    if (usual <= 0).any():
        raise ImportingError(f"{film.name}: the light of a spot is not above the ground about it")
    windows /= usual[:, None, None]
    windows[:, others] = 0.0  # as dark as the ground, so that sums over the window can be used
    noise /= float(usual.mean())
    profiles = [np.nansum(windows, axis=axis) for axis in (2, 3)]  # along x, along y
    sd, electrons = _kernel_and_electrons(profiles, noise * math.sqrt(side))
    rows, columns = film.shape
    ends = corners + side
    return Spots(
        light=windows, corners=corners, sd=sd, noise=noise,
        electrons=electrons, mean=mean, saturated=float(bad.mean()), left_out=left_out,
        at_edge=bool((corners < 0).any() or (ends > (columns, rows)).any()),
    )  # fmt: skip


def _seen(
    film: Film, light: FilmLight, count: int, progress: Callable[[int], None]
) -> tuple[FloatArray, FloatArray, float]:
    """The brightest value of each pixel in smoothed frames, the mean frame, both (rows, columns) without their ground,
    and the noise of a pixel."""
    every, differences = max(1, count // _SHOWING), list[float]()
    brightest = total = last = None
    for k, frame in enumerate(islice(film.frames(), count)):
        progress(k)
        shown, _ = light.of(frame)
        if k % every == 0:
            smooth = ndimage.gaussian_filter(shown, _SMOOTH)
            brightest = smooth if brightest is None else np.maximum(brightest, smooth)
        if last is not None and k % every == 1 % every:
            differences.append(float(np.median(np.abs(shown - last))) / (0.6745 * math.sqrt(2)))
        total = shown if total is None else total + shown
        last = shown
    if brightest is None or total is None or not differences:
        raise ImportingError(f"{film.name} has {film.count} frame(s): two or more are needed to see motion")
    mean = total / count
    ground = ndimage.median_filter(mean[::4, ::4], 15, mode="nearest")
    zoom = np.array(mean.shape) / np.array(ground.shape)
    ground = ndimage.zoom(ground, zoom, order=1, mode="nearest", grid_mode=True)
    # Numbers of few bits hide the noise of a dark ground.
    return brightest - ground, mean - ground, max(float(np.median(differences)), light.step / math.sqrt(12))


def _boxes(film: Film, brightest: FloatArray, noise: float) -> tuple[list[tuple[FloatArray, float]], int]:
    """The middle (x, y) of the area that each spot goes over, and half of the window that it needs, the brightest spot
    first; and how many fainter spots there are."""
    smoothed = noise / (2 * math.sqrt(math.pi) * _SMOOTH)
    ground = float(np.median(brightest))
    height = float(brightest.max()) - ground
    if not height > _SIGNIFICANT * smoothed:
        raise ImportingError(
            f"{film.name} shows no spot: nothing is {_SIGNIFICANT:g} times as bright as the noise; is it darker than"
            " the ground? then add --film invert"
        )
    least = ground + max(_SIGNIFICANT * smoothed, _FAINTEST * height / 2)
    labels, _ = ndimage.label(brightest > least, structure=np.ones((3, 3)))
    found = []
    for number, area in enumerate(ndimage.find_objects(labels), 1):
        assert area is not None  # each number has its pixels
        own = labels[area] == number
        top = float(brightest[area][own].max()) - ground
        if top > _FAINTEST * height:
            size = np.array([area[1].stop - area[1].start, area[0].stop - area[0].start])
            start = np.array([area[1].start, area[0].start])
            # Across the motion a spot is as wide as its kernel, smoothed.
            across, reach = float(size.min()) / 2, math.sqrt(2 * math.log(top / (least - ground)))
            sd = math.sqrt(max((across / reach) ** 2 - _SMOOTH**2, 1.0))
            margin = max(2.0, _REACH * sd - across)
            found.append((top, start + (size - 1) / 2, float(size.max()) / 2 + margin))
    found.sort(key=lambda each: -each[0])
    return [(middle, half) for _, middle, half in found[:MOST_SPOTS]], max(0, len(found) - MOST_SPOTS)


def _windows(
    film: Film,
    light: FilmLight,
    defects: BoolArray,
    count: int,
    corners: IntArray,
    side: int,
    progress: Callable[[int], None],
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """The light in the windows, NaN where it cannot be used, and where it is saturated or hot, (frames, n, side, side)
    each; where windows go beyond the picture, (n, side, side)."""
    windows = np.empty((count, len(corners), side, side))
    bad = np.zeros(windows.shape, dtype=np.bool_)
    rows, columns = film.shape
    y, x = (corners[:, d, None] + np.arange(side) for d in (1, 0))
    inside = ((y >= 0) & (y < rows))[:, :, None] & ((x >= 0) & (x < columns))[:, None, :]
    y, x = np.clip(y, 0, rows - 1), np.clip(x, 0, columns - 1)
    for k, frame in enumerate(islice(film.frames(), count)):
        progress(k)
        shown, wrong = light.of(frame)
        windows[k] = shown[y[:, :, None], x[:, None, :]]
        bad[k] = wrong[y[:, :, None], x[:, None, :]] & inside
    # Hot and dead pixels have the light of those about them: without it no sum over the window could be used.
    hot = defects[y[:, :, None], x[:, None, :]]
    windows[(bad & ~hot) | ~inside] = np.nan
    return windows, bad, ~inside


def _nearer_to_others(corners: IntArray, side: int, middles: FloatArray) -> BoolArray:
    """Which pixels of each window are nearer to another spot than to the window's own, (n, side, side)."""
    out = np.zeros((len(corners), side, side), dtype=np.bool_)
    for k, corner in enumerate(corners):
        y, x = np.indices((side, side)) + corner[::-1, None, None]
        far = np.array([np.hypot(x - mx, y - my) for mx, my in middles])
        out[k] = far[k] > far.min(axis=0)
    return out


def _ground(windows: FloatArray) -> FloatArray:
    """The ground under each spot, a plane through the border of its mean window, (n, side, side)."""
    side = windows.shape[-1]
    border = np.ones((side, side), dtype=np.bool_)
    border[1:-1, 1:-1] = False
    y, x = np.indices((side, side)) / side - 0.5
    plane = np.stack([np.ones_like(x), x, y], axis=-1)
    out = np.zeros(windows.shape[1:])
    for k in range(len(out)):
        sides = windows[:, k, border]
        known = np.isfinite(sides).any(axis=0)
        level = np.nanmedian(sides[:, known], axis=0)
        found, *_ = np.linalg.lstsq(plane[border][known], level, rcond=None)
        out[k] = plane @ found
    return out


def _densities(profile: FloatArray, sd: float, noise: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Densities of places, nowhere negative, that explain profiles (..., pixels) best with a kernel, (..., places), and
    the residuals; ``noise`` is the standard deviation of each pixel's."""
    pixels = profile.shape[-1]
    places = (np.arange(_FINE * pixels) + 0.5) / _FINE - 0.5
    kernel = pixel_masses(sd**2, np.arange(pixels + 1) - 0.5, places, 0)[0].T
    flat, by = profile.reshape(-1, pixels), noise.reshape(-1, pixels)
    each = zip(flat, by, strict=True)
    density = np.array([optimize.nnls(kernel / s[:, None], y / s, maxiter=60 * pixels)[0] for y, s in each])
    return density.reshape(*profile.shape[:-1], -1), (flat - density @ kernel.T).reshape(profile.shape)


def _kernel_and_electrons(profiles: list[FloatArray], dark: float) -> tuple[float, float]:
    """The widest kernel that explains profiles along x and along y, whose noise in the dark is given, and a spot's
    photoelectrons. Shot noise is known once the kernel is, so both are found in turns."""
    frames, spots, _ = profiles[0].shape
    some = np.unique(np.linspace(0, frames - 1, max(_KERNEL_FRAMES // spots, 24)).round().astype(int))
    profiles = [profile[some] for profile in profiles]
    # With too much noise the kernel is too wide at first, and what it leaves says so; with too little all that is left
    # would be taken for a kernel that is too wide.
    gain = _NOISIEST**2 * max(float(profile.max()) for profile in profiles)
    for _ in range(_TURNS):
        noises = [_noise(profile, dark, gain) for profile in profiles]
        sd = _kernel(profiles, noises)
        before, gain = gain, _gain(profiles, sd, noises, dark) if math.isfinite(sd) else 0.0
        if abs(gain - before) <= _SETTLED * before:
            break
    return sd, 1 / gain if gain else 0.0


def _noise(profile: FloatArray, dark: float, gain: float) -> FloatArray:
    """Standard deviation of each pixel of profiles by read-out and by shot noise of its light."""
    light = np.maximum(ndimage.gaussian_filter1d(profile, 1.0, axis=-1), 0.0)
    return np.asarray(np.sqrt(dark**2 + gain * light))


def _kernel(profiles: list[FloatArray], noises: list[FloatArray]) -> float:
    """The widest kernel that explains the profiles along x and along y, (frames, n, pixels) each."""
    widest = math.inf
    for profile, noise in zip(profiles, noises, strict=True):

        @cache
        def misfit(k: int, profile: FloatArray = profile, noise: FloatArray = noise) -> FloatArray:
            """Squares of each frame's residuals, over their noise: a density that is not zero takes one away."""
            density, left = _densities(profile, float(_WIDTHS[k]), noise)
            taken = np.count_nonzero(density > 0, axis=2)
            return np.asarray((((left / noise) ** 2).sum(axis=2) + taken).mean(axis=1))

        coarse = range(0, len(_WIDTHS), _NARROWER)

        def too_wide(k: int, share: float = 0.0) -> float:
            more = misfit(k) - misfit(k - _NARROWER)
            chance = _SURE * float(more.std()) / math.sqrt(len(more))
            return float(more.mean()) - max(_WORSE, share * float(misfit(k - _NARROWER).mean()), chance)

        wrong = next((k for k in coarse[1:] if too_wide(k, _SHARE) > 0), coarse[1])
        if wrong == coarse[1]:
            continue
        within = range(wrong - _NARROWER, wrong)
        last = max((k for k in within if too_wide(k) <= 0), default=within[0])
        part = max(0.0, too_wide(last) / (too_wide(last) - too_wide(last + 1)))
        widest = min(widest, float(_WIDTHS[last] * (_WIDTHS[1] / _WIDTHS[0]) ** part))
    return widest


def _gain(profiles: list[FloatArray], sd: float, noises: list[FloatArray], dark: float) -> float:
    """The variance of shot noise over the light, from what a kernel leaves of the profiles; zero where it is hidden."""
    square = shine = 0.0
    free = count = 0
    for profile, noise in zip(profiles, noises, strict=True):
        density, left = _densities(profile, sd, noise)
        bright = profile - left > _BRIGHT * profile.max()
        # A density that is not zero takes the noise of one pixel from the residuals.
        taken = int(np.count_nonzero(density.reshape(*profile.shape, _FINE).max(axis=-1)[bright] > 0))
        square += float((left[bright] ** 2).sum())
        shine += float((profile - left)[bright].sum())
        count += int(bright.sum())
        free += int(bright.sum()) - taken
    if free < _FEWEST_PIXELS:
        return 0.0
    more = square / free - dark**2
    return more / (shine / count) if more > _SHOT * dark**2 else 0.0
