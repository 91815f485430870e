"""One exposure of a recording explained in one PNG, for machines on which the viewer cannot draw."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from aolink.errors import ExportError
from aolink.extensions import install_command
from aolink.files import writing
from aolink.plotting.exposure import draw_intensity, draw_paths, draw_spot, exposure_with_estimates, paths_of
from aolink.plotting.overview import limits_of, need_exposures, overview
from aolink.plotting.scene import plot_scene
from aolink.plotting.session import plot_blur
from aolink.plotting.style import legend_above
from aolink.recording.reader import Recording

if TYPE_CHECKING:
    from matplotlib.figure import SubFigure

    from aolink.estimation.estimate import Estimate
    from aolink.exposure import Exposure
    from aolink.series import Series

    Estimates = dict[str, Estimate]

_SIZE_IN, _DPI = (16.0, 10.0), 110
_NEAR = 4
"""Exposures before and after the one that is explained whose blur is drawn."""
_STYLE: dict[Any, Any] = {
    "font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False,
}  # fmt: skip


def draw_session(series: Series, path: str | Path) -> Path:
    """Draw the most telling exposure of a series: the blur with the path through it, the intensity profile with what
    each estimator predicts for it, the path with the band of each estimator, and the scene as it came, restored, and at
    rest.

    Parameters
    ----------
    series:
        A recording, as `aolink.read` opens it, or another series.
    path:
        The PNG file to write; an older one is replaced.

    Raises
    ------
    ExportError
        matplotlib is missing, the series has no exposure, or the file cannot be written.
    """
    try:
        import matplotlib as mpl
        from matplotlib.figure import Figure
    except ImportError:
        raise ExportError(f"a picture without the viewer needs matplotlib: {install_command('plot')}") from None
    view = overview(series)
    need_exposures(view)
    number, why = next(iter(view.telling().items()))
    exposure, estimates = exposure_with_estimates(series, number, view.names)
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        figure.suptitle(f"{series.rig.name}: exposure {number}, {why}", x=0.01, ha="left", fontsize=13)
        shares = [1.0, 1.0, 0.55] if isinstance(series, Recording) and exposure.scene is not None else [1.0, 1.0]
        columns: Any = figure.subfigures(1, len(shares), width_ratios=shares)
        above, below = columns[0].subfigures(2, 1)
        _draw_blur(above, series, number, exposure, estimates)
        _draw_profile(below, series, exposure, estimates)
        _draw_bands(columns[1], series, exposure, estimates)
        if isinstance(series, Recording) and exposure.scene is not None:
            plot_scene(series, number, columns[2])
        with writing(Path(path), overwrite=True, error=ExportError) as partial:
            figure.savefig(partial, format="png", dpi=_DPI)
    return Path(path)


def _titled(figure: SubFigure, title: str) -> SubFigure:
    figure.suptitle(title, x=0.02, ha="left", fontsize=11)
    return figure


def _draw_blur(figure: SubFigure, series: Series, number: int, exposure: Exposure, estimates: Estimates) -> None:
    if series.rig.sensor.directions == 2:
        spot = _titled(figure, "The blur of a spot, and the paths through it").subplots()
        draw_spot(spot, series.rig.sensor, exposure, estimates, 0)
        return
    first = max(0, number - _NEAR)
    near = overview(series[first : number + _NEAR])
    axes = _titled(figure, f"The blur of {len(near)} exposures, and the paths through it").subplots()
    plot_blur(near, axes)
    begin, end = near.spans[number - first] * near.scale("s")
    axes.axvspan(begin, end, fill=False, edgecolor="tab:red", linewidth=1.5)


def _draw_profile(figure: SubFigure, series: Series, exposure: Exposure, estimates: Estimates) -> None:
    axes = _titled(figure, "The intensity profile, and what each path predicts for it").subplots()
    draw_intensity(axes, series, exposure, estimates, 0)
    limits = limits_of(series.rig.sensor.profile, list(paths_of(exposure, estimates, [0]).values()))
    axes.set(xlim=limits, ylim=(0, None), xlabel="position (slope units)", ylabel="intensity (1 / slope unit)")
    legend_above(axes)


def _draw_bands(figure: SubFigure, series: Series, exposure: Exposure, estimates: Estimates) -> None:
    outputs = list(range(series.rig.sensor.directions))
    shown = [[name] for name in estimates] or [[]]
    panels: Any = figure.subplots(len(shown), 1, sharex=True, sharey=True, squeeze=False)
    for axes, names in zip(panels[:, 0], shown, strict=True):
        draw_paths(axes, series, exposure, {name: estimates[name] for name in names}, outputs)
        by = "".join(f" by {name}, its 95 % band" for name in names)
        truth = ", and the truth (black)" if exposure.truth is not None else ""
        axes.set_title(f"The path{by}{truth}", loc="left", fontsize=11)
        axes.set_ylabel("slope units" if len(outputs) == 1 else "x and y (slope units)")
        axes.label_outer()
