"""Which views there are and where: one layout for every session, less what it has no data for."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import rerun.blueprint as rrb

from aolink.optics.sensor import SpotSensor
from aolink.plotting.overview import NIS_COVERAGE
from aolink.plotting.style import BAND
from aolink.recording import topics
from aolink.rig import Rig
from aolink.viewing.camera import HISTORY, profile_bounds
from aolink.viewing.scene import RESTORED_SCENE, RESTORED_SPOTS, SCENE, TRUE_SCENE
from aolink.viewing.timebase import DEVICE_TIME, FAST_STEP

PATH_WINDOW = 2
"""Exposures that the path's view shows to each side of the time cursor."""


@dataclass(frozen=True, kw_only=True)
class Contents:
    """The properties of a session that views depend on."""

    rig: Rig
    estimators: list[str]
    """In rank order; the last is the one whose band is shown first."""
    measuring: list[str]
    """Those of them that have an innovation."""
    density_top: float
    """Top of the intensity profile's plot, one over slope units."""
    truth: bool
    scenes: list[str]
    """Entities of the scene: as it came, restored, at rest; those that there are."""
    restored_spots: bool = False
    topics: frozenset[str] = frozenset()
    """Those of the devices that have messages."""

    @property
    def focus(self) -> str | None:
        """The estimator that is shown first."""
        return self.estimators[-1] if self.estimators else None


def blueprint(contents: Contents) -> rrb.Blueprint:
    """The layout: the exposure on top, the session's estimates below it, the devices at the bottom."""
    exposure = rrb.Horizontal(_camera(contents), _profile(contents), _paths(contents), column_shares=[4, 4, 7])
    rows: list[rrb.Container | rrb.View] = [exposure]
    if contents.estimators:
        beliefs = [*_errors(contents), *_nis(contents), _states(contents)]
        rows.append(rrb.Horizontal(contents=beliefs))
    bottom = _devices(contents)
    rows.append(rrb.Horizontal(contents=bottom, column_shares=[2.0] * (len(bottom) - 1) + [3.0]))
    layout: rrb.Container = rrb.Vertical(contents=rows, row_shares=[10, 7, 7] if len(rows) == 3 else [10, 7])
    if contents.scenes:
        scenes = rrb.Vertical(contents=[_scene(contents, path) for path in contents.scenes])
        layout = rrb.Horizontal(contents=[layout, scenes], column_shares=[4, 1])
    return rrb.Blueprint(
        layout,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=FAST_STEP, fps=contents.rig.timing.exposure_steps),
    )


def _camera(contents: Contents) -> rrb.Container | rrb.View:
    """The last exposures; where there are many spots they are those of the first one, behind the whole frame."""
    sensor = contents.rig.sensor
    rows, columns = sensor.shape
    restored = [_picture(RESTORED_SPOTS, "Camera: frame restored (pixels)", rows, columns)]
    restored = restored if contents.restored_spots else []
    if not isinstance(sensor, SpotSensor):
        history = _history(contents, "paths in their blur")
        return rrb.Tabs(history, *restored, active_tab=0) if restored else history
    shown = ["camera/image", *(f"camera/image/path/{name}" for name in ("truth", contents.focus) if name)]
    frame = rrb.Spatial2DView(
        name="Camera: frame (pixels), paths in their blur",
        contents=_exactly(shown),
        visual_bounds=rrb.VisualBounds2D(x_range=(0, columns), y_range=(0, rows)),
    )
    return rrb.Tabs(frame, _history(contents, "first spot along x"), *restored, active_tab=0)


def _scene(contents: Contents, path: str) -> rrb.View:
    assert contents.rig.scene is not None
    name = {SCENE: "Scene as it came", RESTORED_SCENE: "Scene restored", TRUE_SCENE: "Scene at rest (truth)"}[path]
    return _picture(path, f"{name} (pixels)", *contents.rig.scene.shape)


def _picture(path: str, name: str, rows: int, columns: int) -> rrb.View:
    bounds = rrb.VisualBounds2D(x_range=(0, columns), y_range=(0, rows))
    return rrb.Spatial2DView(name=name, contents=_exactly([path]), visual_bounds=bounds)


def _history(contents: Contents, what: str) -> rrb.View:
    shown = ["camera/history", "camera/history/centroid"]
    shown += [f"camera/history/path/{name}" for name in ("truth", contents.focus) if name]
    return rrb.Spatial2DView(
        name=f"Camera: last {HISTORY} exposures (pixels), {what}",
        contents=_exactly(shown),
        visual_bounds=rrb.VisualBounds2D(x_range=(0, contents.rig.sensor.profile.pixels), y_range=(0, HISTORY)),
    )


def _profile(contents: Contents) -> rrb.View:
    x_range, y_range = profile_bounds(contents.rig.sensor.profile, contents.density_top)
    return rrb.Spatial2DView(
        origin="profile",
        name="Intensity density (1/slope unit) over slope",
        visual_bounds=rrb.VisualBounds2D(x_range=x_range, y_range=y_range),
    )


def _paths(contents: Contents) -> rrb.Container | rrb.View:
    """A tab for each estimator with its band, the one to look at first in front, and one with all of them."""
    truth = ["path/truth", "path/truth/axes"] if contents.truth else []
    names = contents.estimators
    tabs = [
        _lines(
            f"Path, {name} ± {BAND:g} sd (slope units)",
            [*truth, f"path/{name}/mean", f"path/{name}/mean/axes", f"path/{name}/band"],
            window=contents.rig,
        )
        for name in reversed(names)
    ]
    everyone = [p for name in names for p in (f"path/{name}/mean", f"path/{name}/mean/axes")]
    tabs.append(_lines("Path, all (slope units)", [*truth, *everyone], window=contents.rig))
    return rrb.Tabs(contents=tabs, active_tab=0)


def _errors(contents: Contents) -> list[rrb.Container | rrb.View]:
    if not contents.truth:
        return []
    names = contents.estimators
    return [
        rrb.Tabs(
            _lines("Path error, RMS an exposure (slope units)", _with_axes(f"error/path_rms/{n}" for n in names)),
            _lines(
                "Path error at each fast step (slope units)",
                _with_axes(f"error/path/{n}" for n in names),
                window=contents.rig,
            ),
            *[
                _lines(
                    f"End state x{i + 1} error (plant's units)", _with_axes(f"error/end/x{i + 1}/{n}" for n in names)
                )
                for i in range(contents.rig.plant.n_states)
            ],
            active_tab=0,
        )
    ]


def _nis(contents: Contents) -> list[rrb.View]:
    shown = [p for n in contents.measuring for p in (f"nis/{n}/value", f"nis/{n}/value/axes", f"nis/{n}/bounds")]
    return [_lines(f"NIS (no unit) with its {NIS_COVERAGE:.0%} bounds", shown)] if shown else []


def _states(contents: Contents) -> rrb.Container:
    names = contents.estimators
    tabs = []
    for where in ("end", "start"):
        for i in range(contents.rig.plant.n_states):
            root = f"state/{where}/x{i + 1}"
            shown = [f"{root}/truth"] if contents.truth else []
            shown += [f"{root}/{n}/mean" for n in names]
            shown += [f"{root}/{contents.focus}/band"]
            tabs.append(_lines(f"{where.capitalize()} state x{i + 1} (plant's units)", _with_axes(shown)))
    return rrb.Tabs(contents=tabs, active_tab=0)


def _devices(contents: Contents) -> list[rrb.Container | rrb.View]:
    views: list[rrb.Container | rrb.View] = []
    if contents.topics & {topics.COMMAND, topics.APPLIED}:
        views.append(_lines("Mirror input (mirror's units)", _with_axes(["mirror/command", "mirror/applied"])))
    if topics.LATENCY in contents.topics:
        views.append(_lines("Latency since exposure end (ms)", ["latency/**"]))
    health = [_lines("Lost since start (count)", ["link/lost/**"])]
    if topics.LINK in contents.topics:
        health = [
            _lines("Lost and faulty since start (count)", ["link/lost/**", "link/faults/camera", "link/faults/mirror"]),
            _lines("Link faults by cause (count)", ["link/faults/**"]),
            _lines("Command round trip (ms)", ["link/round_trip/**"]),
            _lines("Received (kB/s)", ["link/received/**"]),
        ]
    views.append(rrb.Tabs(contents=health, active_tab=0))
    if topics.CLOCK in contents.topics:
        clocks = [
            ("sigma", "Clock offset sd (µs)"),
            ("offset", "Clock offset change (µs)"),
            ("frequency", "Clock rate (ppm)"),
            ("round_trip", "Clock round trip (µs)"),
        ]
        views.append(rrb.Tabs(contents=[_lines(title, [f"clock/{name}/**"]) for name, title in clocks], active_tab=0))
    views.append(rrb.StateTimelineView(origin="status", name="Status of estimators and mirror"))
    texts: list[rrb.View] = [rrb.TextDocumentView(origin="session", name="Session")]
    if topics.LOG in contents.topics:
        texts.append(rrb.TextLogView(origin="log", name="Log"))
    views.append(rrb.Tabs(contents=texts, active_tab=0))
    return views


def _lines(name: str, shown: list[str], *, window: Rig | None = None) -> rrb.TimeSeriesView:
    """A plot over time: of the whole session, or of `PATH_WINDOW` exposures about the time cursor."""
    if window is None:
        whole = rrb.TimeRange(rrb.TimeRangeBoundary.infinite(), rrb.TimeRangeBoundary.infinite())
        return rrb.TimeSeriesView(
            name=name,
            contents=_exactly(shown),
            axis_x=rrb.archetypes.TimeAxis(view_range=whole),
            plot_legend=rrb.Corner2D.LeftTop,
        )
    steps = PATH_WINDOW * window.timing.frame_period_steps
    seconds = steps * window.timing.fast_step_s
    near = rrb.TimeRangeBoundary.cursor_relative
    ranges = [
        rrb.VisibleTimeRange(FAST_STEP, start=near(seq=-steps), end=near(seq=steps)),
        rrb.VisibleTimeRange(DEVICE_TIME, start=near(seconds=-seconds), end=near(seconds=seconds)),
    ]
    return rrb.TimeSeriesView(name=name, contents=_exactly(shown), time_ranges=ranges, plot_legend=rrb.Corner2D.LeftTop)


def _exactly(paths: Iterable[str]) -> list[str]:
    return [f"+ /{path}" for path in paths]


def _with_axes(paths: Iterable[str]) -> list[str]:
    """The paths and, where there are many axes, their percentiles."""
    return [p for path in paths for p in (path, f"{path}/axes")]
