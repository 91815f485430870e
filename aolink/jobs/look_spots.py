"""Spots of a film that may be blurred by their motion: where they are, their kernel, light and noise.

The kernel is seen across the motion, where nothing blurs it: the mean of all frames, summed along the direction in
which it is longest, is a Gaussian there. What swings across as well makes it too wide at first, and the constant that
is left of the blur's covariances (`aolink.identification.vibration`) corrects it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
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
_STILL = 4.5
"""Differences of two frames beyond so many medians are motion."""
_DARK, _MOST_OF_BORDER = 0.15, 0.9
"""Share of the brightest light that the picture has elsewhere where spots stand alone, and of a window's border that is
so dark."""
_FAINTEST = 0.2
"""... and has this share of the brightest one's height; it goes where it has half of the latter."""
_SHARPEST = 0.8
"""Smallest standard deviation of a spot, pixels: sharper light is a hot pixel."""
_REACH = 4.0
"""Standard deviations of the kernel beyond the path that belong to a window."""
_LARGEST = 128
"""Most pixels along a side of a window."""
_SMALLEST = 12
_FINE = 3
"""Places in a pixel at which a density may be: with one, a sharp spot between two pixels looks wider than it is."""
_BRIGHT, _SHOT, _FEWEST_PIXELS = 0.3, 0.3, 100
"""Shot noise is looked for in pixels of profiles with this share of the brightest one's light; the share of the dark
noise's variance that shows; and how many such pixels are enough."""
_GAIN_FRAMES = 24
"""Frames that tell the shot noise."""
_NARROWER = 0.9
"""A kernel so much narrower than the one that was found explains the frames as well: what it leaves is noise."""
_BRIGHT_PART = 0.1
"""Share of the brightest pixel above which light tells the direction of the motion."""
_SUBPIXELS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Spots:
    """What the first frames of a film show of its spots; places are (x, y), pixels of the film."""

    light: FloatArray
    """Light above the ground in each spot's window, over the spot's light, (frames, n, side, side); NaN where a pixel
    cannot be used, zero where it is nearer to another spot or beyond the picture."""
    corners: IntArray
    """First pixel of each window, (n, 2)."""
    sd: float
    """Standard deviation of the kernel across the motion, pixels."""
    noise: float
    """Standard deviation of a dark pixel's noise, over a spot's light."""
    electrons: float
    """Photoelectrons of a spot; zero where shot noise does not show."""
    mean: FloatArray
    """Mean picture, (rows, columns)."""
    saturated: float
    """Share of the pixels in the windows that are saturated or hot."""
    saturated_frames: float
    """Share of the frames in which a pixel of the brightest spot is saturated."""
    alone: bool
    """Whether the picture is dark but for the spots."""
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
    sd = float(np.median([across(np.nanmean(windows[:, k], axis=0)) for k in range(len(corners))]))
    profiles = [np.nansum(windows, axis=axis) for axis in (2, 3)]  # along x, along y
    electrons = _electrons(profiles, sd, noise * math.sqrt(side))
    rows, columns = film.shape
    ends = corners + side
    return Spots(
        light=windows, corners=corners, sd=sd, noise=noise,
        electrons=electrons, mean=mean, saturated=float(bad.mean()), left_out=left_out,
        saturated_frames=float((bad[:, 0] & ~defects[_inside(corners[0], side, film.shape)]).any(axis=(1, 2)).mean()),
        alone=_alone(mean, corners, windows),
        at_edge=bool((corners < 0).any() or (ends > (columns, rows)).any()),
    )  # fmt: skip


def _inside(corner: IntArray, side: int, shape: tuple[int, int]) -> tuple[IntArray, IntArray]:
    """Rows and columns of a window, as numbers for an array, those beyond the picture at its edge."""
    y, x = (np.clip(corner[d] + np.arange(side), 0, shape[1 - d] - 1) for d in (1, 0))
    return y[:, None], x[None]


def _alone(mean: FloatArray, corners: IntArray, windows: FloatArray) -> bool:
    """Whether the picture is dark but for the spots: they have room in it, and neither at the borders of their windows
    nor elsewhere has the mean of the frames more than a share of the brightest light."""
    rest, top, side = mean.copy(), float(mean.max()), windows.shape[-1]
    if side > min(mean.shape):
        return False
    border = np.ones((side, side), dtype=np.bool_)
    border[1:-1, 1:-1] = False
    for k, (x, y) in enumerate(corners):
        rest[max(0, y) : y + side, max(0, x) : x + side] = np.nan
        seen = windows[:, k].mean(axis=0)
        if not float(np.nanquantile(np.abs(seen[border]), _MOST_OF_BORDER)) < _DARK * float(np.nanmax(seen)):
            return False
    rest = rest[np.isfinite(rest)]
    return rest.size == 0 or float(np.quantile(np.abs(rest - np.median(rest)), 0.99)) < _DARK * top


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
            off = np.abs(shown - last)
            # Whole numbers have no median of their own: the mean square of all but what moves.
            usual = off[off <= _STILL * max(float(np.median(off)), light.step)]
            differences.append(math.sqrt(float((usual**2).mean()) / 2))
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


def across(picture: FloatArray) -> float:
    """Standard deviation of the kernel, from a window's mean (rows, columns): that of a Gaussian which fits the light
    summed along the direction in which it is longest."""
    light = np.where(np.isfinite(picture), picture, 0.0)
    bright = np.where(light > _BRIGHT_PART * light.max(), light, 0.0)
    y, x = np.indices(light.shape)
    at = np.array([x.ravel(), y.ravel()], dtype=np.float64)
    middle = (at * bright.ravel()).sum(axis=1) / bright.sum()
    _, vectors = np.linalg.eigh(np.cov(at, aweights=bright.ravel()))
    place = vectors[:, 0] @ (at - middle[:, None])
    # Each pixel's light goes to the places across that it covers, as from a square turned by the direction.
    edges = np.arange(-math.ceil(np.abs(place).max()) - 1, math.ceil(np.abs(place).max()) + 2) / 2
    fine = (np.arange(_SUBPIXELS) + 0.5) / _SUBPIXELS - 0.5
    offsets = (vectors[0, 0] * fine[:, None] + vectors[1, 0] * fine).ravel()
    profile = np.mean([np.histogram(place + each, edges, weights=light.ravel())[0] for each in offsets], axis=0)
    centres = (edges[1:] + edges[:-1]) / 2
    shown = np.maximum(profile, 0.0)
    reach = np.abs(centres) < max(_SMALLEST / 2, 6 * math.sqrt(float((shown * centres**2).sum() / shown.sum())))
    start = math.sqrt(max(np.cov(at, aweights=bright.ravel()).trace() / 4, 1.0))

    def misfit(p: FloatArray) -> FloatArray:
        return np.asarray(p[0] * np.exp(-((centres - p[1]) ** 2) / (2 * p[2] ** 2)) + p[3] - profile)[reach]

    found = optimize.least_squares(misfit, [profile.max(), 0.0, start, 0.0])
    pixel = (1 + 1 + 1 / 4) / 12  # of the light over a pixel, of spreading it there, and of the bins
    return math.sqrt(max(float(found.x[2]) ** 2 - pixel, 0.1))


def _electrons(profiles: list[FloatArray], sd: float, dark: float) -> float:
    """A spot's photoelectrons, from profiles along x and along y whose noise in the dark is given; zero where no shot
    noise shows."""
    some = np.unique(np.linspace(0, len(profiles[0]) - 1, _GAIN_FRAMES).round().astype(int))
    profiles = [profile[some] for profile in profiles]
    noises = [np.full_like(profile, dark) for profile in profiles]
    gain = _gain(profiles, _NARROWER * sd, noises, dark)
    return 1 / gain if gain else 0.0


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
