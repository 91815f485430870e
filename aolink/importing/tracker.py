"""Objects of a film, found in its first frames and followed from frame to frame."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, optimize

from aolink.errors import FrameError, ImportingError
from aolink.films.film import Film
from aolink.importing.defects import find_defects
from aolink.importing.frames import FilmLight, FilmSettings
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray
from aolink.optics.centroid import weighted_centroid
from aolink.optics.maxima import cut_windows, find_maxima, flatten, spot_sd

FIRST_FRAMES = 5
"""Frames whose mean shows the objects."""
WEIGHT = 1.5
"""Standard deviation of the centroid's weight, in those of the object."""
_EDGE = 4.0
"""Least distance of an object from an edge of the picture and from other objects at first, in its standard
deviations."""
_CUT = 2.5
"""Distance from an edge, in standard deviations, below which a centroid is off, because light beyond is missing."""
_REACH = 3.0
"""How far an object may go from one frame to the next, in its standard deviations."""
_FAR = 6.0
"""The same of one that is searched for, because there is no light of it nearer."""
_LIKE = 0.6
"""Share of an object's usual light that it must have to be found so far away."""
_FAINT = 0.3
"""Share of an object's usual light below which it is lost."""
_BESIDE = 6.0
"""Distance, in standard deviations, below which the light of another object moves a centroid."""
_ROUNDS = 6
"""Times that the light of objects beside each other is subtracted in turn."""
_MEET = 2.5
"""Distance, in standard deviations, below which two objects cannot be measured apart: from 2 on their light has one
maximum."""


@dataclass(frozen=True, eq=False)
class Objects:
    """Objects of a film's first frames, the brightest first."""

    places: FloatArray
    """Positions (x, y), pixels, zero in the middle of the first pixel, (n, 2)."""
    sd: float
    """Standard deviation of an object's light in one direction, pixels."""
    defects: BoolArray | None = None
    """Which pixels of the camera are hot or dead, (rows, columns); None: it is not known of any."""


class Tracker:
    """Follows objects from frame to frame, by the centroid under a Gaussian weight that starts at the last position.

    Crocker & Grier, J. Colloid Interface Sci. 179, 298 (1996), with the weight of Thomas et al., Mon. Not. R. Astron.
    Soc. 371, 323 (2006). Where trackpy is installed, it locates the objects (`locate`).
    """

    def __init__(self, objects: Objects, locate: Callable[[FloatArray], FloatArray] | None) -> None:
        self.places = objects.places.copy()
        """Last known position of each object, (n, 2)."""
        self.together: BoolArray = np.zeros((len(self.places), len(self.places)), dtype=np.bool_)
        """Which objects have come so near to each other that their light is one, (n, n): none of them is seen until
        there are two lights again. Which is which is then not known."""
        self._sd, self._locate = objects.sd, locate
        self._usual = np.full(len(self.places), np.nan)
        self.light = np.zeros(len(self.places))
        """Light of each object under the weight in the last frame, (n,); zero where it is not seen."""
        self._lost = np.zeros(len(self.places), dtype=np.int64)

    def follow(self, light: FloatArray) -> FloatArray:
        """Take the next frame; gives the positions of the objects, (n, 2), NaN where one is not seen."""
        light = light - np.median(light)  # what cut windows have beyond the picture is then ground
        start = self.places.copy()
        for pair in np.argwhere(np.triu(self.together)):
            start[pair] = self._apart_again(light, pair)
            self.light[pair] = self._usual[pair]
        found, brightness = self._measured(light, start)
        self._usual = np.where(np.isfinite(self._usual), self._usual, brightness)
        moved = np.linalg.norm(found - self.places, axis=1)
        seen = (moved <= _REACH * self._sd * (1 + self._lost)) & (brightness > _FAINT * self._usual)
        for k in np.flatnonzero(~seen & ~self.together.any(axis=1)):
            place, shine = self._farther(light, int(k), found[seen])
            if shine > _LIKE * self._usual[k]:
                found[k], brightness[k], seen[k] = place, shine, True
        margin, size = _CUT * self._sd - 0.5, np.array(light.shape[::-1])
        seen &= np.asarray(((found >= margin) & (found <= size - 1 - margin)).all(axis=1))
        self.together &= ~(seen[:, None] & seen)
        meets = self._within(_MEET, found)
        # A track that had lost its object comes upon the light of another one.
        followed = seen & (self._lost == 0)
        seen &= followed | ~(meets & followed).any(axis=1)
        self.together |= meets & seen[:, None] & seen
        seen &= ~self.together.any(axis=1)
        self._usual[seen] += 0.1 * (brightness - self._usual)[seen]
        self.light = np.where(seen, brightness, 0.0)
        self.places[seen] = found[seen]
        self._lost = np.where(seen, 0, self._lost + 1)
        return np.where(seen[:, None], found, np.nan)

    def _measured(self, light: FloatArray, start: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Centroids, (n, 2), and the light under the weight there, (n,), of objects near ``start``.

        The light of objects beside each other is subtracted in turn, as Gaussians.
        """
        half = math.ceil((_REACH + 2 * WEIGHT) * self._sd)
        windows, corners = cut_windows(light, np.where(np.isfinite(start), start, self.places), half)
        # The ground about an object is no light of it, however the ground differs from place to place.
        border = np.ones(windows.shape[1:], dtype=np.bool_)
        border[1:-1, 1:-1] = False
        windows -= np.median(windows[:, border], axis=1)[:, None, None]
        near = self._within(_BESIDE, start)
        crowded = np.asarray(near.any(axis=1))
        pixels = np.arange(2 * half + 1)
        found, brightness = start, self.light
        for _ in range(_ROUNDS if crowded.any() else 1):
            own = windows.copy()
            # A Gaussian's share of light under the weight is W^2 / (1 + W^2).
            peak = np.nan_to_num(brightness) * (1 + 1 / WEIGHT**2) / (2 * math.pi * self._sd**2)
            for k, other in np.argwhere(near & np.isfinite(found).all(axis=1)):
                own[k] -= peak[other] * _gaussian(found[other] - corners[k], self._sd, pixels)
            begin = np.clip(found - corners, 0, 2 * half)
            found = corners + weighted_centroid(own, WEIGHT * self._sd, start=begin)
            under = (_gaussian(place, WEIGHT * self._sd, pixels) for place in found - corners)
            brightness = np.array([(one * weight).sum() for one, weight in zip(own, under, strict=True)])
        if self._locate is not None:
            found = np.where(crowded[:, None], found, self._nearest(light, found))
        return found, brightness

    def _farther(self, light: FloatArray, k: int, others: FloatArray) -> tuple[FloatArray, float]:
        """Place and brightness of the brightest light farther from the last place of an object, (2,), without that of
        others."""
        half = math.ceil((_FAR + 2 * WEIGHT) * self._sd)
        windows, (corner,) = cut_windows(light, self.places[k][None], half)
        pixels = np.arange(2 * half + 1)
        at = np.stack(np.meshgrid(pixels, pixels), axis=-1) + corner
        usable = np.linalg.norm(at - self.places[k], axis=2) <= _FAR * self._sd
        for other in others:
            usable &= np.linalg.norm(at - other, axis=2) > _EDGE * self._sd
        smooth = np.where(usable, ndimage.gaussian_filter(windows[0], self._sd), -np.inf)
        y, x = np.unravel_index(int(np.argmax(smooth)), smooth.shape)
        found = weighted_centroid(windows, WEIGHT * self._sd, start=np.array([[x, y]], dtype=np.float64))[0]
        shine = (
            float((windows[0] * _gaussian(found, WEIGHT * self._sd, pixels)).sum()) if np.isfinite(found).all() else 0.0
        )
        return found + corner, shine if usable.any() else 0.0

    def _within(self, far: float, places: FloatArray) -> BoolArray:
        """Which objects are nearer to each other than so many standard deviations, (n, n)."""
        distance = np.linalg.norm(places[:, None] - places, axis=2)
        return np.asarray((distance < far * self._sd) & ~np.eye(len(places), dtype=np.bool_))

    def _apart_again(self, light: FloatArray, pair: IntArray) -> FloatArray:
        """Where the lights of two objects that had come together are, (2, 2), in the order in which they moved least;
        NaN while there are not two. Where there is one, the last known positions move with it."""
        half = math.ceil((2 * _REACH + _MEET) * self._sd)
        middle = self.places[pair].mean(axis=0)
        (window,), (corner,) = cut_windows(light, middle[None], half)
        smooth = ndimage.gaussian_filter(window, self._sd / 2)
        y, x = np.nonzero(smooth == ndimage.maximum_filter(smooth, size=2 * math.ceil(self._sd) + 1))
        order = np.argsort(-smooth[y, x])
        # The light of a Gaussian under the weight, of its height after smoothing.
        brightness = smooth[y, x][order] * 2 * math.pi * 1.25 * self._sd**2 / (1 + 1 / WEIGHT**2)
        lights = (np.column_stack([x, y])[order] + corner)[brightness > _FAINT * self._usual[pair].min()]
        lights = separate(lights, _MEET * self._sd)
        others = np.delete(self.places, pair, axis=0)
        free = (np.linalg.norm(lights[:, None] - others, axis=2) > _MEET * self._sd).all(axis=1)
        lights = lights[free]
        if len(lights) == 1:
            self.places[pair] += lights[0] - middle
        if len(lights) < 2:
            return np.full((2, 2), np.nan)
        distance = np.linalg.norm(self.places[pair][:, None] - lights, axis=2)
        return np.asarray(lights[optimize.linear_sum_assignment(distance)[1]])

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


def _gaussian(place: FloatArray, sd: float, pixels: IntArray) -> FloatArray:
    """A Gaussian of height one about a place (x, y), (rows, columns)."""
    across, along = (np.exp(-(((pixels - at) / sd) ** 2) / 2) for at in place)
    return np.asarray(along[:, None] * across)


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
            found = trackpy.locate(np.maximum(light, 0.0), diameter, characterize=False)
        return np.asarray(found[["x", "y"]].to_numpy(dtype=np.float64))

    return locate


def find_objects(film: Film, settings: FilmSettings) -> Objects:
    """The brightest objects of a film's first frames, as many as requested.

    Raises `ImportingError` where there are fewer.
    """
    if settings.places and len(settings.places) != settings.track:
        raise ImportingError(f"{len(settings.places)} places are given for --track {settings.track}: give one for each")
    rows, columns = film.shape
    for x, y in settings.places:
        if not (-0.5 <= x <= columns - 0.5 and -0.5 <= y <= rows - 0.5):
            raise ImportingError(f"{film.name}: --at {x:g},{y:g} is outside its pictures of {columns} x {rows} pixels")
    light = FilmLight(film, settings)
    objects = _found(film, settings, light)
    if not (wrong := find_defects(film, light, objects.sd)).any():
        return objects
    # A hot pixel may have been taken for an object, or have narrowed one.
    objects = _found(film, settings, FilmLight(film, settings, wrong))
    return replace(objects, defects=wrong | find_defects(film, light, objects.sd))


def _found(film: Film, settings: FilmSettings, light: FilmLight) -> Objects:
    frames = list[FloatArray]()
    for frame in film.frames():
        frames.append(light.of(frame)[0])
        if len(frames) == FIRST_FRAMES:
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
        apart = separate(maxima.places[inside][order], margin)
        most = max(most, len(apart))
        if len(apart) >= settings.track:
            chosen = apart[: settings.track]
            return Objects(chosen, spot_sd(flat, chosen, _pitch(chosen, film.shape)))
    dark = "" if settings.invert else "; are they darker than the ground? then add --film invert"
    raise ImportingError(f"{film.name} shows {most} objects, {settings.track} are asked for with --track{dark}")


def separate(places: FloatArray, least: float) -> FloatArray:
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
