"""What the camera saw: frames, the last exposures under each other, the intensity profile.

The last exposures are one picture: a row each, the newest at the bottom, and time runs down inside a row
too, so that a path is drawn as a line through the blur that it made.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from aolink.colours import Colour, estimator_colour
from aolink.estimation.frames.spots import profiles
from aolink.exposure import Exposure
from aolink.optics.camera import pixel_noise_sd, to_density
from aolink.optics.kernel import exposure_density
from aolink.optics.sensor import BaseSensor, Sensor, SpotSensor
from aolink.viewing.palette import MEASURED, MISSING, NOTHING, TRUTH
from aolink.viewing.timebase import Timebase

FloatArray = NDArray[np.float64]
Paths = Mapping[str, Mapping[int, FloatArray]]
"""Name (``truth`` or an estimator's) and frame id -> spot position at each fast step, slope units, (n_steps,)."""

HISTORY = 32
"""Exposures in the picture of the last ones."""
PROFILE_ASPECT = 0.7
"""Height of the profile's plot over its width."""
_POINTS_IN_ROW = 21
"""Of a path inside one row of the picture: more than can be told apart."""
_POINTS_OF_SPOT = 51
"""Of a spot's path on the frame."""
_BRIGHTEST = 190
"""Grey of the brightest pixel: short of white, so that the paths stand out."""


def colour_of(name: str) -> Colour:
    """Colour of a path's name."""
    return TRUTH if name == "truth" else estimator_colour(name)


def density(sensor: Sensor, exposure: Exposure) -> FloatArray:
    """Measured intensity density, one over slope units, (pixels,); NaN where a pixel never came."""
    return np.where(exposure.mask, to_density(sensor, exposure.pixels), np.nan).ravel()


def centroid(sensor: Sensor, profile: FloatArray) -> float:
    """First moment of a profile of unit mass, slope units: the measurement y_1; missing pixels count as dark."""
    return float(np.nansum(sensor.centres * profile) * sensor.pixel_width)


def density_top(sensor: Sensor, exposures: Sequence[Exposure]) -> float:
    """Density at the top of the profile's plot: the brightest pixel of all but the most extreme exposures.

    Where all exposures are dark, the peak of a resting spot: the plot has the scale that it has with light.
    """
    brightest = [np.nanmax(density(sensor, e)) for e in exposures if e.mask.any()]
    top = float(np.percentile(brightest, 98)) if brightest else 0.0
    return top if top > pixel_noise_sd(sensor) else sensor.peak_density


def log_frames(stream: rr.RecordingStream, timebase: Timebase, exposures: Sequence[Exposure]) -> None:
    """Frames as the camera sent them, in counts: ``/camera/image``. All have one shape."""
    rows, columns = exposures[0].pixels.shape
    layout = rr.components.ImageFormat(width=columns, height=rows, color_model="L", channel_datatype="U16")
    stream.log("camera/image", rr.Image.from_fields(format=layout), static=True)
    buffers = np.stack([e.pixels.astype("<u2").ravel().view(np.uint8) for e in exposures])
    _send_at_starts(stream, "camera/image", timebase, exposures, rr.Image.columns(buffer=buffers))


def first_profiles(sensor: BaseSensor, exposures: Sequence[Exposure]) -> list[Exposure]:
    """The exposures as ``sensor.profile`` would have seen them: of many spots, the first one along x."""
    if not isinstance(sensor, SpotSensor):
        return list(exposures)
    seen = []
    for exposure in exposures:
        found = profiles(sensor, exposure.pixels, exposure.mask)
        counts: NDArray[Any] = found.counts[:1]
        seen.append(replace(exposure, pixels=counts, mask=found.mask[:1]))
    return seen


def log_spot_paths(
    stream: rr.RecordingStream, sensor: SpotSensor, timebase: Timebase, exposures: Sequence[Exposure], name: str,
    by_frame: Mapping[int, FloatArray],
) -> None:  # fmt: skip
    """Paths of all spots over the frame, in its pixels: ``/camera/image/path/NAME``.

    Parameters
    ----------
    by_frame:
        Frame id -> (n_outputs, n_steps), slope units.
    """
    known = [e for e in exposures if e.frame_id in by_frame]
    (rows, columns), (height, width) = sensor.grid, sensor.window
    corner = np.stack(np.meshgrid(width * np.arange(columns), height * np.arange(rows)), axis=-1).reshape(-1, 2)
    corner = corner[sensor.lit]
    strips = []
    for exposure in known:
        path = by_frame[exposure.frame_id]
        some = np.unique(np.linspace(0, path.shape[1] - 1, _POINTS_OF_SPOT).astype(int))
        inside = np.clip((path[:, some] - sensor.field[0]) / sensor.pixel_width, 0, width)
        spots = inside.reshape(sensor.spots, 2, -1).swapaxes(1, 2) + corner[:, None]
        strips.append(list(spots.astype(np.float32)))
    _send_strips(stream, f"camera/image/path/{name}", timebase, known, strips, colour_of(name), 1.5)


def log_history(
    stream: rr.RecordingStream,
    sensor: Sensor,
    timebase: Timebase,
    exposures: Sequence[Exposure],
    paths: Paths,
    top: float,
    *,
    since: int = 0,
) -> None:
    """The last `HISTORY` exposures under each other with the paths through them: ``/camera/history``.

    Parameters
    ----------
    exposures:
        In order. Each from number ``since`` on gets a picture of itself and those before it in this sequence.
    top:
        Density that is drawn brightest.
    """
    n = sensor.pixels
    profiles = np.stack([density(sensor, e) for e in exposures])
    grey = np.clip(np.nan_to_num(profiles) / top, 0, 1) ** 0.7 * _BRIGHTEST
    rows = np.repeat(grey[:, :, None], 3, axis=2).astype(np.uint8)
    rows[np.isnan(profiles)] = MISSING
    drawn = range(since, len(exposures))
    pictures = np.empty((len(drawn), HISTORY, n, 3), dtype=np.uint8)
    pictures[:] = MISSING
    for picture, j in zip(pictures, drawn, strict=True):
        picture[: max(0, HISTORY - 1 - (exposures[j].frame_id - exposures[0].frame_id))] = NOTHING
        for k, row in _visible(exposures, j):
            picture[row] = rows[k]
    layout = rr.components.ImageFormat(width=n, height=HISTORY, color_model="RGB", channel_datatype="U8")
    stream.log("camera/history", rr.Image.from_fields(format=layout), static=True)
    buffers = pictures.reshape(len(drawn), -1)
    _send_at_starts(stream, "camera/history", timebase, exposures[since:], rr.Image.columns(buffer=buffers))
    _log_centroids(stream, sensor, timebase, exposures, profiles, drawn)
    for name, by_frame in paths.items():
        _log_history_path(stream, sensor, timebase, exposures, name, by_frame, drawn)


def log_profile_axes(stream: rr.RecordingStream, sensor: Sensor, top: float) -> None:
    """Grid and numbers of the profile's plot, whose lines Rerun has no other view for: ``/profile/axes``."""
    low, high = sensor.field
    place = _profile_place(sensor, top)
    slopes = _ticks(low, high)
    heights = _ticks(0.0, top)
    grid = [place([(x, 0.0), (x, top)]) for x in slopes] + [place([(low, y), (high, y)]) for y in heights]
    fine = rr.Radius.ui_points(0.5)
    stream.log("profile/axes", rr.LineStrips2D(grid, colors=(90, 90, 90), radii=fine, draw_order=1.0), static=True)
    names = [f"{x:g}" for x in slopes] + [f"{y:g}" for y in heights[1:]]
    left = low - 0.05 * (high - low)
    below = _depth(sensor, top)
    places = place([(x, -below) for x in slopes] + [(left, y) for y in heights[1:]])
    numbers = rr.Points2D(places, labels=names, radii=rr.Radius.ui_points(0), colors=(140, 140, 140), show_labels=True)
    stream.log("profile/axes/numbers", numbers, static=True)


def log_measured_profile(
    stream: rr.RecordingStream, sensor: Sensor, timebase: Timebase, exposures: Sequence[Exposure], top: float
) -> None:
    """Measured density over slope as a staircase of pixels: ``/profile/measured``."""
    place = _profile_place(sensor, top)
    slopes = np.repeat(sensor.edges, 2)[1:-1]
    strips = [place(np.stack([slopes, np.repeat(np.nan_to_num(density(sensor, e)), 2)], axis=1)) for e in exposures]
    _send_strips(stream, "profile/measured", timebase, exposures, [[s] for s in strips], MEASURED, 1.0)


def log_predicted_profile(
    stream: rr.RecordingStream, sensor: Sensor, timebase: Timebase, exposures: Sequence[Exposure], name: str,
    by_frame: Mapping[int, FloatArray], top: float,
) -> None:  # fmt: skip
    """Density that the kernel leaves along a path: ``/profile/predicted/NAME``."""
    place = _profile_place(sensor, top)
    known = [e for e in exposures if e.frame_id in by_frame]
    profiles = [exposure_density(sensor.kernel, sensor.edges, by_frame[e.frame_id]) for e in known]
    strips = [[place(np.stack([sensor.centres, profile], axis=1))] for profile in profiles]
    _send_strips(stream, f"profile/predicted/{name}", timebase, known, strips, colour_of(name), 1.5)


def profile_bounds(sensor: Sensor, top: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Range of the profile's plot in its drawing units: x, and y downwards."""
    low, high = sensor.field
    width = high - low
    unit = PROFILE_ASPECT * width / top
    return (low - 0.1 * width, high + 0.05 * width), (-1.06 * top * unit, (_depth(sensor, top) + 0.14 * top) * unit)


def _depth(sensor: Sensor, top: float) -> float:
    """How far the noise reaches below zero: what is written under the plot goes there."""
    return max(0.08 * top, 2.5 * pixel_noise_sd(sensor))


def _profile_place(sensor: Sensor, top: float) -> Callable[[object], NDArray[np.float32]]:
    """From (slope, density) to where it is drawn: slope itself, density scaled and upwards."""
    scale = -PROFILE_ASPECT * (sensor.field[1] - sensor.field[0]) / top

    def place(points: object) -> NDArray[np.float32]:
        return np.asarray(np.asarray(points, dtype=np.float64) * [1.0, scale], dtype=np.float32)

    return place


def _ticks(low: float, high: float) -> list[float]:
    """Four to eight round numbers from ``low`` to ``high``."""
    rough = (high - low) / 5
    unit = 10.0 ** np.floor(np.log10(rough))
    step = unit * min((1, 2, 5, 10), key=lambda m: abs(m * unit - rough))
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    return [float(k * step) for k in np.arange(first, last + 1)]


def _visible(exposures: Sequence[Exposure], j: int) -> list[tuple[int, int]]:
    """Indices of exposure ``j`` and those before it that fit into the picture, each with its row."""
    newest = exposures[j].frame_id
    rows = [(k, HISTORY - 1 - (newest - exposures[k].frame_id)) for k in range(max(0, j - HISTORY + 1), j + 1)]
    return [(k, row) for k, row in rows if 0 <= row < HISTORY]


@lru_cache(maxsize=8)
def _points_in_row(n_steps: int) -> NDArray[np.int64]:
    """Which steps of a path are drawn in its row of the history."""
    return np.unique(np.linspace(0, n_steps - 1, min(_POINTS_IN_ROW, n_steps)).astype(np.int64))


def _log_history_path(
    stream: rr.RecordingStream, sensor: Sensor, timebase: Timebase, exposures: Sequence[Exposure], name: str,
    by_frame: Mapping[int, FloatArray], shown: range,
) -> None:  # fmt: skip
    drawn: dict[int, NDArray[np.float32]] = {}
    for k, exposure in enumerate(exposures):
        if (path := by_frame.get(exposure.frame_id)) is not None:
            some = _points_in_row(len(path))
            x = np.clip((path[some] - sensor.field[0]) / sensor.pixel_width, 0, sensor.pixels)
            drawn[k] = np.stack([x, (some + 0.5) / len(path)], axis=1).astype(np.float32)
    strips = [
        [drawn[k] + np.array([0, row], dtype=np.float32) for k, row in _visible(exposures, j) if k in drawn]
        for j in shown
    ]
    _send_strips(
        stream, f"camera/history/path/{name}", timebase, exposures[shown.start :], strips, colour_of(name), 1.5
    )


def _log_centroids(
    stream: rr.RecordingStream, sensor: Sensor, timebase: Timebase, exposures: Sequence[Exposure],
    profiles: FloatArray, shown: range,
) -> None:  # fmt: skip
    slopes = [
        centroid(sensor, p) if e.slopes is None else e.slopes[0] for e, p in zip(exposures, profiles, strict=True)
    ]
    x = [(slope - sensor.field[0]) / sensor.pixel_width for slope in slopes]
    points = [[(x[k], row + 0.5) for k, row in _visible(exposures, j)] for j in shown]
    path = "camera/history/centroid"
    stream.log(path, rr.Points2D.from_fields(colors=(235, 235, 235), radii=rr.Radius.ui_points(2.5)), static=True)
    columns = rr.Points2D.columns(positions=np.concatenate([np.array(p, dtype=np.float32) for p in points]))
    _send_at_starts(stream, path, timebase, exposures[shown.start :], columns.partition([len(p) for p in points]))


def _send_strips(
    stream: rr.RecordingStream, path: str, timebase: Timebase, exposures: Sequence[Exposure],
    strips: Sequence[Sequence[NDArray[np.float32]]], colour: Colour, radius: float,
) -> None:  # fmt: skip
    flat = [strip for group in strips for strip in group]
    if not flat:
        return
    stream.log(path, rr.LineStrips2D.from_fields(colors=colour, radii=rr.Radius.ui_points(radius)), static=True)
    alike = len({strip.shape for strip in flat}) == 1  # as one array it is packed at once, not strip by strip
    columns = rr.LineStrips2D.columns(strips=np.array(flat) if alike else flat).partition([len(g) for g in strips])
    _send_at_starts(stream, path, timebase, exposures, columns)


def _send_at_starts(
    stream: rr.RecordingStream,
    path: str,
    timebase: Timebase,
    exposures: Sequence[Exposure],
    columns: rr.ComponentColumnList,
) -> None:
    """Send one row an exposure, at its start."""
    steps = [e.first_step for e in exposures]
    stream.send_columns(path, timebase.at_steps(steps, [e.frame_id for e in exposures]), columns)
