"""Single figures as files, in a paper's size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from aolink.colours import by_rank
from aolink.errors import ExportError
from aolink.exporting.common import Progress, no_progress
from aolink.files import writing
from aolink.plotting.devices import plot_latency, plot_losses
from aolink.plotting.exposure import plot_exposure
from aolink.plotting.overview import need_exposures, overview
from aolink.plotting.pupil import plot_pupil
from aolink.plotting.scene import plot_scene
from aolink.plotting.session import plot_blur, plot_errors, plot_nis
from aolink.plotting.style import TimeUnit, is_narrow, new_figure, paper

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from aolink.recording.reader import Recording

FORMATS = (".png", ".svg", ".pdf")
_DATED = {".svg": "Date", ".pdf": "CreationDate"}
"""Metadata into which matplotlib would write the time of day: the same recording must give the same file."""


@dataclass(frozen=True)
class _Figure:
    what: str
    """The content of the figure, in words."""
    height: float
    """Height of the figure as a share of its width."""
    draw: Callable[..., Axes] | None = None
    """Function that draws it from an overview, on axes; None for figures of one exposure, or of the pupil."""
    narrow: float = 1.5
    """Its height on a narrow figure, as a multiple."""


FIGURES = {
    "blur": _Figure("the camera's blur over the session, and the paths", 0.42, plot_blur),
    "exposure": _Figure("one exposure: path over blur, its histogram, the intensity profile", 0.40, narrow=2.6),
    "nis": _Figure("the NIS of each estimator with its bounds", 0.55, plot_nis),
    "errors": _Figure("the error of each estimator's path along the session", 0.55, plot_errors),
    "losses": _Figure("frames and exposures lost, late, gated or skipped, and when", 0.45, plot_losses),
    "latency": _Figure("when each step of the loop was done", 0.55, plot_latency),
    "pupil": _Figure("maps over the lenslets: light, slopes, blur, NIS", 0.62, narrow=2.2),
    "scene": _Figure("the picture of one exposure as it came, restored, and at rest", 0.36),
}
"""Single figures by name."""


def save_figure(
    recording: Recording, what: str, path: str | Path, *, estimators: Sequence[str] | None = None,
    exposure: int | None = None, output: int = 0, spot: int = 0, unit: TimeUnit = "s", width_mm: float = 180.0,
    overwrite: bool = False, progress: Progress = no_progress,
) -> Path:  # fmt: skip
    """Write one of the figures of `FIGURES` as a PNG, SVG or PDF file.

    Parameters
    ----------
    what:
        Name of the figure.
    path:
        The file to write; its suffix sets the format.
    estimators:
        Estimators whose paths and NIS are drawn; the default is that of the figure's own function.
    exposure:
        Number of the exposure, for ``exposure`` and ``scene``; by default the one with the largest blur.
    output, spot:
        Output whose blur is drawn, and spot of the exposure that is drawn.
    unit:
        The unit of time axes.
    width_mm:
        Width on paper.
    overwrite:
        Whether a file of that name may be replaced.
    progress:
        Called with the number of exposures read.

    Raises
    ------
    RecordingError
        There are no estimates of such a name.
    ExportError
        There is no such figure or format, the recording has nothing to draw in it, the file exists already or cannot
        be written, or matplotlib is missing.
    """
    path = Path(path)
    if what not in FIGURES:
        raise ExportError(f"there is no figure {what!r}; there are: {', '.join(FIGURES)}")
    if path.suffix.lower() not in FORMATS:
        raise ExportError(f"cannot write {path}: a figure is a {', '.join(FORMATS)} file; give such a name")
    kind, on_plane = FIGURES[what], what == "exposure" and recording.rig.sensor.directions == 2
    with paper():
        figure = new_figure(width_mm, width_mm * kind.height)
        narrow = is_narrow(figure)
        higher = (kind.narrow if narrow else 1.0) * ((1.2 if narrow else 1.5) if on_plane else 1.0)
        figure.set_figheight(figure.get_figheight() * higher)
        if what == "pupil":
            plot_pupil(recording, figure, estimator=by_rank(list(estimators))[-1] if estimators else None)
        elif kind.draw is not None:
            view = overview(recording, estimators, output=output, progress=progress)
            named = {"names": ["truth", *view.names]} if kind.draw is plot_blur and estimators is not None else {}
            kind.draw(view, figure.subplots(), unit=unit, **named)
        else:
            if exposure is None:
                view = overview(recording, estimators, progress=progress)
                need_exposures(view)
                exposure = next(iter(view.telling()))
            if what == "scene":
                plot_scene(recording, exposure, figure)
            else:
                plot_exposure(recording, exposure, figure, estimators=estimators, spot=spot, unit=unit)
        metadata = {key: None for suffix, key in _DATED.items() if suffix == path.suffix.lower()}
        with writing(path, overwrite=overwrite, sources=recording.files, error=ExportError) as partial:
            figure.savefig(partial, format=path.suffix.lower()[1:], metadata=metadata)
    return path
