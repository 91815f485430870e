"""The layout of the views: one for every session, without the views that it has no data for."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import rerun.blueprint as rrb

from aolink.plotting.overview import NIS_COVERAGE
from aolink.plotting.pupil import MAPS
from aolink.recording import topics
from aolink.rig import Rig
from aolink.viewing import entities
from aolink.viewing.camera import HISTORY, profile_bounds
from aolink.viewing.motion import MOST_STATES
from aolink.viewing.series import Drawing
from aolink.viewing.timebase import FAST_STEP, TIME

PATH_WINDOW = 2
"""Exposures that the path's view shows to each side of the time cursor."""
_HALF = 0.55
"""The same where the layout is about one exposure, when the cursor is in its middle: the axis has room for its ends."""
_ROWS = 8
"""Exposures of a page that are shown where the layout is about one of them."""

_LEGEND_ROW, _LEGEND_MOST = 0.1, 0.65
"""Height of a legend's row in a plot of the bottom row, and the most that all rows get, as shares of the plot's
height."""


@dataclass(frozen=True, kw_only=True)
class Contents:
    """The properties of a session that views depend on."""

    rig: Rig
    estimators: list[str]
    """The estimators in rank order; the band of the last one is shown first."""
    measuring: list[str]
    """Estimators that have an innovation."""
    density_top: float
    """Top of the intensity profile's plot, one over slope units."""
    truth: bool
    scenes: list[str]
    """The entities that the scene has, of: as it came, restored, at rest."""
    restored_spots: bool = False
    loops: list[str] = field(default_factory=list)
    """Names of what closed the loops whose residual slopes are drawn in one plot."""
    topics: frozenset[str] = frozenset()
    """Topics of the devices that have messages."""
    drawn: Drawing
    """The drawing on which its lines were drawn."""
    maps: Mapping[str, float] = field(default_factory=dict)
    """Maps over the lenslets, and the value at the end of each one's colours."""
    warnings: bool = False
    """Whether there are warnings."""
    alone: bool = False
    """Whether one exposure is shown alone."""
    about: int | None = None
    """Row, on its page, of the exposure that the layout is about; the other exposures are there as well."""
    compared: Contents | None = None
    """The contents of the recording that is shown beside it."""

    @property
    def sides(self) -> list[Contents]:
        """These, and those of the recording that is shown beside it."""
        return [self, *([self.compared] if self.compared else [])]

    @property
    def focus(self) -> str | None:
        """The estimator that is shown first."""
        return self.estimators[-1] if self.estimators else None


def blueprint(contents: Contents) -> rrb.Blueprint:
    """The layout: the exposure on top, the session's estimates below it, the devices at the bottom.

    For one exposure alone it has the path that explains its blur, beside its paths and its frame. A layout that is
    about one exposure has a few large views.
    """
    layout: rrb.Container
    if contents.about is not None:
        explained = [_camera(contents)[0], _profile(contents), *_residual(contents)]
        layout = rrb.Horizontal(rrb.Vertical(contents=explained), _paths(contents))
    elif contents.alone:
        camera = rrb.Horizontal if contents.restored_spots else _tabs
        seen = camera(contents=_camera(contents))
        beside = rrb.Vertical(contents=[_paths(contents), seen, _texts(contents)], row_shares=[3, 3, 1])
        layout = rrb.Horizontal(_profile(contents), beside, column_shares=[3, 2])
    else:
        seen = _tabs(_camera(contents))
        exposure = rrb.Horizontal(seen, _profile(contents), _paths(contents), column_shares=[4, 4, 7])
        rows: list[rrb.Container | rrb.View] = [exposure]
        if beliefs := [*_errors(contents), *_nis(contents), *_states(contents), *_maps(contents)]:
            rows.append(rrb.Horizontal(contents=beliefs))
        bottom = _devices(contents)
        shares = [2.0] * (len(bottom) - 1) + [3.0]
        if contents.loops:  # they come first, and are what such a session is about
            shares[0] = 4.0
        rows.append(rrb.Horizontal(contents=bottom, column_shares=shares))
        layout = rrb.Vertical(contents=rows, row_shares=[10, 7, 7] if len(rows) == 3 else [10, 7])
    if contents.scenes:
        scenes = rrb.Vertical(contents=[_scene(contents, path) for path in contents.scenes])
        layout = rrb.Horizontal(contents=[layout, scenes], column_shares=[4, 1])
    panels = rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
    return rrb.Blueprint(layout, *panels, rrb.TimePanel(state="collapsed", timeline=TIME))


def _camera(contents: Contents) -> list[rrb.View]:
    """The frame and the page that the exposure is on; also those of the recording that is compared."""
    sensor = contents.rig.sensor
    views: list[rrb.View] = []
    for each in contents.sides:
        root, title = each.drawn.root, "Compared: " if each.drawn.root else "Camera: "
        if sensor.directions == 2:
            shown = [entities.FRAME, *(f"{entities.FRAME}/path/{name}" for name in _drawn_paths(each))]
            views.append(_picture([root + path for path in shown], f"{title}frame (pixels), paths", *sensor.shape))
        shown = [entities.PAGE, entities.CENTROIDS, entities.ROW_NOW]
        shown += [f"{entities.PAGE}/path/{name}" for name in _drawn_paths(each)]
        what = "paths in their blur" if sensor.directions == 1 else "one spot along x"
        rows, columns = _part_of_page(each)
        count = "one exposure" if contents.alone else f"{len(rows)} exposures"
        name = f"{title}{count} (pixels), {what}"
        views.append(_picture([root + path for path in shown], name, len(rows), len(columns), (rows[0], columns[0])))
        if each.restored_spots:
            views.append(_picture([root + entities.RESTORED_SPOTS], f"{title}frame restored (pixels)", *sensor.shape))
    return views


def _part_of_page(contents: Contents) -> tuple[range, range]:
    """The rows and the columns of a page that are shown: all, or those about the exposure that the layout is about."""
    line, near = contents.rig.sensor.profile, contents.drawn.near
    if contents.about is None or near is None:
        return range(HISTORY), range(line.pixels)
    first = min(max(0, contents.about - _ROWS // 2), HISTORY - _ROWS)
    low, high = ((end - line.field[0]) / line.pixel_width for end in near)
    return range(first, first + _ROWS), range(math.floor(low), math.ceil(high))


def _tabs(contents: Sequence[rrb.Container | rrb.View]) -> rrb.Container | rrb.View:
    return rrb.Tabs(contents=contents, active_tab=0) if len(contents) > 1 else contents[0]


def _drawn_paths(contents: Contents) -> list[str]:
    """The truth, where it is known, and the estimator that is shown first."""
    return [*(["truth"] if contents.truth else []), *([contents.focus] if contents.focus else [])]


def _scene(contents: Contents, path: str) -> rrb.View:
    assert contents.rig.scene is not None
    names = dict(zip(entities.SCENES, ("as it came", "restored", "at rest (truth)"), strict=True))
    return _picture([path], f"Scene {names[path]} (pixels)", *contents.rig.scene.shape)


def _picture(paths: list[str], name: str, rows: int, columns: int, corner: tuple[int, int] = (0, 0)) -> rrb.View:
    (top, left) = corner
    bounds = rrb.VisualBounds2D(x_range=(left, left + columns), y_range=(top, top + rows))
    return rrb.Spatial2DView(name=name, contents=[f"+ /{path}" for path in paths], visual_bounds=bounds)


def _profile(contents: Contents) -> rrb.Container | rrb.View:
    """The explanation of the blur: path, histogram and intensity over one axis, with the key of all colours."""
    views: list[rrb.View] = []
    for each in contents.sides:
        names = 1 + len(each.estimators) + each.truth
        x_range, y_range = profile_bounds(each.rig.sensor.profile, each.density_top, names, each.drawn.near)
        title = "Compared: path" if each.drawn.root else "Path"
        what = f"{title}; time at a position; intensity (1/slope unit) over slope"
        views.append(
            rrb.Spatial2DView(
                origin=each.drawn.root + entities.PROFILE,
                name=what if each.about is None else "Intensity (1/slope unit) over slope: measured, and predicted",
                visual_bounds=rrb.VisualBounds2D(x_range=x_range, y_range=y_range),
            )
        )
    return _tabs(views)


def _paths(contents: Contents) -> rrb.Container | rrb.View:
    """A tab for each estimator with its band, with the estimator of the highest rank in front, and a tab with all of
    them. In a layout that is about one exposure they are under each other, by rank."""
    truth = _path(contents, "truth") if contents.truth else []
    names = contents.estimators
    what = ", y fainter" if len(contents.drawn.chosen.labels) > 1 else ""
    tabs = [
        _lines(
            contents, f"Path, {name}, 95 % band (slope units{what})",
            [*truth, *_path(contents, name), entities.band(f"{entities.PATH}/{name}")], window=not contents.alone,
        )
        for name in reversed(names)
    ]  # fmt: skip
    if contents.about is not None and names:
        return rrb.Vertical(contents=tabs[::-1])
    if not truth and not names:
        return rrb.TextDocumentView(origin=entities.SESSION, name="No paths: no estimates, no truth")
    everyone = [path for name in names for path in _path(contents, name)]
    tabs.append(_lines(contents, f"Path, all (slope units{what})", [*truth, *everyone], window=not contents.alone))
    return _tabs(tabs)


def _path(contents: Contents, name: str, what: str = entities.PATH) -> list[str]:
    """A path's line with its percentiles, or its range."""
    path = f"{what}/{name}"
    if contents.drawn.swinging.get(path):
        return [entities.extremes(path)]
    has_band = what == entities.PATH and name != "truth"
    return entities.with_percentiles([entities.mean(path) if has_band else path])


def _errors(contents: Contents) -> list[rrb.Container | rrb.View]:
    if not contents.truth or not contents.estimators:
        return []
    names = contents.estimators
    every_step = [path for n in names for path in _path(contents, n, entities.PATH_ERROR)]
    rms = [f"{entities.RMS_ERROR}/{n}" for n in names]
    views = [
        _lines(contents, "Path error, RMS an exposure (slope units)", entities.with_percentiles(rms)),
        _lines(contents, "Path error at fast steps (slope units)", every_step, window=True),
        *[
            _lines(
                contents, f"End state x{i + 1} error (plant's units)",
                entities.with_percentiles(entities.end_error(i, n) for n in names),
            )
            for i in range(_states_of(contents))
        ],
    ]  # fmt: skip
    return [_tabs(views)]


def _nis(contents: Contents) -> list[rrb.View]:
    names = contents.measuring
    shown = [*entities.with_percentiles(map(entities.nis_values, names)), *map(entities.nis_bounds, names)]
    return [_lines(contents, f"NIS (no unit) with its {NIS_COVERAGE:.0%} bounds", shown)] if shown else []


def _states(contents: Contents) -> list[rrb.Container | rrb.View]:
    names = contents.estimators
    tabs = []
    for where in ("end", "start"):
        for i in range(_states_of(contents) if names else 0):
            shown = [entities.state(where, i, "truth")] if contents.truth else []
            shown += [entities.mean(entities.state(where, i, n)) for n in names]
            shown = entities.with_percentiles(shown)
            if contents.focus is not None:
                shown.append(entities.band(entities.state(where, i, contents.focus)))
            tabs.append(_lines(contents, f"{where.capitalize()} state x{i + 1} (plant's units)", shown))
    return [_tabs(tabs)] if tabs else []


def _states_of(contents: Contents) -> int:
    return min(contents.rig.plant.n_states, MOST_STATES)


def _maps(contents: Contents) -> list[rrb.Container]:
    """Maps over the lenslets, as tabs."""
    if not contents.maps:
        return []
    views = []
    for name, (title, unit, colours) in MAPS.items():
        if name in contents.maps:
            end = f"{contents.maps[name]:.2g}"
            low = f"-{end}" if colours == "RdBu_r" else "0"
            words = f"{title[0].upper()}{title[1:]} ({unit}), {low} to {end}"
            views.append(_picture([f"{entities.PUPIL}/{name}"], words, *contents.rig.sensor.grid))
    return [rrb.Grid(contents=views, grid_columns=2)]


def _residual(contents: Contents) -> list[rrb.View]:
    shown = [f"{entities.RESIDUAL}/{name}" for name in contents.loops]
    title = "Residual of each loop, RMS an exposure (slope units)"
    return [_lines(contents, title, shown, legend=True)] if shown else []


def _devices(contents: Contents) -> list[rrb.Container | rrb.View]:
    views: list[rrb.Container | rrb.View] = [*_residual(contents)]
    if contents.topics & {topics.COMMAND, topics.APPLIED}:
        shown = [
            path for topic, path in ((topics.COMMAND, entities.COMMAND), (topics.APPLIED, entities.APPLIED))
            if topic in contents.topics
        ]  # fmt: skip
        views.append(_lines(contents, "Mirror input (mirror's units)", entities.with_percentiles(shown), legend=True))
    if topics.CONTROL in contents.topics:
        loop = [
            ("Loop: residual (slope units)", [f"{entities.CONTROL}/slope_rms", f"{entities.CONTROL}/path_rms"]),
            ("Loop: delay (ms)", [f"{entities.CONTROL}/delay"]),
            ("Loop: steps clipped (count)", [f"{entities.CONTROL}/clipped"]),
        ]
        lines = [_lines(contents, title, shown, legend=True) for title, shown in loop]
        views.append(_tabs(lines))
    if topics.LATENCY in contents.topics:
        views.append(_lines(contents, "Latency since exposure end (ms)", [f"{entities.LATENCY}/**"], legend=True))
    health = [_lines(contents, "Lost since start (count)", [f"{entities.LOST}/**"], legend=True)]
    if topics.CONNECTION in contents.topics:
        lost = [f"{entities.LOST}/**", f"{entities.FAULTS}/camera", f"{entities.FAULTS}/mirror"]
        health = [
            _lines(contents, "Lost and faulty since start (count)", lost, legend=True),
            _lines(contents, "Connection faults by cause (count)", [f"{entities.FAULTS}/**"], legend=True),
            _lines(contents, "Command round trip (ms)", [f"{entities.ROUND_TRIP}/**"], legend=True),
            _lines(contents, "Received (kB/s)", [f"{entities.RECEIVED}/**"], legend=True),
        ]
    if topics.EXPOSURE in contents.topics:
        views.append(_tabs(health))
    if topics.CLOCK in contents.topics:
        clocks = [
            ("sigma", "Clock offset sd (µs)"), ("offset", "Clock offset change (µs)"),
            ("frequency", "Clock rate (ppm)"), ("round_trip", "Clock round trip (µs)"),
        ]  # fmt: skip
        lines = [_lines(contents, title, [f"{entities.CLOCK}/{name}/**"], legend=True) for name, title in clocks]
        views.append(_tabs(lines))
    views.append(rrb.StateTimelineView(origin=entities.STATUS, name="Exposures, status of estimators and mirror"))
    views.append(_texts(contents))
    return views


def _texts(contents: Contents) -> rrb.Container | rrb.View:
    texts: list[rrb.View] = [rrb.TextDocumentView(origin=entities.SESSION, name="Session")]
    if contents.warnings:
        texts.append(rrb.TextLogView(origin=entities.WARNINGS, name="Warnings"))
    if topics.LOG in contents.topics:
        texts.append(rrb.TextLogView(origin=entities.LOG, name="Log"))
    if contents.compared:
        texts.append(rrb.TextDocumentView(origin=contents.compared.drawn.root + entities.SESSION, name="Compared"))
    return _tabs(texts)


def _lines(
    contents: Contents, name: str, shown: list[str], *, window: bool = False, legend: bool = False,
) -> rrb.TimeSeriesView:  # fmt: skip
    """A plot over time: of the whole session, or of `PATH_WINDOW` exposures about the time cursor; in a layout that is
    about one exposure, of that length.

    A ``legend`` stands above the lines; without one, the profile's key has the colours.
    """
    axis_y = _room_above(contents, shown) if legend else None
    corner = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend)
    expressions = [f"+ /{path}" for path in _with_compared(contents, shown)]
    if not window:
        whole = rrb.TimeRange(rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite())
        axis_x = rrb.archetypes.TimeAxis(view_range=whole)
        return rrb.TimeSeriesView(name=name, contents=expressions, axis_x=axis_x, axis_y=axis_y, plot_legend=corner)
    timing = contents.rig.timing
    steps = PATH_WINDOW * timing.frame_period_steps if contents.about is None else round(_HALF * timing.exposure_steps)
    near, span_s = rrb.TimeRangeBoundary.cursor_relative, steps * contents.rig.timing.fast_step_s
    ranges = [
        rrb.VisibleTimeRange(FAST_STEP, start=near(seq=-steps), end=near(seq=steps)),
        rrb.VisibleTimeRange(TIME, start=near(seconds=-span_s), end=near(seconds=span_s)),
    ]
    return rrb.TimeSeriesView(name=name, contents=expressions, time_ranges=ranges, plot_legend=corner)


def _room_above(contents: Contents, shown: list[str]) -> rrb.ScalarAxis | None:
    """An axis with room above the lines for a legend of them all; None where their extents are not known yet."""
    found = [(path, ends) for path, ends in contents.drawn.extents.items() if any(_names(each, path) for each in shown)]
    if not found:
        return None
    low, high = min(ends[0] for _, ends in found), max(ends[1] for _, ends in found)
    span = high - low or abs(high) or 1.0
    share = min(_LEGEND_MOST, _LEGEND_ROW * (len(found) + 1))
    return rrb.ScalarAxis(range=(low - 0.05 * span, low + span / (1 - share)))


def _names(expression: str, path: str) -> bool:
    """Whether an expression of a view selects a path."""
    return path == expression or (expression.endswith("/**") and path.startswith(expression[:-2]))


def _with_compared(contents: Contents, paths: Iterable[str]) -> list[str]:
    """The paths, and beside each its twin of the recording that is compared."""
    every = list(paths)
    if contents.compared is not None:
        there, root = contents.compared.drawn.extents, contents.compared.drawn.root
        every += [root + path for path in paths if any(_names(path, each) for each in there)]
    return every
