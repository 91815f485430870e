"""One exposure of a recording explained in one PNG."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aolink.errors import ExportError
from aolink.files import writing
from aolink.gathered import PER_SLOPE, SLOPES, Blur
from aolink.plotting.exposure import draw_intensity, draw_paths, draw_spot, step_of
from aolink.plotting.overview import need_exposures, overview
from aolink.plotting.scene import plot_scene
from aolink.plotting.session import plot_blur
from aolink.plotting.style import MM, legend_above, new_figure, paper
from aolink.recording.reader import Recording

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

    from aolink.series import Series, Step

_SIZE_MM, _DPI = (16 / MM, 10 / MM), 110
_NEAR = 4
"""Exposures before and after the one that is explained whose blur is drawn."""
_STYLE = {
    "font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False,
}  # fmt: skip


def draw_session(series: Series, path: str | Path) -> Path:
    """Draw the most blurred exposure of a series: the blur with the path through it, the intensity profile with what
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
    view = overview(series)
    need_exposures(view)
    number = view.most_blurred
    step, rig = step_of(series, number, view.names), series.rig
    with paper(_STYLE):
        figure = new_figure(*_SIZE_MM)
        figure.suptitle(f"{rig.name}: exposure {number}, the most blurred", x=0.01, ha="left", fontsize=13)
        has_scene = isinstance(series, Recording) and step.exposure.scene is not None
        shares = [1.0, 1.0, 0.55] if has_scene else [1.0, 1.0]
        columns: Any = figure.subfigures(1, len(shares), width_ratios=shares)
        above, below = columns[0].subfigures(2, 1)
        if rig.sensor.directions == 2:
            draw_spot(_axes_titled(above, "The blur of a spot, and the paths through it"), rig, step, 0)
        else:
            first = max(0, number - _NEAR)
            near = overview(series[first : number + _NEAR])
            axes = _axes_titled(above, f"The blur of {len(near)} exposures, and the paths through it")
            plot_blur(near, axes)
            begin, end = near.spans[number - first] * rig.timing.fast_step_s
            axes.axvspan(begin, end, fill=False, edgecolor="tab:red", linewidth=1.5)
        axes = _axes_titled(below, "The intensity profile, and what each path predicts for it")
        blur = Blur.of(rig, step, 0)
        draw_intensity(axes, blur)
        axes.set(xlim=blur.limits, ylim=(0, None), xlabel=f"position ({SLOPES})", ylabel=f"intensity ({PER_SLOPE})")
        legend_above(axes)
        _draw_bands(columns[1], series, step)
        if isinstance(series, Recording) and has_scene:
            plot_scene(series, number, columns[2])
        with writing(Path(path), overwrite=True, error=ExportError) as partial:
            figure.savefig(partial, format="png", dpi=_DPI)
    return Path(path)


def _axes_titled(figure: SubFigure, title: str) -> Axes:
    figure.suptitle(title, x=0.02, ha="left", fontsize=11)
    return figure.subplots()


def _draw_bands(figure: SubFigure, series: Series, step: Step) -> None:
    """Draw a panel for each estimator, with its path and the truth."""
    outputs = list(range(series.rig.sensor.directions))
    shown = [[name] for name in step.estimates] or [[]]
    panels: Any = figure.subplots(len(shown), 1, sharex=True, sharey=True, squeeze=False)
    for axes, names in zip(panels[:, 0], shown, strict=True):
        only = replace(step, estimates={name: step.estimates[name] for name in names})
        draw_paths(axes, series.rig, only, outputs)
        by = "".join(f" by {name}, its 95 % band" for name in names)
        truth = ", and the truth (black)" if step.exposure.truth is not None else ""
        axes.set_title(f"The path{by}{truth}", loc="left", fontsize=11)
        axes.set_ylabel(SLOPES if len(outputs) == 1 else f"x and y ({SLOPES})")
        axes.label_outer()
