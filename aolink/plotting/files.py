"""Single figures as files, in a paper's size."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from aolink.colours import by_rank
from aolink.errors import ExportError
from aolink.exporting.common import Progress, no_progress
from aolink.files import writing
from aolink.plotting.exposure import plot_exposure
from aolink.plotting.overview import need_exposures, overview
from aolink.plotting.pupil import plot_pupil
from aolink.plotting.scene import plot_scene
from aolink.plotting.style import is_narrow, new_figure, paper

if TYPE_CHECKING:
    from aolink.recording.reader import Recording

FORMATS = (".png", ".svg", ".pdf")
_DATED = {".svg": "Date", ".pdf": "CreationDate"}
"""Metadata into which matplotlib would write the time of day: the same recording must give the same file."""
FIGURES = {"exposure": (0.40, 1.04), "pupil": (0.62, 1.36), "scene": (0.36, 0.54)}
"""Single figures by name, with their height as a share of their width; also that where they are narrow."""


def save_figure(
    recording: Recording, what: str, path: str | Path, *, estimators: Sequence[str] | None = None,
    exposure: int | None = None, spot: int = 0, width_mm: float = 180.0, overwrite: bool = False,
    progress: Progress = no_progress,
) -> Path:  # fmt: skip
    """Write one of the figures of `FIGURES` as a PNG, SVG or PDF file.

    Parameters
    ----------
    what:
        Name of the figure.
    path:
        The file to write; its suffix sets the format.
    estimators:
        Estimators whose paths are drawn; the default is that of the figure's own function.
    exposure:
        Number of the exposure, for ``exposure`` and ``scene``; by default the most blurred one.
    spot:
        Number of the spot of the exposure that is drawn.
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
    on_plane = what == "exposure" and recording.rig.sensor.directions == 2
    with paper(), writing(path, overwrite=overwrite, sources=recording.files, error=ExportError) as partial:
        figure = new_figure(width_mm, width_mm)
        narrow = is_narrow(figure)
        more = (1.2 if narrow else 1.5) if on_plane else 1.0
        figure.set_figheight(figure.get_figwidth() * FIGURES[what][narrow] * more)
        if what == "pupil":
            plot_pupil(recording, figure, estimator=by_rank(list(estimators))[-1] if estimators else None)
        else:
            if exposure is None:
                view = overview(recording, estimators, progress=progress)
                need_exposures(view)
                exposure = view.most_blurred
            if what == "scene":
                plot_scene(recording, exposure, figure)
            else:
                plot_exposure(recording, exposure, figure, estimators=estimators, spot=spot)
        metadata = {key: None for suffix, key in _DATED.items() if suffix == path.suffix.lower()}
        figure.savefig(partial, format=path.suffix.lower()[1:], metadata=metadata)
    return path
