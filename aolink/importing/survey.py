"""What the single frames of a film show of its objects: places, kernel, light, noise and steps."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage, optimize

from aolink.errors import ImportingError
from aolink.films.film import Film
from aolink.importing.accuracy import pixel_noise, tracker_errors
from aolink.importing.brightness import brightness_of, change_of
from aolink.importing.defects import FEWEST, defects_note
from aolink.importing.frames import FilmLight, FilmSettings
from aolink.importing.shapes import axis_ratios, motion_within
from aolink.importing.tracker import FIRST_FRAMES, WEIGHT, Objects, Tracker, trackpy_locator
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray
from aolink.optics.kernel import pixel_masses
from aolink.optics.maxima import cut_windows

_SAMPLES = 100
"""Frames in which the objects' light is fitted."""
_STRETCH = 10
"""Number of successive sampled frames that are averaged to find light beside an object."""
_ALONE = 1 / 3
"""Light beside an object that is less bright than this share of it does not matter."""
_LONG = 1.3
"""Length of an object over its width from which on it is not round."""
_DRIFTS = 5.0
"""Standard deviations of the mean step from which on it is a drift."""
_REST = 2.5
"""Least reach of an object's light, in standard deviations that include its walk in an exposure: light beyond belongs
to other objects."""
_FARTHEST = 4.0
"""Largest reach; light of others is searched for so far from an object."""


@dataclass(frozen=True, eq=False)
class Survey:
    """The measurements of a film's objects in the single frames."""

    places: FloatArray
    """Position (x, y) of each object in each frame, pixels, (frames, n, 2); NaN where it is not seen."""
    last: FloatArray
    """As ``places``, where an object is not seen the position at which it was last seen."""
    together: BoolArray
    """Which objects cannot be told apart in each frame (`Tracker.together`), (frames, n, n)."""
    sd: float
    """Standard deviation of the Gaussian that fits the objects best, pixels."""
    sd_sd: float
    """Standard deviation of ``sd``, from the differences of the objects."""
    light: FloatArray
    """Light of each object, a mean over the film, (n,)."""
    brightness: FloatArray
    """The light of all objects in each frame, over its mean, (frames,); one where it does not change."""
    ground: FloatArray
    """Remaining background under each object, for one pixel, (n,)."""
    residual: FloatArray
    """Residuals of sums over rows and over columns, as a share of the object's light, (samples,).

    Deviations from a Gaussian are not independent from pixel to pixel, and estimators use such sums.
    """
    model: FloatArray
    """The fits at the same places, as a share of the object's light, (samples,)."""
    place_sd: FloatArray
    """Standard deviation of the error of each object's place in one frame, pixels, (n,); NaN where it is not seen."""
    rest: float
    """Reach of the objects' light, in their standard deviations: what the brightest one has beyond is less than
    twice the noise of its light in one frame."""
    beside: FloatArray
    """The brightest light beside each object as a share of its own, both through a Gaussian of the object's size, in
    each stretch of the film, (stretches, n); NaN where the object is not seen."""
    stretch: int
    """Frames of a stretch."""
    length: FloatArray
    """Length of each object's light over its width, (n,), where no other light is beside it (`axis_ratios`)."""
    left_out: float
    """Share of the pixels about the objects that are saturated, hot or dead, or no numbers: kernel, light and noise are
    fitted without them."""
    defects: BoolArray | None
    """Which pixels of the picture are hot or dead, (rows, columns); None: none is known."""

    def alone(self, first: int, end: int) -> BoolArray:
        """Which objects have no other light beside them in the frames from ``first`` to before ``end``, (n,)."""
        some = self.beside[first // self.stretch : -(-end // self.stretch)]
        return np.asarray(~(some >= _ALONE).any(axis=0) & ~self.together[first:end].any(axis=(0, 1)))

    def notes(self) -> Iterator[str]:
        """A note on hot and dead pixels, on each pair of objects that came together, and on each object that is not
        round or has other light beside it."""
        if self.defects is not None:
            yield defects_note(self.defects)
        elif len(self.places) < FEWEST:
            yield f"{len(self.places)} frames are too few to find hot and dead pixels: {FEWEST} are needed"
        for a, b in np.argwhere(np.triu(self.together.any(axis=0))):
            frames = _stretches(np.flatnonzero(self.together[:, a, b]), 1, len(self.together))
            yield (
                f"objects {a + 1} and {b + 1} come together in frames {frames}: they are left out there, and which is"
                " which is not known afterwards"
            )
        if change := change_of(self.brightness):
            yield f"the light of the objects {change} over the film: exposures are scaled to the same light"
        steps = np.diff(self.places, axis=0)
        drift, count = np.nanmean(steps, axis=(0, 1)), max(int(np.isfinite(steps).all(axis=2).sum()), 1)
        if np.linalg.norm(drift) > _DRIFTS * math.sqrt(np.nanvar(steps) / count):
            yield (
                f"the objects drift together by {drift[0]:.3g},{drift[1]:.3g} pixels a frame: a rig file of `aolink rig"
                " --from` has a velocity for each of them, where they can be told from random motion"
            )
        unseen = np.asarray(~np.isfinite(self.places).all(axis=2) & ~self.together.any(axis=2))
        for number, gone in enumerate(unseen.T, 1):
            if gone.any():
                frames = _stretches(np.flatnonzero(gone), 1, len(gone))
                yield (
                    f"object {number} is not seen in frames {frames}: its true path is not known in exposures with one"
                    " of them, and its window is left out where it is never seen"
                )
        for number, (length, (x, y)) in enumerate(zip(self.length, self.last[0], strict=True), 1):
            if length >= _LONG:
                yield (
                    f"object {number} (at {x:.0f},{y:.0f}) is {length:.1f} times as long as it is wide, or two objects"
                    " that stay together; the rig file's kernel is round: its estimates may be wrong by more than they"
                    " say"
                )
        for k, beside in enumerate(self.beside.T):
            stretches = np.flatnonzero(beside >= _ALONE)
            if not len(stretches):
                continue
            frames = _stretches(stretches, self.stretch, len(self.places))
            x, y = self.last[stretches[0] * self.stretch, k]
            yield (
                f"object {k + 1} (at {x:.0f},{y:.0f}) has other light beside it in frames {frames}, up to"
                f" {beside[stretches].max():.0%} as bright: its estimates are wrong there by more than they say"
            )


def _stretches(numbers: IntArray, each: int, count: int) -> str:
    """Successive numbers of stretches of ``each`` frames, as ranges of the frames of a film of ``count``."""
    ends = np.flatnonzero(np.diff(numbers, append=-1) != 1)
    starts = np.concatenate([[0], ends[:-1] + 1])
    return ", ".join(
        f"{numbers[a] * each} to {min((numbers[b] + 1) * each, count) - 1}" for a, b in zip(starts, ends, strict=True)
    )


def survey(
    film: Film, settings: FilmSettings, objects: Objects, progress: Callable[[int], None] | None = None
) -> Survey:
    """Follow the objects through the whole film and fit their images in single frames.

    Raises `ImportingError` where none of the objects can be followed.
    """
    light = FilmLight(film, settings, objects.defects)
    tracker = Tracker(objects, trackpy_locator(objects.sd))
    every, half = max(1, film.count // _SAMPLES), math.ceil(_FARTHEST * objects.sd)
    places, last, together, shine = [], [], [], []
    windows, centres = [], []
    for k, frame in enumerate(film.frames()):
        shown, bad = light.of(frame)
        found = tracker.follow(shown)
        places.append(found)
        last.append(tracker.places.copy())
        together.append(tracker.together.copy())
        shine.append(tracker.light)
        if k % every == 0:
            shown[bad] = np.nan
            cut, corners = cut_windows(shown, tracker.places, half)
            windows.append(cut)
            centres.append(found - corners)
        if progress is not None:
            progress(k + 1)
    path, near = np.array(places), np.array(together)
    if np.isfinite(path).all(axis=2).sum() < 2 * FIRST_FRAMES:
        raise ImportingError(
            f"{film.name}: no object can be followed from frame to frame: do they move too far, or are they at an edge?"
        )
    brightness = brightness_of(np.array(shine))
    cuts = np.array(windows)
    ground = _about(cuts)[:, None, None]  # it does not fade with the objects
    cuts = ground + (cuts - ground) / brightness[::every, None, None, None]
    sd, sd_sd, amounts, remaining, residual, model, beside = _fitted(cuts, np.array(centres), objects.sd)
    lone = _lone(np.array(last)[::every], sd) & ~(np.repeat(beside, _STRETCH, axis=0)[: len(cuts)] >= _ALONE)
    length = axis_ratios(cuts, np.array(centres), sd, lone, motion_within(path)[::every])
    noise = pixel_noise(cuts.reshape(-1, *cuts.shape[2:]), np.concatenate(centres), sd)
    place_sd = tracker_errors(path, range(0, film.count, every), amounts, sd, noise, objects.sd)
    return Survey(
        places=path, last=np.array(last), together=near, sd=sd, sd_sd=sd_sd, light=amounts,
        brightness=brightness, ground=remaining, residual=residual, model=model, place_sd=place_sd,
        rest=_rest(float(np.nanmax(amounts)), sd, noise), beside=beside, stretch=every * _STRETCH, length=length,
        left_out=float(np.isnan(cuts).mean()), defects=objects.defects,
    )  # fmt: skip


def _lone(places: FloatArray, sd: float) -> BoolArray:
    """Which objects have no other followed object near them, (samples, n); places are (samples, n, 2)."""
    distance = np.linalg.norm(places[:, :, None] - places[:, None], axis=3)
    return np.asarray(((distance > 2 * _FARTHEST * sd) | np.eye(places.shape[1], dtype=np.bool_)).all(axis=2))


def _about(windows: FloatArray) -> FloatArray:
    """Median of the outermost pixels of each object's windows, (samples, n, side, side); zero where there are none."""
    border = np.ones(windows.shape[2:], dtype=np.bool_)
    border[1:-1, 1:-1] = False
    each = [one[np.isfinite(one)] for one in windows[:, :, border].swapaxes(0, 1)]
    return np.array([np.median(one) if one.size else 0.0 for one in each])


def _rest(light: float, sd: float, noise: tuple[float, float]) -> float:
    """`Survey.rest` of an object, for the ``noise`` that `pixel_noise` gives: a Gaussian has the share
    exp(-rest^2 / 2) of its light beyond."""
    dark, gain = noise
    variance = dark * math.pi * (_REST * sd) ** 2 + gain * light
    if not (variance > 0 and light > 0):
        return _REST
    return min(max(_REST, math.sqrt(max(math.log(light**2 / (4 * variance)), 0.0))), _FARTHEST)


def _fitted(
    windows: FloatArray, centres: FloatArray, start_sd: float
) -> tuple[float, float, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """The Gaussian, integrated over pixels, and the background that best fit windows (samples, n, side, side); NaN are
    pixels that are left out.

    The residuals, averaged over some windows, give the light beside an object (`Survey.beside`).
    """
    _, n, side, _ = windows.shape
    edges = np.arange(side + 1) - 0.5

    def amounts(sd: float, k: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Light and background of an object, its model, and the residuals of its pixels."""
        seen = np.isfinite(centres[:, k]).all(axis=1)
        x, y = (pixel_masses(sd**2, edges, centres[seen, k, d], 0)[0] for d in (0, 1))
        shape = (y[:, :, None] * x[:, None, :]).ravel()
        values = windows[seen, k].ravel()
        columns = np.column_stack([shape, np.ones(len(shape))])
        known = np.isfinite(values)
        found, *_ = np.linalg.lstsq(columns[known], values[known], rcond=None)
        return np.asarray(found), shape, np.asarray(values - columns @ found)

    def left(sd: float, k: int) -> float:
        return float(np.nansum(amounts(sd, k)[2] ** 2))

    usable = [k for k in range(n) if np.isfinite(centres[:, k]).all(axis=1).any()]
    bounds = (max(0.3, start_sd / 3), 2 * start_sd)
    each = np.array([optimize.minimize_scalar(left, bounds=bounds, args=(k,), method="bounded").x for k in usable])
    # The median is used because two objects that stick together should not widen the fit.
    sd = float(np.median(each))
    sd_sd = float(each.std(ddof=1) / math.sqrt(len(each))) if len(each) > 1 else math.nan
    light, ground, residuals, models = np.full(n, np.nan), np.zeros(n), [], []
    beside = np.full((-(-len(windows) // _STRETCH), n), np.nan)
    for k in usable:
        (light[k], ground[k]), shape, rest = amounts(sd, k)
        stretches = np.flatnonzero(np.isfinite(centres[:, k]).all(axis=1)) // _STRETCH
        for stretch in np.unique(stretches):
            left_over = np.nan_to_num(rest.reshape(-1, side, side)[stretches == stretch]).mean(axis=0)
            beside[stretch, k] = _brightest_beside(left_over, sd) / (light[k] / (4 * math.pi * sd**2))
        for axis in (1, 2):
            sums = rest.reshape(-1, side, side).sum(axis=axis).ravel()  # NaN where a pixel is left out
            residuals.append(sums[np.isfinite(sums)] / light[k])
            models.append(shape.reshape(-1, side, side).sum(axis=axis).ravel()[np.isfinite(sums)])
    return sd, sd_sd, light, ground, np.concatenate(residuals), np.concatenate(models), beside


def _brightest_beside(window: FloatArray, sd: float) -> float:
    """The largest value beside the middle of a window (side, side), smoothed by a Gaussian."""
    y, x = np.indices(window.shape) - len(window) // 2
    smooth = ndimage.gaussian_filter(window, sd, mode="constant")
    return float(smooth[np.hypot(x, y) >= WEIGHT * sd].max())


def reach(known: Survey, frames: int) -> float:
    """Largest distance of an object's light from the middle of its blur in an exposure of ``frames`` frames, pixels."""
    moved = max((_mean_square(known.places[lag:] - known.places[:-lag]) for lag in range(1, frames + 1)), default=0.0)
    return known.rest * math.sqrt(known.sd**2 + moved)


def spread_in(known: Survey, frames: int) -> float:
    """Variance of an object's places about their mean in an exposure of ``frames`` frames, pixels squared."""
    moved = (2 * (frames - lag) * _mean_square(known.places[lag:] - known.places[:-lag]) for lag in range(1, frames))
    return sum(moved) / (2 * frames**2)


def _mean_square(steps: FloatArray) -> float:
    """Over frames and objects, along one direction; zero where nothing is known."""
    known = np.isfinite(steps)
    return float((steps[known] ** 2).mean()) if known.any() else 0.0
