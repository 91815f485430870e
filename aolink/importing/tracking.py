"""The exposures of objects that are followed through a film, each cut out as a spot in a window that follows it.

A window moves between two exposures by whole pixels, so that its object stays near its middle. For the plant that move
is an input: a rig whose inputs shift the positions of its spots, as `aolink.importing.first_rig` writes it, takes it
without an error. The positions of the objects in the single frames are the true path of an exposure that sums several.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import ImportingError
from aolink.exposure import Truth
from aolink.films.film import Film
from aolink.importing.frames import (
    FilmAccount,
    FilmLight,
    FilmSettings,
    FrameTimes,
    ImportedExposure,
    counts_of,
    grouped,
    rig_frame,
)
from aolink.importing.survey import Survey, reach, spread_in, survey
from aolink.importing.tracker import WEIGHT, find_objects
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.numerics.rms import rms
from aolink.optics.centroid import weighted_centroid
from aolink.optics.maxima import cut_windows
from aolink.optics.sensor import BaseSensor
from aolink.rig import Rig

STRAY = 1 / 8
"""Distance of an object from the middle of its window at which the window moves, as a share of the window."""


def tracked(
    film: Film, rig: Rig, settings: FilmSettings, times: FrameTimes, account: FilmAccount
) -> Iterator[ImportedExposure]:
    """The exposures of a film's objects, each in a window of its own.

    Raises `ImportingError` where the rig file describes another number of spots, or the film shows fewer objects.
    """
    sensor = rig.sensor
    if sensor.directions == 1 or sensor.spots != settings.track or sensor.spot_light is not None:
        raise ImportingError(
            f"--track {settings.track} needs a rig file with {settings.track} spots, sensor.kind = 'spots'"
            f" (aolink rig --from writes one), {rig.name} has {rig.n_outputs} slopes of a {sensor.shape[0]} x"
            f" {sensor.shape[1]} sensor"
        )
    if rig.sensor.row_starts_s.any():
        raise ImportingError(
            "with --track the rows of the rig's sensor are not the film's: leave out row_time and sensor.row_time_s."
            " An object's steps are then those of its own interval, later by its row in the film times the row time"
        )
    known = survey(film, settings, find_objects(film, settings))
    account.notes += tuple(known.notes())
    if settings.scale is not None:
        account.notes += (
            "--film scale is not used: with --track the objects have the light that the rig file gives them",
        )
    windows = _Windows(rig, sensor, known)
    far, spread = windows.reach, spread_in(known, settings.frames_per_exposure)
    light, step, area = FilmLight(film, settings, known.defects), 0, sensor.pixel_size
    for group in grouped(film, settings.frames_per_exposure, times.periods, light.of):
        blurs = _blurs(group.mean, known.last[max(group.first_frame - 1, 0)], known.sd, far, spread)
        values, usable, own = windows.cut(group.mean, ~group.bad, blurs)
        end = group.first_frame + settings.frames_per_exposure
        seen = np.isfinite(known.places[group.first_frame : end]).all(axis=2)
        usable &= np.asarray(seen.any(axis=0))[:, None, None]  # a window without its object shows nothing of it
        # Beyond an object's reach there is none of its light: light there belongs to others.
        values = np.where(own, values - known.ground[:, None, None], 0.0)
        shine = known.light * known.brightness[group.first_frame : end].mean()
        density = values / shine[:, None, None] / area
        counts = sensor.black_level + sensor.counts_per_density * windows.as_frame(density)
        pixels, mask = counts_of(counts, windows.as_frame(usable), rig, account)
        account.frames += settings.frames_per_exposure
        account.exposures += 1
        frame = rig_frame(group, times, rig, settings.frames_per_exposure, pixels, mask)
        whole = np.asarray(seen.all(axis=0))[:, None]
        path = windows.positions(np.where(whole, known.places[group.first_frame : end], np.nan))
        inputs = np.tile(rig.mirror.park, (frame.last_step + 1 - step, 1))
        step = frame.last_step + 1
        inputs[-1] += windows.follow(known.places[end - 1])
        truth = None
        if len(path.T) == rig.timing.exposure_steps and np.isfinite(path).any():
            follows = end < film.count and times.periods[end] == times.periods[end - 1] + 1
            after = windows.positions(known.places[end : end + 1] if follows else known.places[:0])
            truth = Truth(
                start_state=_state(rig, path[:, 0]), end_state=_state(rig, after[:, 0] if after.size else None),
                path=path, path_sd=rms(known.place_sd) * sensor.pixel_width,
            )  # fmt: skip
        yield ImportedExposure(frame=frame, inputs=inputs, truth=truth)


def _blurs(picture: FloatArray, last: FloatArray, sd: float, far: float, spread: float) -> FloatArray:
    """Positions of the objects' blurs in an exposure, after they were at ``last`` (n, 2).

    They are measured in the exposure alone: knowledge from the single frames must not show in its pixels.
    """
    windows, corners = cut_windows(picture, last, math.ceil(far + 2 * WEIGHT * sd))
    found = corners + weighted_centroid(windows, WEIGHT * math.sqrt(sd**2 + spread), start=last - corners)
    near = np.linalg.norm(found - last, axis=1) <= far  # False where it is NaN
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
        self.reach = reach(known, rig.timing.exposure_steps)
        """Distance from the middle of a blur beyond which there is none of its object's light, pixels."""
        self._corners = self._about(known.last[0])

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

        Pixels that may have light of two objects are not usable.
        """
        span = np.arange(self._side)
        x, y = (self._corners[:, d, None] + span for d in (0, 1))
        rows, columns = picture.shape
        inside = ((y >= 0) & (y < rows))[:, :, None] & ((x >= 0) & (x < columns))[:, None, :]
        at = np.clip(y, 0, rows - 1)[:, :, None], np.clip(x, 0, columns - 1)[:, None, :]
        distance = np.linalg.norm(places[:, None] - places, axis=2)
        shared = np.zeros(inside.shape, dtype=np.bool_)
        for k, other in np.argwhere((distance < 2 * self.reach) & ~np.eye(len(places), dtype=np.bool_)):
            shared[k] |= np.hypot(x[k] - places[other, 0], (y[k] - places[other, 1])[:, None]) <= self.reach
        away = np.hypot((x - places[:, :1])[:, None, :], (y - places[:, 1:])[:, :, None])
        near = away <= self.reach
        # Beyond the picture nothing is known of light that may be an object's own.
        return picture[at], ~near | (inside & usable[at] & ~shared), inside & near

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
