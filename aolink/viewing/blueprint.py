"""The layout of the views: one for every session, without the views that it has no data for."""

from __future__ import annotations

from collections.abc import Sequence

import rerun.blueprint as rrb

from aolink.gathered import MAPS, NIS_COVERAGE, PER_SLOPE, SCENES, SLOPES
from aolink.recording import topics
from aolink.viewing import entities
from aolink.viewing.camera import HISTORY, profile_bounds
from aolink.viewing.motion import MOST_STATES
from aolink.viewing.series import Drawing
from aolink.viewing.timebase import FAST_STEP, TIME

View = rrb.Container | rrb.View

PATH_WINDOW = 2
"""Exposures that the path's view shows to each side of the time cursor."""

_LEGEND_ROW, _LEGEND_MOST = 0.1, 0.65
"""Height of a legend's row in a plot of the bottom row, and the most that all rows get, as shares of the plot's
height."""


def blueprint(drawn: Drawing, *, alone: bool = False) -> rrb.Blueprint:
    """The layout: the exposure on top, the session's estimates below it, the devices at the bottom.

    For one exposure ``alone`` it has the path that explains its blur, beside its paths and its frame.
    """
    return rrb.Blueprint(*_Layout(drawn, alone).all())


class _Layout:
    """The views of a session, and their order."""

    def __init__(self, drawn: Drawing, alone: bool) -> None:
        self.drawn, self.alone = drawn, alone
        self.names = drawn.estimators
        self.truth = drawn.has(f"{entities.PATH}/truth")
        self.states = range(1, 1 + min(drawn.rig.plant.n_states, MOST_STATES))

    def all(self) -> list[rrb.Container | rrb.BlueprintPanel | rrb.SelectionPanel | rrb.TimePanel]:
        layout: rrb.Container
        if self.alone:
            seen = self.camera()
            cameras = rrb.Horizontal(contents=seen) if self.drawn.has(entities.RESTORED_SPOTS) else _tabs(seen)
            beside = rrb.Vertical(contents=[self.paths(), cameras, self.texts()], row_shares=[3, 3, 1])
            layout = rrb.Horizontal(self.profile(), beside, column_shares=[3, 2])
        else:
            exposure = rrb.Horizontal(_tabs(self.camera()), self.profile(), self.paths(), column_shares=[4, 4, 7])
            rows: list[View] = [exposure]
            if beliefs := [*self.errors(), *self.nis(), *self.all_states(), *self.maps()]:
                rows.append(rrb.Horizontal(contents=beliefs))
            residual, bottom = self.residual(), self.devices()
            # Where there are several loops, they are what such a session is about.
            shares = [4.0] * len(residual) + [2.0] * (len(bottom) - 1) + [3.0]
            rows.append(rrb.Horizontal(contents=[*residual, *bottom], column_shares=shares))
            layout = rrb.Vertical(contents=rows, row_shares=[10, 7, 7] if len(rows) == 3 else [10, 7])
        if scenes := self.scenes():
            layout = rrb.Horizontal(contents=[layout, rrb.Vertical(contents=scenes)], column_shares=[4, 1])
        panels = rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
        return [layout, *panels, rrb.TimePanel(state="collapsed", timeline=TIME)]

    def camera(self) -> list[rrb.View]:
        """The frame and the page that the exposure is on."""
        sensor = self.drawn.rig.sensor
        views: list[rrb.View] = []
        drawn = [*(["truth"] if self.truth else []), *self.names[-1:]]
        if sensor.directions == 2:
            shown = [entities.FRAME, *(f"{entities.FRAME}/path/{name}" for name in drawn)]
            views.append(_picture(shown, "Camera: frame (pixels), paths", *sensor.shape))
        shown = [entities.PAGE, entities.CENTROIDS, entities.ROW_NOW]
        shown += [f"{entities.PAGE}/path/{name}" for name in drawn]
        what = "paths in their blur" if sensor.directions == 1 else "one spot along x"
        count = "one exposure" if self.alone else f"{HISTORY} exposures"
        views.append(_picture(shown, f"Camera: {count} (pixels), {what}", HISTORY, sensor.profile.pixels))
        if self.drawn.has(entities.RESTORED_SPOTS):
            views.append(_picture([entities.RESTORED_SPOTS], "Camera: frame restored (pixels)", *sensor.shape))
        return views

    def scenes(self) -> list[rrb.View]:
        """The scene as it came, restored, at rest."""
        titles = (SCENES["came"], SCENES["restored"], f"{SCENES['true']} (truth)")
        sensor = self.drawn.rig.scene
        return [
            _picture([path], f"Scene {title} (pixels)", *sensor.shape)
            for path, title in zip(entities.SCENES, titles, strict=True)
            if sensor is not None and self.drawn.has(path)
        ]

    def profile(self) -> View:
        """The explanation of the blur: path, histogram and intensity over one axis, with the key of all colours."""
        drawn = self.drawn
        x_range, y_range = profile_bounds(drawn.rig.sensor.profile, drawn.top or 1.0, 1 + len(self.names) + self.truth)
        title = f"Path; time at a position; intensity ({PER_SLOPE}) over slope"
        shown = rrb.VisualBounds2D(x_range=x_range, y_range=y_range)
        return rrb.Spatial2DView(origin=entities.PROFILE, name=title, visual_bounds=shown)

    def paths(self) -> View:
        """A tab for each estimator with its band, with the estimator of the highest rank in front, and a tab with all
        of them."""
        names, truth = self.names, [f"{entities.PATH}/truth/**"] if self.truth else []
        unit = f"({SLOPES}{', y fainter' if len(self.drawn.labels) > 1 else ''})"
        tabs: list[View] = [
            self.lines(f"Path, {name}, 95 % band {unit}", [*truth, f"{entities.PATH}/{name}/**"], window=not self.alone)
            for name in reversed(names)
        ]
        if not truth and not names:
            return rrb.TextDocumentView(origin=entities.SESSION, name="No paths: no estimates, no truth")
        bands = [entities.band(f"{entities.PATH}/{name}") for name in names]
        everyone = self.lines(f"Path, all {unit}", [f"{entities.PATH}/**"], bands, window=not self.alone)
        return _tabs([*tabs, everyone])

    def errors(self) -> list[View]:
        if not self.truth or not self.names:
            return []
        ends = [(f"End state x{i} error (plant's units)", f"{entities.END_ERROR}/x{i}/**") for i in self.states]
        views = [
            self.lines(f"Path error, RMS an exposure ({SLOPES})", [f"{entities.RMS_ERROR}/**"]),
            self.lines(f"Path error at fast steps ({SLOPES})", [f"{entities.PATH_ERROR}/**"], window=True),
            *(self.lines(title, [path]) for title, path in ends),
        ]
        return [_tabs(views)]

    def nis(self) -> list[View]:
        title = f"NIS (no unit) with its {NIS_COVERAGE:.0%} bounds"
        return [self.lines(title, [f"{entities.NIS}/**"])] if self.drawn.has(entities.NIS) else []

    def all_states(self) -> list[View]:
        tabs = []
        for where, i in [(where, i) for where in ("end", "start") for i in self.states if self.names]:
            path = f"{entities.STATE}/{where}/x{i}"
            bands = [entities.band(f"{path}/{name}") for name in self.names[:-1]]
            tabs.append(self.lines(f"{where.capitalize()} state x{i} (plant's units)", [f"{path}/**"], bands))
        return [_tabs(tabs)] if tabs else []

    def maps(self) -> list[View]:
        """Maps over the lenslets, as a grid."""
        views = []
        for name, (title, unit, colours) in MAPS.items():
            if name in self.drawn.scales:
                end = f"{self.drawn.scales[name]:.2g}"
                low = f"-{end}" if colours == "RdBu_r" else "0"
                words = f"{title[0].upper()}{title[1:]} ({unit}), {low} to {end}"
                views.append(_picture([f"{entities.PUPIL}/{name}"], words, *self.drawn.rig.sensor.grid))
        return [rrb.Grid(contents=views, grid_columns=2)] if views else []

    def residual(self) -> list[View]:
        """What the loops that are compared have left."""
        title = f"Residual of each loop, RMS an exposure ({SLOPES})"
        return self.legended({title: [f"{entities.RESIDUAL}/**"]})

    def devices(self) -> list[View]:
        """The devices, and the texts."""
        views = self.legended({"Input (mirror's units)": [f"{entities.COMMAND}/**", f"{entities.APPLIED}/**"]})
        owners: dict[str, str] = {}
        curves: dict[str, dict[str, list[str]]] = {}
        for row in topics.TOPICS:
            place = "devices" if row.belongs_to == "time" else row.name
            for curve in row.curves:  # of a view's title, the first topic's tabs have it
                tabs = curves.setdefault(owners.setdefault(curve.view, place), {})
                tabs.setdefault(curve.view, []).append(f"{entities.of(row.name)}/{curve.field}/**")
        for tabs in curves.values():
            views += self.legended(tabs)
        views.append(rrb.StateTimelineView(origin=entities.STATUS, name="Status"))
        return [*views, self.texts()]

    def texts(self) -> View:
        texts: list[rrb.View] = [rrb.TextDocumentView(origin=entities.SESSION, name="Session")]
        for entity, name in ((entities.WARNINGS, "Warnings"), (entities.LOG, "Log")):
            if self.drawn.has(entity):
                texts.append(rrb.TextLogView(origin=entity, name=name))
        return _tabs(texts)

    def legended(self, views: dict[str, list[str]]) -> list[View]:
        """Plots of entities by their titles, with legends, as tabs; those that there are."""
        there = {
            title: [path for path in shown if self.drawn.has(path.removesuffix("/**"))]
            for title, shown in views.items()
        }  # fmt: skip
        tabs = [self.lines(title, shown, legend=True) for title, shown in there.items() if shown]
        return [_tabs(tabs)] if tabs else []

    def lines(
        self, name: str, shown: list[str], hidden: Sequence[str] = (), *, window: bool = False, legend: bool = False
    ) -> rrb.TimeSeriesView:
        """A plot over time: of the whole session, or of `PATH_WINDOW` exposures about the time cursor.

        A ``legend`` stands above the lines; without one, the profile's key has the colours.
        """
        corner = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend)
        expressions = [*(f"+ /{path}" for path in shown), *(f"- /{path}" for path in hidden)]
        if not window:
            whole = rrb.TimeRange(rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite())
            axis_x = rrb.archetypes.TimeAxis(view_range=whole)
            axis_y = self.room_above(shown) if legend else None
            return rrb.TimeSeriesView(name=name, contents=expressions, axis_x=axis_x, axis_y=axis_y, plot_legend=corner)
        timing = self.drawn.rig.timing
        steps = PATH_WINDOW * timing.frame_period_steps
        near, span_s = rrb.TimeRangeBoundary.cursor_relative, steps * timing.fast_step_s
        ranges = [
            rrb.VisibleTimeRange(FAST_STEP, start=near(seq=-steps), end=near(seq=steps)),
            rrb.VisibleTimeRange(TIME, start=near(seconds=-span_s), end=near(seconds=span_s)),
        ]
        return rrb.TimeSeriesView(name=name, contents=expressions, time_ranges=ranges, plot_legend=corner)

    def room_above(self, shown: list[str]) -> rrb.ScalarAxis | None:
        """An axis with room above the lines for a legend of them all; None where their extents are not known yet,
        or still grow."""
        chosen = tuple(path.removesuffix("**") for path in shown)
        found = [ends for path, ends in self.drawn.extents.items() if f"{path}/".startswith(chosen)]
        if not found or self.drawn.live:
            return None
        low, high = min(ends[0] for ends in found), max(ends[1] for ends in found)
        span = high - low or abs(high) or 1.0
        share = min(_LEGEND_MOST, _LEGEND_ROW * (len(found) + 1))
        return rrb.ScalarAxis(range=(low - 0.05 * span, low + span / (1 - share)))


def _tabs(views: Sequence[View]) -> View:
    return rrb.Tabs(contents=views, active_tab=0) if len(views) > 1 else views[0]


def _picture(paths: list[str], name: str, rows: int, columns: int) -> rrb.View:
    bounds = rrb.VisualBounds2D(x_range=(0, columns), y_range=(0, rows))
    return rrb.Spatial2DView(name=name, contents=[f"+ /{path}" for path in paths], visual_bounds=bounds)
