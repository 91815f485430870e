"""An overview of a recording as one PNG, for machines on which the viewer cannot draw."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from aolink.errors import ExportError
from aolink.extensions import install_command
from aolink.files import writing
from aolink.plotting.exposure import plot_exposure
from aolink.plotting.overview import Overview, need_exposures, overview
from aolink.plotting.session import plot_blur, plot_errors
from aolink.plotting.style import colour

if TYPE_CHECKING:
    from aolink.series import Series

_SIZE_IN, _DPI = (16.0, 11.5), 110
_CLOSE_UPS = 3
"""Exposures whose inside is drawn."""
_STYLE: dict[Any, Any] = {
    "font.size": 10, "axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False,
}  # fmt: skip


def draw_session(series: Series, path: str | Path) -> Path:
    """Draw a series: intensity over the session, the inside of some exposures, the errors where truth is known.

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
    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=_SIZE_IN, layout="constrained")
        figure.suptitle(f"{series.rig.name}: {series.path.name}", x=0.01, ha="left", fontsize=13)
        rows: Any = figure.subfigures(3, 1, height_ratios=[1.25, 2.0, 1.15])
        above, middle, below = rows
        plot_blur(view, above.subplots())
        chosen = _close_ups(view)
        places: Any = middle.subfigures(1, len(chosen), squeeze=False)
        for place, number in zip(places[0], chosen, strict=True):
            plot_exposure(series, number, place)
            place.supxlabel(f"inside exposure {number} (frame {view.frame_ids[number]})")
        _draw_errors(below, view)
        with writing(Path(path), overwrite=True, error=ExportError) as partial:
            figure.savefig(partial, format="png", dpi=_DPI)
    return Path(path)


def _close_ups(view: Overview) -> list[int]:
    """The exposure in which the spot moved most, from each third of the session."""
    edges = np.unique(np.linspace(0, len(view), _CLOSE_UPS + 1).astype(int))
    moved = np.nan_to_num(view.moved, nan=-1.0)
    return [int(a + np.argmax(moved[a:b])) for a, b in pairwise(edges)]


def _draw_errors(figure: Any, view: Overview) -> None:
    """Draw the error of the path along the session, and over all of it."""
    over_time, whole = figure.subplots(1, 2, width_ratios=[2, 1])
    if not view.errors:
        for axes in (over_time, whole):
            axes.set_axis_off()
        over_time.set_title("No errors: the recording holds no truth or no estimates", loc="left")
        return
    plot_errors(view, over_time)
    names = list(view.errors)
    overall = [view.scores[name].path_rmse for name in names]
    places = np.arange(len(names))[::-1]
    whole.barh(places, overall, color=[colour(name) for name in names])
    for place, value in zip(places, overall, strict=True):
        whole.annotate(f" {value:.3g}", (value, place), va="center")
    whole.set_yticks(places, names)
    whole.set(xlabel="RMSE of the path over the whole session (slope units)")
    whole.margins(x=0.15)
