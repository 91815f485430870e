"""Objects followed through a film, each cut out as a spot in a window that follows it.

A window moves between two exposures by whole pixels, so that its object stays near its middle. For the plant that move
is an input: a rig whose inputs shift the positions of its spots, as `aolink.importing.first_rig` writes it, takes it
without an error. The positions of the objects in the single frames are the true path of an exposure that sums several.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from aolink.errors import FrameError, ImportingError
from aolink.exposure import Truth
from aolink.importing.film import Film
from aolink.importing.frames import Account, FilmLight, ImportedExposure, Settings, counts_of, grouped, rig_frame
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.centroid import weighted_centroid
from aolink.optics.kernel import pixel_masses
from aolink.optics.maxima import cut_windows, find_maxima, flatten, spot_sd
from aolink.optics.sensor import BaseSensor
from aolink.rig import Rig

_EDGE = 4.0
"""Least distance of an object from an edge of the picture and from other objects at first, in its standard
deviations."""
_FIRST_FRAMES = 5
"""Frames whose mean shows the objects."""
_WEIGHT = 1.5
"""Standard deviation of the centroid's weight, in those of the object."""
_REACH = 3.0
"""How far an object may go from one frame to the next, in its standard deviations."""
_FAINT = 0.3
"""Share of an object's usual light below which it is lost."""
_SAMPLES = 100
"""Frames in which the objects' light is fitted."""
STRAY = 1 / 8
"""Distance of an object from the middle of its window at which the window moves, as a share of the window."""
_STRETCH = 10
"""Number of successive sampled frames that are averaged to find light beside an object."""
_ALONE = 1 / 3
"""Light beside an object that is less bright than this share of it does not matter."""
_REST = 2.5
"""Reach of an object's light, in standard deviations that include its walk in an exposure: light beyond belongs to
other objects."""


@dataclass(frozen=True, eq=False)
class Objects:
    """Objects of a film's first frames, the brightest first."""

    places: FloatArray
    """Positions (x, y), pixels, zero in the middle of the first pixel, (n, 2)."""
    sd: float
    """Standard deviation of an object's light in one direction, pixels."""


class Tracker:
    """Follows objects from frame to frame, by the centroid under a Gaussian weight that starts at the last position.

    Crocker & Grier, J. Colloid Interface Sci. 179, 298 (1996), with the weight of Thomas et al., Mon. Not. R. Astron.
    Soc. 371, 323 (2006). Where trackpy is installed, it locates the objects (`locate`).
    """

    def __init__(self, objects: Objects, locate: Callable[[FloatArray], FloatArray] | None) -> None:
        self.places = objects.places.copy()
        """Position of each object, (n, 2)."""
        self._sd, self._locate = objects.sd, locate
        self._usual = np.full(len(self.places), np.nan)
        self.lost = np.zeros(len(self.places), dtype=np.int64)
        """Number of frames since each object was last seen, (n,)."""

    def follow(self, light: FloatArray) -> FloatArray:
        """Take the next frame; gives the positions of the objects, (n, 2), NaN where one is not seen."""
        half = math.ceil((_REACH + 2 * _WEIGHT) * self._sd)
        windows, corners = cut_windows(light, self.places, half)
        start = np.clip(self.places - corners, 0, 2 * half)
        found = corners + weighted_centroid(windows, _WEIGHT * self._sd, start=start)
        if self._locate is not None:
            found = self._nearest(light, found)
        brightness = self._light(light, np.where(np.isfinite(found), found, self.places))
        self._usual = np.where(np.isfinite(self._usual), self._usual, brightness)
        moved = np.linalg.norm(found - self.places, axis=1)
        seen = (moved <= _REACH * self._sd * (1 + self.lost)) & (brightness > _FAINT * self._usual)
        self._usual[seen] += 0.1 * (brightness - self._usual)[seen]
        self.places[seen] = found[seen]
        self.lost = np.where(seen, 0, self.lost + 1)
        return np.where(seen[:, None], found, np.nan)

    def _light(self, light: FloatArray, places: FloatArray) -> FloatArray:
        """Light about each place under the weight, (n,)."""
        half = math.ceil(2 * _WEIGHT * self._sd)
        windows, corners = cut_windows(light, places, half)
        x = np.arange(2 * half + 1)
        away = places - corners
        across = np.exp(-(((x - away[:, :1]) / (_WEIGHT * self._sd)) ** 2) / 2)
        along = np.exp(-(((x - away[:, 1:]) / (_WEIGHT * self._sd)) ** 2) / 2)
        return np.asarray(np.einsum("nyx,ny,nx->n", windows, along, across))

    def _nearest(self, light: FloatArray, near: FloatArray) -> FloatArray:
        """The object that trackpy locates nearest to each place; the place itself where it locates none near it."""
        assert self._locate is not None
        located = self._locate(light)
        if not len(located):
            return near
        distance = np.linalg.norm(near[:, None] - located, axis=2)
        distance = np.where(np.isfinite(distance), distance, np.inf)
        nearest = distance.argmin(axis=1)
        close = distance[np.arange(len(near)), nearest] <= self._sd
        return np.where(close[:, None], located[nearest], near)


def trackpy_locator(sd: float) -> Callable[[FloatArray], FloatArray] | None:
    """trackpy's `locate` for objects of a size, as a function of a frame; None where trackpy is not installed."""
    try:
        import trackpy
    except ImportError:
        return None
    trackpy.quiet()
    diameter = 2 * math.ceil(2 * sd) + 1

    def locate(light: FloatArray) -> FloatArray:
        with warnings.catch_warnings():  # a warning of pandas, about how trackpy calls it
            warnings.simplefilter("ignore")
            found = trackpy.locate(np.maximum(light, 0.0), diameter)
        return np.asarray(found[["x", "y"]].to_numpy(dtype=np.float64))

    return locate


def find_objects(film: Film, settings: Settings) -> Objects:
    """The brightest objects of a film's first frames, as many as requested.

    Raises
    ------
    ImportingError
        There are fewer.
    """
    if settings.places and len(settings.places) != settings.track:
        raise ImportingError(f"{len(settings.places)} places are given for --track {settings.track}: give one for each")
    light, frames = FilmLight(film, settings), []
    for frame in film.frames():
        frames.append(light.of(frame)[0])
        if len(frames) == _FIRST_FRAMES:
            break
    try:
        flat, _ = flatten(np.mean(frames, axis=0))
    except FrameError as error:
        raise ImportingError(f"{film.name}: no objects can be found: {error}") from None
    if settings.places:
        given = np.array(settings.places, dtype=np.float64)
        return Objects(given, spot_sd(flat, given, _pitch(given, film.shape)))
    most = 0
    for maxima in find_maxima(flat):
        margin = _EDGE * maxima.scale
        far = np.array(film.shape[::-1]) - 1 - margin
        inside = ((maxima.places >= margin) & (maxima.places <= far)).all(axis=1)
        order = np.argsort(-maxima.heights[inside])
        apart = _apart(maxima.places[inside][order], margin)
        most = max(most, len(apart))
        if len(apart) >= settings.track:
            chosen = apart[: settings.track]
            return Objects(chosen, spot_sd(flat, chosen, _pitch(chosen, film.shape)))
    dark = "" if settings.invert else "; are they darker than the ground? then add --invert"
    raise ImportingError(f"{film.name} shows {most} objects, {settings.track} are asked for with --track{dark}")


def _apart(places: FloatArray, least: float) -> FloatArray:
    """Places in their order, without those that are near to an earlier one."""
    kept: list[FloatArray] = []
    for place in places:
        if all(np.linalg.norm(place - other) >= least for other in kept):
            kept.append(place)
    return np.array(kept).reshape(-1, 2)


def _pitch(places: FloatArray, shape: tuple[int, int]) -> float:
    """Distance of the two nearest objects, at most the shorter side of the picture."""
    distance = np.linalg.norm(places[:, None] - places, axis=2)
    np.fill_diagonal(distance, np.inf)
    return float(min(distance.min(), min(shape)))


@dataclass(frozen=True, eq=False)
class Survey:
    """The measurements of a film's objects in the single frames."""

    places: FloatArray
    """Position (x, y) of each object in each frame, pixels, (frames, n, 2); NaN where it is not seen."""
    sd: float
    """Standard deviation of the Gaussian that fits the objects best, pixels."""
    sd_sd: float
    """Standard deviation of ``sd``, from the differences of the objects."""
    light: FloatArray
    """Light of each object, (n,)."""
    ground: FloatArray
    """Remaining background under each object, for one pixel, (n,)."""
    residual: FloatArray
    """Residuals of sums over rows and over columns, as a share of the object's light, (samples,).

    Deviations from a Gaussian are not independent from pixel to pixel, and estimators use such sums.
    """
    model: FloatArray
    """The fits at the same places, as a share of the object's light, (samples,)."""
    place_sd: float
    """Standard deviation of the error of a place in one frame, pixels."""
    walk: float
    """Variance of the step from frame to frame along one direction, pixels squared."""
    beside: FloatArray
    """The brightest light beside each object as a share of its own, both through a Gaussian of the object's size, in
    each stretch of the film, (stretches, n); NaN where the object is not seen."""
    stretch: int
    """Frames of a stretch."""

    def alone(self, first: int, end: int) -> BoolArray:
        """Which objects have no other light beside them in the frames from ``first`` to before ``end``, (n,)."""
        some = self.beside[first // self.stretch : -(-end // self.stretch)]
        return np.asarray(~(some >= _ALONE).any(axis=0))


def survey(film: Film, settings: Settings, objects: Objects, progress: Callable[[int], None] | None = None) -> Survey:
    """Follow the objects through the whole film and fit their images in single frames.

    Raises
    ------
    ImportingError
        None of the objects can be followed.
    """
    light = FilmLight(film, settings)
    tracker = Tracker(objects, trackpy_locator(objects.sd))
    every, half = max(1, film.count // _SAMPLES), math.ceil(4 * objects.sd)
    places, windows, centres = [], [], []
    for k, frame in enumerate(film.frames()):
        shown, _ = light.of(frame)
        found = tracker.follow(shown)
        places.append(found)
        if k % every == 0:
            cut, corners = cut_windows(shown, tracker.places, half)
            windows.append(cut)
            centres.append(found - corners)
        if progress is not None:
            progress(k + 1)
    path = np.array(places)
    if np.isfinite(path).all(axis=2).sum() < 2 * _FIRST_FRAMES:
        raise ImportingError(f"{film.name}: no object can be followed from frame to frame: do they move too far?")
    sd, sd_sd, amounts, ground, residual, model, beside = _fitted(np.array(windows), np.array(centres), objects.sd)
    walk, place_sd = _steps(path)
    return Survey(path, sd, sd_sd, amounts, ground, residual, model, place_sd, walk, beside, every * _STRETCH)


def _fitted(
    windows: FloatArray, centres: FloatArray, start_sd: float
) -> tuple[float, float, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """The Gaussian, integrated over pixels, and the background that best fit windows (samples, n, side, side).

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
        found, *_ = np.linalg.lstsq(columns, values, rcond=None)
        return np.asarray(found), shape, np.asarray(values - columns @ found)

    def left(sd: float, k: int) -> float:
        return float((amounts(sd, k)[2] ** 2).sum())

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
            left_over = rest.reshape(-1, side, side)[stretches == stretch].mean(axis=0)
            beside[stretch, k] = _brightest_beside(left_over, sd) / (light[k] / (4 * math.pi * sd**2))
        for axis in (1, 2):
            residuals.append(rest.reshape(-1, side, side).sum(axis=axis).ravel() / light[k])
            models.append(shape.reshape(-1, side, side).sum(axis=axis).ravel())
    return sd, sd_sd, light, ground, np.concatenate(residuals), np.concatenate(models), beside


def _brightest_beside(window: FloatArray, sd: float) -> float:
    """The largest value beside the middle of a window (side, side), smoothed by a Gaussian."""
    y, x = np.indices(window.shape) - len(window) // 2
    smooth = ndimage.gaussian_filter(window, sd, mode="constant")
    return float(smooth[np.hypot(x, y) >= _WEIGHT * sd].max())


def _steps(places: FloatArray) -> tuple[float, float]:
    """Variance of the steps of a random walk and the tracker's error, pixels squared and pixels.

    A frame that is exposed throughout sees the walk's mean: steps then have the variance 2 q / 3 + 2 r and from step to
    step the covariance q / 6 - r. Berglund, Phys. Rev. E 82, 011917 (2010).
    """
    steps = np.diff(places, axis=0)
    steps = steps - np.nanmean(steps, axis=0)
    variance = float(np.nanmean(steps**2))
    covariance = float(np.nanmean(steps[1:] * steps[:-1]))
    walk = max(variance + 2 * covariance, 0.0)
    return walk, math.sqrt(max(walk / 6 - covariance, 0.0))


def reach(known: Survey, frames: int) -> float:
    """Largest distance of an object's light from the middle of its blur in an exposure of ``frames`` frames, pixels."""
    return _REST * math.sqrt(known.sd**2 + known.walk * frames)


def tracked(
    film: Film, rig: Rig, settings: Settings, periods: NDArray[np.int64], account: Account
) -> Iterator[ImportedExposure]:
    """The exposures of a film's objects, each in a window of its own.

    Raises
    ------
    ImportingError
        The rig file describes another number of spots, or the film shows fewer objects.
    """
    sensor = rig.sensor
    if sensor.directions == 1 or sensor.spots != settings.track or sensor.spot_light is not None:
        raise ImportingError(
            f"--track {settings.track} needs a rig file with {settings.track} spots, sensor.kind = 'spots'"
            f" (aolink rig --from writes one), {rig.name} has {rig.n_outputs} slopes of a {sensor.shape[0]} x"
            f" {sensor.shape[1]} sensor"
        )
    known = survey(film, settings, find_objects(film, settings))
    account.notes += tuple(_crowded(film, known))
    windows = _Windows(rig, sensor, known)
    light, step, area = FilmLight(film, settings), 0, sensor.pixel_size
    for group in grouped(film, settings.frames_per_exposure, periods):
        shown = [light.of(frame) for frame in group.frames]
        mean = np.mean([one for one, _ in shown], axis=0)
        bad = np.any([wrong for _, wrong in shown], axis=0)
        blurs = _blurs(mean, known.places[max(group.first_frame - 1, 0)], known, len(shown))
        values, usable, own = windows.cut(mean, ~bad, blurs)
        # Beyond an object's reach there is none of its light: light there belongs to others.
        values = np.where(own, values - known.ground[:, None, None], 0.0)
        density = values / known.light[:, None, None] / area
        counts = sensor.black_level + sensor.counts_per_density * windows.as_frame(density)
        pixels, mask = counts_of(counts, windows.as_frame(usable), rig, account)
        account.frames += len(shown)
        account.exposures += 1
        frame = rig_frame(film, rig, settings, group.first_period // settings.frames_per_exposure, pixels, mask)
        end = group.first_frame + len(shown)
        path = windows.positions(known.places[group.first_frame : end])
        inputs = np.tile(rig.mirror.park, (frame.last_step + 1 - step, 1))
        step = frame.last_step + 1
        inputs[-1] += windows.follow(known.places[end - 1])
        truth = None
        if len(path.T) == rig.timing.exposure_steps and np.isfinite(path).all():
            after = windows.positions(known.places[end : end + 1])
            truth = Truth(
                start_state=_state(rig, path[:, 0]), end_state=_state(rig, after[:, 0] if after.size else None),
                path=path, path_sd=known.place_sd * sensor.pixel_width,
            )  # fmt: skip
        yield ImportedExposure(frame=frame, inputs=inputs, truth=truth)


def _crowded(film: Film, known: Survey) -> Iterator[str]:
    """A note on each object that has other light beside it, with the frames and how bright it is."""
    for k, beside in enumerate(known.beside.T):
        stretches = np.flatnonzero(beside >= _ALONE)
        if not len(stretches):
            continue
        ends = np.flatnonzero(np.diff(stretches, append=-1) != 1)
        starts = np.concatenate([[0], ends[:-1] + 1])
        frames = ", ".join(
            f"{stretches[a] * known.stretch} to {min((stretches[b] + 1) * known.stretch, film.count) - 1}"
            for a, b in zip(starts, ends, strict=True)
        )
        x, y = known.places[stretches[0] * known.stretch, k]
        yield (
            f"object {k + 1} (at {x:.0f},{y:.0f}) has other light beside it in frames {frames}, up to"
            f" {beside[stretches].max():.0%} as bright: its estimates are wrong there by more than they say"
        )


def _blurs(picture: FloatArray, last: FloatArray, known: Survey, frames: int) -> FloatArray:
    """Positions of the objects' blurs in an exposure, after they were at ``last`` (n, 2); NaN as there.

    They are measured in the exposure alone: knowledge from the single frames must not show in its pixels.
    """
    start = np.where(np.isfinite(last), last, 0.0)
    far = reach(known, frames)
    windows, corners = cut_windows(picture, start, math.ceil(far + 2 * _WEIGHT * known.sd))
    spread = math.sqrt(known.sd**2 + known.walk * frames / 6)  # a walk's mean square about its own mean
    found = corners + weighted_centroid(windows, _WEIGHT * spread, start=start - corners)
    near = np.linalg.norm(found - last, axis=1) <= far  # False where either is NaN
    return np.where(near[:, None], found, last)


def _state(rig: Rig, output: FloatArray | None) -> FloatArray:
    """The state of a plant that has one state for each output, (axes, n_states); NaN where outputs do not determine
    it."""
    plant = rig.plant
    if output is None or plant.C.shape != (1, 1):
        return np.full((plant.axes, plant.n_states), np.nan)
    return np.asarray(output[:, None] / plant.C[0, 0])


class _Windows:
    """A window for each object; it moves by whole pixels, if the rig's inputs can represent the moves."""

    def __init__(self, rig: Rig, sensor: BaseSensor, known: Survey) -> None:
        self._sensor, self._side = sensor, sensor.profile.pixels
        plant = rig.plant
        gain = plant.C @ plant.B
        # An input moves the outputs at once and permanently.
        self._moves = gain.shape[0] == gain.shape[1] and bool(
            np.allclose(plant.C @ plant.A @ plant.B, gain) and np.linalg.matrix_rank(gain) == len(gain)
        )
        self._per_shift = np.linalg.inv(gain) if self._moves else gain
        self._reach = reach(known, rig.timing.exposure_steps)
        self._corners = self._about(known.places[0])

    def _about(self, places: FloatArray) -> NDArray[np.int64]:
        """First pixels of windows with places in their middles, (n, 2) as (x, y)."""
        return np.rint(places - (self._side - 1) / 2).astype(np.int64)

    def positions(self, places: FloatArray) -> FloatArray:
        """Places in the picture (frames, n, 2) as outputs of the rig, slope units, (2 n, frames)."""
        inside = (places - self._corners + 0.5) * self._sensor.pixel_width + self._sensor.field[0]
        return np.asarray(inside.reshape(len(places), 2 * len(self._corners)).T)

    def cut(
        self, picture: FloatArray, usable: BoolArray, places: FloatArray
    ) -> tuple[FloatArray, BoolArray, BoolArray]:
        """The pixels in the windows, the mask of usable ones, and the mask of those that may have light of the blurs at
        ``places``, (n, side, side) each.
        """
        span = np.arange(self._side)
        x, y = (self._corners[:, d, None] + span for d in (0, 1))
        rows, columns = picture.shape
        inside = ((y >= 0) & (y < rows))[:, :, None] & ((x >= 0) & (x < columns))[:, None, :]
        at = np.clip(y, 0, rows - 1)[:, :, None], np.clip(x, 0, columns - 1)[:, None, :]
        last = np.where(np.isfinite(places), places, self._corners + (self._side - 1) / 2)
        away = np.hypot((x - last[:, :1])[:, None, :], (y - last[:, 1:])[:, :, None])
        return picture[at], ~inside | usable[at], inside & (away <= self._reach)

    def as_frame(self, windows: NDArray[Any]) -> NDArray[Any]:
        """Windows (n, side, side) as a frame of the sensor, (rows, columns)."""
        (rows, columns), side = self._sensor.grid, self._side
        return windows.reshape(rows, columns, side, side).swapaxes(1, 2).reshape(rows * side, columns * side)

    def follow(self, places: FloatArray) -> FloatArray:
        """Move windows after objects that have strayed; gives the inputs for these moves, (n_inputs,)."""
        old = self._corners
        if not self._moves:
            return np.zeros(old.size)
        middle = old + (self._side - 1) / 2
        strayed = np.abs(places - middle).max(axis=1) > STRAY * self._side  # never of one that is not seen
        self._corners = np.where(strayed[:, None], self._about(np.where(strayed[:, None], places, middle)), old)
        shift = -(self._corners - old) * self._sensor.pixel_width
        copies = shift.reshape(-1, len(self._per_shift))
        return np.asarray((copies @ self._per_shift.T).ravel())
