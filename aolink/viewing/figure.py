"""A recording at one look, drawn with matplotlib: for machines on which the viewer cannot draw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from aolink.errors import ViewerError
from aolink.estimation import Estimate
from aolink.estimation.registry import BASELINE_ESTIMATOR
from aolink.exporting.plot import PathLines, colour, draw_blur
from aolink.exposure import Exposure
from aolink.files import writing
from aolink.optics.kernel import exposure_density
from aolink.optics.sensor import Sensor
from aolink.viewing.camera import density, density_top, first_profiles
from aolink.viewing.motion import BAND
from aolink.viewing.palette import by_rank

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from aolink.recording.reader import Recording

FloatArray = NDArray[np.float64]

_SIZE_IN, _DPI = (16.0, 11.5), 110
_CLOSE_UPS = 3
"""Exposures whose inside is drawn."""
_RUNNING = 20
"""The errors are averaged over this share of the session."""
_STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
}


@dataclass(frozen=True)
class _Session:
    """What is drawn: of several outputs the first one, as in the viewer's profile."""

    sensor: Sensor
    exposures: list[Exposure]
    """As the sensor's first spot saw them."""
    times_s: FloatArray
    """When each exposure began, from the first one on."""
    step_s: float
    estimates: dict[str, dict[int, Estimate]]
    """By estimator, in the order of rank, and by frame id."""

    def path(self, name: str, exposure: Exposure) -> FloatArray | None:
        """Path of ``truth`` or of an estimator in an exposure, (n_steps,)."""
        if name == "truth":
            return None if exposure.truth is None else exposure.truth.path[0]
        estimate = self.estimates[name].get(exposure.frame_id)
        return None if estimate is None else estimate.path[0]


def draw_session(recording: Recording, path: str | Path) -> Path:
    """Draw a recording: intensity over the session, the inside of some exposures, the errors where truth is known.

    Parameters
    ----------
    recording:
        A recording, as `aolink.read` opens it, with estimates in it.
    path:
        The PNG file to write; an older one is replaced.

    Raises
    ------
    ViewerError
        matplotlib is missing, the recording has no exposure, or the file cannot be written.
    """
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError:
        raise ViewerError("a picture without the viewer needs matplotlib: pip install 'aolink[plot]'") from None
    session = _session(recording)
    focus = next(reversed(session.estimates), None)
    compared = [name for name in (BASELINE_ESTIMATOR, focus) if name in session.estimates]
    lines = ["truth", *dict.fromkeys(compared)]
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        places = figure.add_gridspec(4, 2 * _CLOSE_UPS, height_ratios=[1.25, 1.25, 0.8, 1.15])
        figure.suptitle(f"{recording.rig.name}: {recording.path.name}", x=0.01, ha="left", fontsize=13)
        _draw_intensity(figure.add_subplot(places[0, :]), session, list(dict.fromkeys((lines[0], lines[-1]))))
        for k, exposure in enumerate(_close_ups(session, focus)):
            inside, profile = (figure.add_subplot(places[row, 2 * k : 2 * k + 2]) for row in (1, 2))
            _draw_inside(inside, session, lines, exposure)
            _draw_profile(profile, session, lines, exposure)
            if k == 0:
                inside.set_ylabel("spot (slope units)")
                inside.legend(loc="best", frameon=False)
                profile.set_ylabel("density\n(1 / slope unit)")
        split = 2 * _CLOSE_UPS - 2
        _draw_errors(figure.add_subplot(places[3, :split]), figure.add_subplot(places[3, split:]), session)
        with writing(Path(path), overwrite=True, error=ViewerError) as partial:
            figure.savefig(partial, format="png", dpi=_DPI)
    return Path(path)


def _session(recording: Recording) -> _Session:
    sensor, step_s = recording.rig.sensor, recording.rig.timing.fast_step_s
    exposures = list(recording.exposures())
    if not exposures:
        raise ViewerError(f"{recording.path} has no exposure that could be drawn")
    first = np.array([each.first_step for each in exposures])
    estimates = {name: {e.frame_id: e for e in recording.estimates(name)} for name in by_rank(recording.estimators)}
    return _Session(sensor.profile, first_profiles(sensor, exposures), (first - first[0]) * step_s, step_s, estimates)


def _draw_intensity(axis: Axes, session: _Session, lines: Sequence[str]) -> None:
    """Every exposure's profile as a column; a lost frame leaves its place empty."""
    sensor, top = session.sensor, density_top(session.sensor, session.exposures)
    ends = session.times_s + session.step_s * np.array([each.n_steps for each in session.exposures])
    spans = list(zip(session.times_s, ends, strict=True))
    draw_blur(axis, sensor, spans, [density(sensor, each) for each in session.exposures], top)
    paths = PathLines(session.step_s)
    for name in lines:
        for begin, exposure in zip(session.times_s, session.exposures, strict=True):
            if (path := session.path(name, exposure)) is not None:
                paths.add(name, begin, path)
    paths.draw(axis, 0.8)
    axis.set(
        title="What the camera saw, and where the spot was", xlabel="time (s)", ylabel="slope units",
        ylim=sensor.field, xlim=(0, ends[-1]),
    )  # fmt: skip
    axis.legend(loc="upper right", ncols=2)


def _close_ups(session: _Session, focus: str | None) -> list[Exposure]:
    """From each third of the session the exposure in which the spot moved most."""

    def moved(exposure: Exposure) -> float:
        paths = [session.path(name, exposure) for name in ("truth", focus) if name]
        return max((float(np.ptp(path)) for path in paths if path is not None), default=0.0)

    count = len(session.exposures)
    edges = np.unique(np.linspace(0, count, _CLOSE_UPS + 1).astype(int))
    return [max(session.exposures[a:b], key=moved) for a, b in pairwise(edges)]


def _draw_inside(axis: Axes, session: _Session, lines: Sequence[str], exposure: Exposure) -> None:
    """The path in one exposure with the band of each estimate."""
    time_ms = np.arange(exposure.n_steps) * session.step_s * 1e3
    for name in lines:
        if (path := session.path(name, exposure)) is None:
            continue
        width = 2.2 if name == "truth" else 1.6
        label = name if name == "truth" else f"{name}, ±{BAND:g} sd"
        axis.plot(time_ms, path, color=colour(name), linewidth=width, label=label)
        if name != "truth":
            sd = session.estimates[name][exposure.frame_id].path_sd[0]
            axis.fill_between(time_ms, path - BAND * sd, path + BAND * sd, color=colour(name), alpha=0.2, linewidth=0)
    axis.set(title=f"Inside exposure {exposure.frame_id}", xlabel="time in the exposure (ms)", xlim=time_ms[[0, -1]])
    axis.grid(alpha=0.3)


def _draw_profile(axis: Axes, session: _Session, lines: Sequence[str], exposure: Exposure) -> None:
    """The same exposure's intensity as it was measured, and as each path would have left it."""
    sensor = session.sensor
    axis.stairs(density(sensor, exposure), sensor.edges, fill=True, color="0.8")
    for name in lines:
        if (path := session.path(name, exposure)) is not None:
            left = exposure_density(sensor.kernel, sensor.edges, path)
            axis.plot(sensor.centres, left, color=colour(name), linewidth=1.4)
    axis.set(xlabel="intensity as measured, and by each path (slope units)", xlim=sensor.field)


def _draw_errors(over_time: Axes, whole: Axes, session: _Session) -> None:
    """Error of the path along the session, and over all of it."""
    if not any(exposure.truth is not None for exposure in session.exposures) or not session.estimates:
        for axis in (over_time, whole):
            axis.set_axis_off()
        over_time.set_title("No errors: the recording holds no truth or no estimates")
        return
    names, overall = list(session.estimates), []
    for name in names:
        known = [
            (begin, float(np.mean((found - true) ** 2)))
            for begin, exposure in zip(session.times_s, session.exposures, strict=True)
            if (found := session.path(name, exposure)) is not None
            and (true := session.path("truth", exposure)) is not None
        ]
        times, squares = np.array(known).T
        overall.append(float(np.sqrt(squares.mean())))
        width = max(1, len(squares) // _RUNNING)
        kernel = np.full(width, 1 / width)
        running = np.sqrt(np.convolve(squares, kernel, mode="valid"))
        over_time.plot(np.convolve(times, kernel, mode="valid"), running, color=colour(name), label=name)
    over_time.set(yscale="log", xlabel="time (s)", ylabel="RMSE (slope units)", title="Error of the path, running")
    over_time.grid(alpha=0.3, which="both")
    places = np.arange(len(names))[::-1]
    whole.barh(places, overall, color=[colour(name) for name in names])
    for place, value in zip(places, overall, strict=True):
        whole.annotate(f" {value:.3g}", (value, place), va="center")
    whole.set_yticks(places, names)
    whole.set(xlabel="RMSE (slope units)", title="over the whole session")
    whole.margins(x=0.15)
