"""Views of the camera's frames: the frames, pages of exposures under each other, the intensity profile.

A page is one picture of neighbouring exposures: a row each, and time runs down inside a row too, so that a path is
drawn as a line through the blur that it made.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from aolink.colours import Colour, estimator_colour
from aolink.estimation.frames.measure import profiles_of
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import pixel_noise_sd, to_density
from aolink.optics.sensor import BaseSensor, Sensor
from aolink.plotting.style import extremes, hides_swings
from aolink.viewing.entities import CENTROIDS, FRAME, PAGE, PROFILE, ROW_NOW
from aolink.viewing.palette import MEASURED, MISSING, NOTHING, TRUTH
from aolink.viewing.series import POINTS, Drawing
from aolink.viewing.timebase import Timebase

PathsByFrame = Mapping[str, Mapping[int, FloatArray]]
"""Name (``truth`` or an estimator's) and frame id -> spot position at each fast step, slope units, (n_steps,)."""

HISTORY = 32
"""Exposures on a page."""
_PANELS = (0.20, 0.16, 0.32)
"""Heights of the profile's panels as shares of their width: path, histogram of the path, intensity."""
_ALONE = (0.0, 0.0, 0.6)
"""The same where the intensity is drawn alone."""
_GAP = 0.03
"""Gap between the panels, in the same unit."""
_KEY_ROW, _KEY_COLUMNS = 0.095, 5
"""Height of a row of the key as a share of the width, and number of names in it."""
_MOST = 1.0 + _GAP / _PANELS[2]
"""Highest predicted intensity drawn, relative to the panel's top: a higher one would reach into the panel above."""
_LIGHT = 2.5
"""Top of the histogram divided by that of the intensity, which is the histogram blurred."""
_POINTS_IN_ROW = 21
"""Points of a path inside one row of a page: more than the eye can separate."""
_POINTS_IN_HIGH_ROW = 101
"""The same where a few rows of a page are shown."""
_SWINGS_IN_ROW = 5
"""A path over some pixels that a curve through this many points would miss is drawn as its range, because a row is not
high."""
_PIXELS = 6.0
"""Pixels that a path has to move by to be drawn as its range."""
_POINTS_OF_SPOT = 51
"""Points of a spot's path on the frame."""
_ERF_AT = np.linspace(-5.0, 5.0, 1001)
_ERF = np.array([math.erf(u) for u in _ERF_AT.tolist()])
"""The error function; linear interpolation between these points is wrong by 1e-5. Loading SciPy's takes a third of a
second."""
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


def density_top(sensor: Sensor, exposures: Sequence[Exposure], *, alone: bool = False) -> float:
    """Density at the top of the profile's plot: the brightest pixel of all but the most extreme exposures.

    Where all exposures are dark, it is the peak of a resting spot, so that the plot has the same scale as with light;
    so it is where the intensity is drawn ``alone``, so that no predicted one is cut.
    """
    brightest = [np.nanmax(density(sensor, e)) for e in exposures if e.mask.any()]
    top = float(np.percentile(brightest, 98)) if brightest else 0.0
    return top if top > pixel_noise_sd(sensor) and not alone else max(top, sensor.peak_density)


def log_frames(drawing: Drawing, timebase: Timebase, exposures: Sequence[Exposure]) -> None:
    """Frames as the camera sent them, in counts: ``/camera/image``. All have one shape."""
    rows, columns = exposures[0].pixels.shape
    layout = rr.components.ImageFormat(width=columns, height=rows, color_model="L", channel_datatype="U16")
    drawing.log(FRAME, rr.Image.from_fields(format=layout))
    buffers = np.stack([e.pixels.astype("<u2").ravel().view(np.uint8) for e in exposures])
    _send_at_starts(drawing, FRAME, timebase, exposures, rr.Image.columns(buffer=buffers))


def one_profile(sensor: BaseSensor, exposures: Sequence[Exposure], output: int) -> list[Exposure]:
    """The exposures as ``sensor.profile`` would have seen them: of many spots, one along x or y."""
    seen = []
    for exposure in exposures:
        found = profiles_of(sensor, exposure.pixels, exposure.mask)
        counts: NDArray[Any] = found.counts[output : output + 1]
        seen.append(replace(exposure, pixels=counts, mask=found.mask[output : output + 1]))
    return seen


def log_spot_paths(
    drawing: Drawing, sensor: BaseSensor, timebase: Timebase, exposures: Sequence[Exposure], name: str,
    by_frame: Mapping[int, FloatArray],
) -> None:  # fmt: skip
    """Paths of all spots over the frame, in its pixels: ``/camera/image/path/NAME``.

    Parameters
    ----------
    by_frame:
        Frame id -> (n_outputs, n_steps), slope units.
    """
    known = [e for e in exposures if e.frame_id in by_frame]
    width = sensor.profile.pixels
    corner = width * np.stack(np.divmod(sensor.lit, sensor.grid[1])[::-1], axis=-1)
    strips = []
    for exposure in known:
        path = by_frame[exposure.frame_id]
        some = _drawn(path.shape[1], _POINTS_OF_SPOT)
        inside = np.clip((path[:, some] - sensor.field[0]) / sensor.pixel_width, 0, width)
        spots = inside.reshape(sensor.spots, 2, -1).swapaxes(1, 2) + corner[:, None]
        strips.append(list(spots[np.isfinite(spots).all(axis=(1, 2))].astype(np.float32)))
    _send_strips(drawing, f"{FRAME}/path/{name}", timebase, known, strips, colour_of(name), 1.5)


def page_of(exposure: Exposure, first_frame: int) -> int:
    """Number of the page that an exposure is on, in a session that began with the given frame."""
    return (exposure.frame_id - first_frame) // HISTORY


def log_page(
    drawing: Drawing, sensor: Sensor, timebase: Timebase, exposures: Sequence[Exposure], paths: PathsByFrame,
    top: float, *, until: int | None = None, at: Exposure | None = None,
) -> None:  # fmt: skip
    """A page of exposures under each other with the paths through them: ``/camera/history``.

    Parameters
    ----------
    exposures:
        The exposures of one page, in order.
    top:
        Density that is drawn brightest.
    until:
        The frame that came after them: frames on the page before it that are not among the exposures were lost.
    at:
        The exposure at whose start the page appears; by default the first.
    """
    n, first = sensor.pixels, timebase.frame_id
    origin = first + HISTORY * page_of(exposures[0], first)
    rows = [e.frame_id - origin for e in exposures]
    profiles = np.stack([density(sensor, e) for e in exposures])
    grey = np.clip(np.nan_to_num(profiles) / top, 0, 1) ** 0.7 * _BRIGHTEST
    shades = np.repeat(grey[:, :, None], 3, axis=2).astype(np.uint8)
    shades[np.isnan(profiles)] = MISSING
    picture = np.empty((HISTORY, n, 3), dtype=np.uint8)
    picture[:] = NOTHING
    picture[: rows[-1] if until is None else max(0, until - origin)] = MISSING
    picture[rows] = shades
    layout = rr.components.ImageFormat(width=n, height=HISTORY, color_model="RGB", channel_datatype="U8")
    drawing.log(PAGE, rr.Image.from_fields(format=layout))
    shown = [at or exposures[0]]
    _send_at_starts(drawing, PAGE, timebase, shown, rr.Image.columns(buffer=picture.reshape(1, -1)))
    slopes = [
        centroid(sensor, p) if e.slopes is None else e.slopes[drawing.chosen.outputs[0]]
        for e, p in zip(exposures, profiles, strict=True)
    ]
    points = np.stack([(np.array(slopes) - sensor.field[0]) / sensor.pixel_width, np.array(rows) + 0.5], axis=1)
    look = rr.Points2D.from_fields(colors=(235, 235, 235), radii=rr.Radius.ui_points(2.5))
    drawing.log(CENTROIDS, look)
    columns = rr.Points2D.columns(positions=points.astype(np.float32)).partition([len(points)])
    _send_at_starts(drawing, CENTROIDS, timebase, shown, columns)
    high = drawing.near is not None
    for name, by_frame in paths.items():
        strips = []
        for row, exposure in zip(rows, exposures, strict=True):
            if (path := by_frame.get(exposure.frame_id)) is not None:
                if not high and np.ptp(path) > _PIXELS * sensor.pixel_width and hides_swings(path, _SWINGS_IN_ROW):
                    edges: tuple[FloatArray, ...] = extremes(path, _SWINGS_IN_ROW)
                    places = (np.arange(len(edges[0])) + 0.5) / len(edges[0])
                else:
                    some = _drawn(len(path), _POINTS_IN_HIGH_ROW if high else _POINTS_IN_ROW)
                    edges, places = (path[some],), (some + 0.5) / len(path)
                for edge in edges:
                    x = np.clip((edge - sensor.field[0]) / sensor.pixel_width, 0, n)
                    strips.append(np.stack([x, row + places], axis=1).astype(np.float32))
        if strips:
            width = 0.8 if high else 1.5
            _send_strips(drawing, f"{PAGE}/path/{name}", timebase, shown, [strips], colour_of(name), width)


def log_now(drawing: Drawing, sensor: Sensor, timebase: Timebase, exposures: Sequence[Exposure]) -> None:
    """A border about each exposure's row of its page: ``/camera/history/now``."""
    corners = np.array([(0, 0), (sensor.pixels, 0), (sensor.pixels, 1), (0, 1), (0, 0)], dtype=np.float32)
    rows = [(e.frame_id - timebase.frame_id) % HISTORY for e in exposures]
    strips = [[corners + np.array((0, row), dtype=np.float32)] for row in rows]
    _send_strips(drawing, ROW_NOW, timebase, exposures, strips, (235, 235, 235), 1.0)


def log_profile_axes(drawing: Drawing, sensor: Sensor, top: float, names: Sequence[str]) -> None:
    """Grids, numbers and the key of the profile's plot, which Rerun has no view for: ``/profile/axes``.

    The key has the colour of each of ``names`` and of the measured profile; they are the same in all views.
    """
    low, high = drawing.near or sensor.field
    place = Panels(sensor, top, drawing.near)
    slopes, heights = _ticks(low, high), _ticks(0.0, top)
    edges = [place.path, place.histogram, place.intensity] if drawing.near is None else [place.intensity]
    grid = [panel(np.array([(x, 0.0), (x, 1.0)])) for panel in edges for x in slopes]
    grid += [panel(np.array([(low, y), (high, y)])) for panel in edges for y in (0.0, 1.0)]
    grid += [place.intensity(np.array([(low, y / top), (high, y / top)])) for y in heights[1:]]
    fine = rr.Radius.ui_points(0.5)
    drawing.log(f"{PROFILE}/axes", rr.LineStrips2D(grid, colors=(90, 90, 90), radii=fine, draw_order=1.0))
    left = low - 0.05 * (high - low)
    below = place.depth / top + 0.08
    places = [place.intensity(np.array([(x, -below)])) for x in slopes]
    places += [place.intensity(np.array([(left, y / top)])) for y in heights[1:]]
    numbers = [f"{x:g}" for x in slopes] + [f"{y:g}" for y in heights[1:]]
    points = rr.Points2D(
        np.concatenate(places), labels=numbers, radii=rr.Radius.ui_points(0), colors=(140, 140, 140), show_labels=True
    )
    drawing.log(f"{PROFILE}/axes/numbers", points)
    shown = ["measured", *names]
    colours = [MEASURED, *map(colour_of, names)]
    at = [place.key(k) for k in range(len(shown))]
    named = rr.Points2D(at, labels=shown, colors=colours, radii=rr.Radius.ui_points(0), show_labels=True)
    drawing.log(f"{PROFILE}/key", named)


def log_measured_profile(
    drawing: Drawing, sensor: Sensor, timebase: Timebase, exposures: Sequence[Exposure], top: float
) -> None:
    """Measured density over slope as a staircase of pixels: ``/profile/measured``."""
    place = Panels(sensor, top, drawing.near)
    slopes = np.repeat(sensor.edges, 2)[1:-1]
    seen = [np.repeat(np.nan_to_num(density(sensor, e)), 2) / top for e in exposures]
    strips = [[place.intensity(np.stack([slopes, each], axis=1))] for each in seen]
    _send_strips(drawing, f"{PROFILE}/measured", timebase, exposures, strips, MEASURED, 1.0)


def log_path_profile(
    drawing: Drawing, sensor: Sensor, timebase: Timebase, exposures: Sequence[Exposure], name: str,
    by_frame: Mapping[int, FloatArray], top: float, light: float = 1.0,
) -> None:  # fmt: skip
    """The explanation of the blur: a path, its histogram, and the intensity that the kernel makes of it.

    ``/profile/path/NAME`` (time runs upwards), ``/profile/histogram/NAME`` and ``/profile/predicted/NAME``, both as
    densities over the same slopes; the last one alone for a layout that is about one exposure. ``light`` is the spot's
    share of its light.
    """
    place = Panels(sensor, top, drawing.near)
    known = [e for e in exposures if e.frame_id in by_frame]
    colour, field, edges, centres = colour_of(name), sensor.field, sensor.edges, sensor.centres
    lines, stairs, profiles = [], [], []
    for exposure in known:
        path = by_frame[exposure.frame_id]
        some = _drawn(len(path), POINTS)
        shares = np.clip((some + 0.5) / len(path), 0, 1)
        lines.append([place.path(np.stack([np.clip(path[some], *field), shares], axis=1))])
        stairs.append([place.histogram(_histogram(sensor, path, _LIGHT * top))])
        predicted = light * _predicted(sensor, edges, path) / top
        profiles.append([place.intensity(np.stack([centres, np.minimum(predicted, _MOST)], axis=1))])
    if drawing.near is None:
        _send_strips(drawing, f"{PROFILE}/path/{name}", timebase, known, lines, colour, 1.2)
        _send_strips(drawing, f"{PROFILE}/histogram/{name}", timebase, known, stairs, colour, 1.2)
    _send_strips(drawing, f"{PROFILE}/predicted/{name}", timebase, known, profiles, colour, 1.5)


def profile_bounds(
    sensor: Sensor, top: float, names: int, near: tuple[float, float] | None = None
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Range of the profile's plot with a key of a number of names, in its drawing units: x, and y downwards."""
    (low, high), place = near or sensor.field, Panels(sensor, top, near)
    bottom = place.intensity(np.array([(low, -place.depth / top - 0.22)]))[0, 1]
    return (low - 0.1 * (high - low), high + 0.05 * (high - low)), (
        float(place.key(names - 1)[1]) - 0.08 * (high - low),
        float(bottom),
    )


class Panels:
    """The places of the three panels of the profile's plot in its drawing units: slope to the right, y downwards.

    The path is on top, then its histogram, and the intensity's zero is at y = 0. The intensity is alone where a part of
    the field is given, ``near``.

    Each panel takes points (slope, height from 0 to 1), (n, 2).
    """

    def __init__(self, sensor: Sensor, top: float, near: tuple[float, float] | None = None) -> None:
        self._low, high = near or sensor.field
        self._width, self._heights = high - self._low, _ALONE if near else _PANELS
        self.depth = max(0.08 * top, 2.5 * pixel_noise_sd(sensor))
        """How far the noise reaches below zero, in density; labels under the plot stand below that."""

    def path(self, points: FloatArray) -> NDArray[np.float32]:
        """Points of the path; time in the exposure runs upwards."""
        return self._panel(points, 0)

    def histogram(self, points: FloatArray) -> NDArray[np.float32]:
        """Points of the histogram; time at each position runs upwards."""
        return self._panel(points, 1)

    def intensity(self, points: FloatArray) -> NDArray[np.float32]:
        """Points of the intensity; its density runs upwards."""
        return self._panel(points, 2)

    def key(self, number: int) -> NDArray[np.float32]:
        """Middle of the ``number``-th name, above the panels, (2,)."""
        row, column = divmod(number, _KEY_COLUMNS)
        return np.array(
            [
                self._low + (column + 0.5) / _KEY_COLUMNS * self._width,
                -(sum(self._heights) + 2 * _GAP + (row + 1) * _KEY_ROW) * self._width,
            ],
            dtype=np.float32,
        )

    def _panel(self, points: FloatArray, number: int) -> NDArray[np.float32]:
        base = -self._width * (sum(self._heights[number + 1 :]) + (2 - number) * _GAP)
        height = self._heights[number] * self._width
        return np.stack([points[:, 0], base - height * points[:, 1]], axis=1, dtype=np.float32)


def _predicted(sensor: Sensor, edges: FloatArray, path: FloatArray) -> FloatArray:
    """Density in each pixel after an exposure, as by `exposure_density`, accurate enough for a drawing."""
    u = (edges - path[:, None]) / math.sqrt(2 * sensor.kernel.variance)
    return np.asarray(np.diff(np.interp(u, _ERF_AT, _ERF).mean(axis=0)) / (2 * sensor.pixel_width))


def _histogram(sensor: Sensor, path: FloatArray, top: float) -> FloatArray:
    """Histogram of a path as stairs of half a pixel, (n, 2): slope, density divided by ``top``."""
    half = 0.5 * sensor.pixel_width
    last = 2 * sensor.pixels - 1
    bins = np.clip(((path - sensor.field[0]) / half).astype(int), 0, last)
    low, high = int(bins.min()), int(bins.max())
    density = np.bincount(bins - low, minlength=high - low + 1) / (len(path) * half) / top
    edges = sensor.field[0] + half * np.arange(low, high + 2)
    heights = np.concatenate([[0.0], np.repeat(np.minimum(density, 1.0), 2), [0.0]])
    return np.stack([np.repeat(edges, 2), heights], axis=1)


def _ticks(low: float, high: float) -> list[float]:
    """Four to eight round numbers from ``low`` to ``high``."""
    rough = (high - low) / 5
    unit = 10.0 ** np.floor(np.log10(rough))
    step = unit * min((1, 2, 5, 10), key=lambda m: abs(m * unit - rough))
    first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
    return [float(k * step) + 0.0 for k in np.arange(first, last + 1)]  # -0.0 would be written as it is


@lru_cache(maxsize=8)
def _drawn(n_steps: int, most: int) -> NDArray[np.int64]:
    """The steps of a path that are drawn, at most a given number."""
    return np.unique(np.linspace(0, n_steps - 1, min(most, n_steps)).astype(np.int64))


def _send_strips(
    drawing: Drawing, path: str, timebase: Timebase, exposures: Sequence[Exposure],
    strips: Sequence[Sequence[NDArray[np.float32]]], colour: Colour, radius: float,
) -> None:  # fmt: skip
    flat = [strip for group in strips for strip in group]
    if not flat:
        return
    drawing.log(path, rr.LineStrips2D.from_fields(colors=colour, radii=rr.Radius.ui_points(radius)))
    alike = len({strip.shape for strip in flat}) == 1  # as one array it is packed at once, not strip by strip
    columns = rr.LineStrips2D.columns(strips=np.array(flat) if alike else flat).partition([len(g) for g in strips])
    _send_at_starts(drawing, path, timebase, exposures, columns)


def _send_at_starts(
    drawing: Drawing, path: str, timebase: Timebase, exposures: Sequence[Exposure], columns: rr.ComponentColumnList
) -> None:
    """Send one row an exposure, at its start."""
    steps = [e.first_step for e in exposures]
    drawing.send_columns(path, timebase.at_steps(steps, [e.frame_id for e in exposures]), columns)
