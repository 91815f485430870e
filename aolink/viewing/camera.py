"""Views of the camera's frames: the frames, pages of exposures under each other, the intensity profile.

A page is one picture of neighbouring exposures: a row each, and time runs down inside a row too, so that a path is
drawn as a line through the blur that it made.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from aolink.colours import Colour, estimator_colour
from aolink.exposure import Exposure
from aolink.gathered import Blur, extremes, hides_swings, paths_of
from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import pixel_noise_sd
from aolink.optics.sensor import BaseSensor, Sensor
from aolink.series import Step
from aolink.viewing.entities import CENTROIDS, FRAME, PAGE, PROFILE, ROW_NOW
from aolink.viewing.palette import MEASURED, MISSING, NOTHING, TRUTH
from aolink.viewing.series import POINTS, Drawing, send_pictures
from aolink.viewing.timebase import Timebase

HISTORY = 32
"""Exposures on a page."""
_PANELS = (0.20, 0.16, 0.32)
"""Heights of the profile's panels as shares of their width: path, histogram of the path, intensity."""
_GAP = 0.03
"""Gap between the panels, in the same unit."""
_KEY_ROW, _KEY_COLUMNS = 0.095, 5
"""Height of a row of the key as a share of the width, and number of names in it."""
_MOST = 1.0 + _GAP / _PANELS[2]
"""Highest predicted intensity drawn, relative to the panel's top: a higher one would reach into the panel above."""
_LIGHT = 2.5
"""Top of the histogram divided by that of the intensity, which is the histogram blurred."""
_POINTS_IN_ROW = 21
"""Points of a path inside one row of a page, more than the eye can separate."""
_SWINGS_IN_ROW = 5
"""A path over some pixels that a curve through this many points would miss is drawn as its range, because a row is not
high."""
_PIXELS = 6.0
"""Pixels that a path has to move by to be drawn as its range."""
_POINTS_OF_SPOT = 51
"""Points of a spot's path on the frame."""
_BRIGHTEST = 190
"""Grey of the brightest pixel: short of white, so that the paths stand out."""
_PALE: Colour = (235, 235, 235)


def colour_of(name: str) -> Colour:
    """Colour of a path's name."""
    return TRUTH if name == "truth" else estimator_colour(name)


def log_camera(
    drawing: Drawing, timebase: Timebase, steps: Sequence[Step], *, following: Exposure | None = None
) -> None:
    """Send frames, pages and profiles of exposures.

    ``following`` is the exposure after them. The first ones set the scale of the profile's plot. A page appears where
    its exposures begin; in a live session it grows with them.
    """
    sensor = drawing.rig.sensor
    log_frames(drawing, timebase, [each.exposure for each in steps])
    if sensor.directions == 2:
        _log_spot_paths(drawing, sensor, timebase, steps)
    # The following is about one slope over time.
    blurs = [Blur.of(drawing.rig, each, drawing.outputs[0]) for each in steps]
    if drawing.top is None:
        drawing.top = _density_top(blurs)
        truth = ["truth"] if any(each.exposure.truth is not None for each in steps) else []
        _log_profile_axes(drawing, sensor.profile, drawing.top, [*truth, *drawing.estimators])
    pages: dict[int, list[Blur]] = {}
    for each in [*drawing.page, *blurs]:
        pages.setdefault(page_of(each.exposure, timebase.frame_id), []).append(each)
    for number, page in pages.items():
        after = next((p[0].exposure for k, p in pages.items() if k > number), following)
        _log_page(drawing, timebase, page, drawing.top, after, page[-1 if drawing.live else 0].exposure)
    drawing.page = page if drawing.live else []
    width = sensor.profile.pixels
    corners = np.array([(0, 0), (width, 0), (width, 1), (0, 1), (0, 0)])
    exposures = [each.exposure for each in blurs]
    rows = [corners + np.array((0, (each.frame_id - timebase.frame_id) % HISTORY)) for each in exposures]
    _send_strips(drawing, ROW_NOW, timebase, exposures, [[row] for row in rows], _PALE, 1.0)
    _log_profile(drawing, timebase, blurs, drawing.top)


def log_frames(drawing: Drawing, timebase: Timebase, exposures: Sequence[Exposure]) -> None:
    """Frames as the camera sent them, in counts: ``/camera/image``. All have one shape."""
    send_pictures(drawing, FRAME, timebase.at_starts(exposures), [each.pixels.astype("<u2") for each in exposures])


def _log_spot_paths(drawing: Drawing, sensor: BaseSensor, timebase: Timebase, steps: Sequence[Step]) -> None:
    """Paths of all spots over the frame, in its pixels: ``/camera/image/path/NAME``."""
    width = sensor.profile.pixels
    corner = width * np.stack(np.divmod(sensor.lit, sensor.grid[1])[::-1], axis=-1)

    def spots(path: FloatArray) -> list[FloatArray]:
        inside = np.clip(
            (path[:, _drawn(path.shape[1], _POINTS_OF_SPOT)] - sensor.field[0]) / sensor.pixel_width, 0, width
        )
        strips = inside.reshape(sensor.spots, 2, -1).swapaxes(1, 2) + corner[:, None]
        return list(strips[np.isfinite(strips).all(axis=(1, 2))])

    paths = [(each.exposure, paths_of(each)) for each in steps]
    for name in dict.fromkeys(name for _, found in paths for name in found):
        known = [(exposure, found[name]) for exposure, found in paths if name in found]
        strips = [spots(path) for _, path in known]
        exposures = [exposure for exposure, _ in known]
        _send_strips(drawing, f"{FRAME}/path/{name}", timebase, exposures, strips, colour_of(name), 1.5)


def page_of(exposure: Exposure, first_frame: int) -> int:
    """Number of the page that an exposure is on, in a session that began with the given frame."""
    return (exposure.frame_id - first_frame) // HISTORY


def _density_top(blurs: Sequence[Blur]) -> float:
    """Density at the top of the profile's plot: the brightest pixel of all but the most extreme exposures.

    Where all exposures are dark, it is the peak of a resting spot, so that the plot has the same scale as with light.
    """
    brightest = [np.nanmax(each.measured) for each in blurs if np.isfinite(each.measured).any()]
    top, line = float(np.percentile(brightest, 98)) if brightest else 0.0, blurs[0].line
    return top if top > pixel_noise_sd(line) else max(top, line.peak_density)


def _log_page(
    drawing: Drawing, timebase: Timebase, page: Sequence[Blur], top: float, following: Exposure | None, at: Exposure
) -> None:
    """A page of exposures under each other with the paths through them: ``/camera/history``.

    Parameters
    ----------
    page:
        The exposures of one page, in order.
    top:
        Density that is drawn brightest.
    following:
        The exposure after them: frames on the page before it that are not among the exposures were lost.
    at:
        The exposure at whose start the page appears.
    """
    line, first = page[0].line, timebase.frame_id
    origin = first + HISTORY * page_of(page[0].exposure, first)
    rows = [each.exposure.frame_id - origin for each in page]
    profiles = np.stack([each.measured for each in page])
    grey = np.clip(np.nan_to_num(profiles) / top, 0, 1) ** 0.7 * _BRIGHTEST
    shades = np.repeat(grey[:, :, None], 3, axis=2).astype(np.uint8)
    shades[np.isnan(profiles)] = MISSING
    picture = np.empty((HISTORY, line.pixels, 3), dtype=np.uint8)
    picture[:] = NOTHING
    picture[: rows[-1] if following is None else max(0, following.frame_id - origin)] = MISSING
    picture[rows] = shades
    send_pictures(drawing, PAGE, timebase.at_starts([at]), [picture])
    centroids = np.array([each.centroid for each in page])
    points = np.stack([(centroids - line.field[0]) / line.pixel_width, np.array(rows) + 0.5], axis=1)
    drawing.log(CENTROIDS, rr.Points2D.from_fields(colors=_PALE, radii=rr.Radius.ui_points(2.5)))
    columns = rr.Points2D.columns(positions=points.astype(np.float32)).partition([len(points)])
    drawing.send_columns(CENTROIDS, timebase.at_starts([at]), columns)
    for name in dict.fromkeys(name for each in page for name in each.paths):
        strips = []
        for row, path in [(row, each.paths[name]) for row, each in zip(rows, page, strict=True) if name in each.paths]:
            if np.ptp(path) > _PIXELS * line.pixel_width and hides_swings(path, _SWINGS_IN_ROW):
                edges: tuple[FloatArray, ...] = extremes(path, _SWINGS_IN_ROW)
                places = (np.arange(len(edges[0])) + 0.5) / len(edges[0])
            else:
                some = _drawn(len(path), _POINTS_IN_ROW)
                edges, places = (path[some],), (some + 0.5) / len(path)
            for edge in edges:
                x = np.clip((edge - line.field[0]) / line.pixel_width, 0, line.pixels)
                strips.append(np.stack([x, row + places], axis=1))
        _send_strips(drawing, f"{PAGE}/path/{name}", timebase, [at], [strips], colour_of(name), 1.5)


def _log_profile_axes(drawing: Drawing, sensor: Sensor, top: float, names: Sequence[str]) -> None:
    """Grids, numbers and the key of the profile's plot, which Rerun has no view for: ``/profile/axes``.

    The key has the colour of each of ``names`` and of the measured profile; they are the same in all views.
    """
    low, high = sensor.field
    place = Panels(sensor, top)
    slopes, heights = _ticks(low, high), _ticks(0.0, top)[1:]
    grid = [place(np.array([(x, 0.0), (x, 1.0)]), k) for k in range(3) for x in slopes]
    grid += [place(np.array([(low, y), (high, y)]), k) for k in range(3) for y in (0.0, 1.0)]
    grid += [place(np.array([(low, y / top), (high, y / top)])) for y in heights]
    fine = rr.Radius.ui_points(0.5)
    drawing.log(f"{PROFILE}/axes", rr.LineStrips2D(grid, colors=(90, 90, 90), radii=fine, draw_order=1.0))
    left, below = low - 0.05 * (high - low), place.depth / top + 0.08
    places = place(np.array([*((x, -below) for x in slopes), *((left, y / top) for y in heights)]))
    numbers = [f"{x:g}" for x in (*slopes, *heights)]
    named, keys = ["measured", *names], [place.key(k) for k in range(len(names) + 1)]
    for entity, at, texts, colours in (
        ("axes/numbers", places, numbers, [(140, 140, 140)] * len(numbers)),
        ("key", keys, named, [MEASURED, *map(colour_of, names)]),
    ):
        points = rr.Points2D(at, labels=texts, radii=rr.Radius.ui_points(0), colors=colours, show_labels=True)
        drawing.log(f"{PROFILE}/{entity}", points)


def _log_profile(drawing: Drawing, timebase: Timebase, blurs: Sequence[Blur], top: float) -> None:
    """The measured density over slope as a staircase of pixels, ``/profile/measured``; and the explanation of the blur:
    a path, its histogram, and the intensity that the kernel makes of it.

    ``/profile/path/NAME`` (time runs upwards), ``/profile/histogram/NAME`` and ``/profile/predicted/NAME``, both as
    densities over the same slopes.
    """
    line = blurs[0].line
    place = Panels(line, top)

    def send(what: str, known: Sequence[Blur], strips: list[FloatArray], colour: Colour, width: float) -> None:
        exposures, of_each = [each.exposure for each in known], [[strip] for strip in strips]
        _send_strips(drawing, f"{PROFILE}/{what}", timebase, exposures, of_each, colour, width)

    def path_of(path: FloatArray) -> FloatArray:
        some = _drawn(len(path), POINTS)
        return place(np.stack([np.clip(path[some], *line.field), np.clip((some + 0.5) / len(path), 0, 1)], axis=1), 0)

    def histogram_of(density: FloatArray, edges: FloatArray) -> FloatArray:
        heights = np.repeat(np.minimum(density / (_LIGHT * top), 1.0), 2)
        return place(np.stack([np.repeat(edges, 2), np.pad(heights, 1)], axis=1), 1)

    def intensity_of(slopes: FloatArray, density: FloatArray) -> FloatArray:
        return place(np.stack([slopes, np.minimum(density / top, _MOST)], axis=1))

    stairs = np.repeat(line.edges, 2)[1:-1]
    seen = [place(np.stack([stairs, np.repeat(np.nan_to_num(each.measured), 2) / top], axis=1)) for each in blurs]
    send("measured", blurs, seen, MEASURED, 1.0)
    for name in dict.fromkeys(name for each in blurs for name in each.paths):
        known, colour = [each for each in blurs if name in each.paths], colour_of(name)
        send(f"path/{name}", known, [path_of(each.paths[name]) for each in known], colour, 1.2)
        send(f"histogram/{name}", known, [histogram_of(*each.histogram(name)) for each in known], colour, 1.2)
        predicted = [intensity_of(line.centres, each.predicted(name)) for each in known]
        send(f"predicted/{name}", known, predicted, colour, 1.5)


def profile_bounds(sensor: Sensor, top: float, names: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Range of the profile's plot with a key of a number of names, in its drawing units: x, and y downwards."""
    (low, high), place = sensor.field, Panels(sensor, top)
    bottom = place(np.array([(low, -place.depth / top - 0.22)]))[0, 1]
    upper = float(place.key(names - 1)[1]) - 0.08 * (high - low)
    return (low - 0.1 * (high - low), high + 0.05 * (high - low)), (upper, float(bottom))


class Panels:
    """The places of the three panels of the profile's plot in its drawing units: slope to the right, y downwards.

    The path is on top, its time running upwards, then its histogram, and the intensity's zero is at y = 0.
    """

    def __init__(self, sensor: Sensor, top: float) -> None:
        self._low, high = sensor.field
        self._width = high - self._low
        self.depth = max(0.08 * top, 2.5 * pixel_noise_sd(sensor))
        """How far the noise reaches below zero, in density; labels under the plot stand below that."""

    def __call__(self, points: FloatArray, panel: int = 2) -> FloatArray:
        """The places of points (slope, height from 0 to 1), (n, 2), of a panel: path 0, histogram 1, intensity 2."""
        base = -self._width * (sum(_PANELS[panel + 1 :]) + (2 - panel) * _GAP)
        return np.stack([points[:, 0], base - _PANELS[panel] * self._width * points[:, 1]], axis=1)

    def key(self, number: int) -> FloatArray:
        """Middle of the ``number``-th name, above the panels, (2,)."""
        row, column = divmod(number, _KEY_COLUMNS)
        above = -(sum(_PANELS) + 2 * _GAP + (row + 1) * _KEY_ROW) * self._width
        return np.array([self._low + (column + 0.5) / _KEY_COLUMNS * self._width, above])


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
    strips: Sequence[Sequence[FloatArray]], colour: Colour, radius: float,
) -> None:  # fmt: skip
    """Send lines of each exposure, (points, 2) each, at its start."""
    flat = [strip.astype(np.float32) for group in strips for strip in group]
    if not flat:
        return
    drawing.log(path, rr.LineStrips2D.from_fields(colors=colour, radii=rr.Radius.ui_points(radius)))
    alike = len({strip.shape for strip in flat}) == 1  # as one array it is packed at once, not strip by strip
    columns = rr.LineStrips2D.columns(strips=np.array(flat) if alike else flat).partition([len(g) for g in strips])
    drawing.send_columns(path, timebase.at_starts(exposures), columns)
