"""A picture as it came, without its blur, and at rest."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from aolink.errors import ExportError
from aolink.gathered import SCENES, scene_of
from aolink.numerics.arrays import FloatArray
from aolink.plotting.exposure import step_of
from aolink.plotting.style import figure_or_new
from aolink.recording.reader import Recording

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

_PICTURE_IN = (3.0, 3.2)


def plot_scene(recording: Recording, number: int, figure: Figure | SubFigure | None = None) -> Figure | SubFigure:
    """Draw the picture sensor's scene of one exposure: as it came, restored, and at rest, as far as these exist.

    They are beside each other, on a figure higher than wide under each other. All have the same grey: black is dark,
    white an intensity of one. Pixels that never came are red. For a rig without a picture sensor whose spots were
    restored, the frame of the spots is drawn.

    Parameters
    ----------
    number:
        Number of the exposure in the recording, counted from 0.
    figure:
        The figure to draw on; by default a new one.

    Raises
    ------
    ExportError
        There is no such exposure, it has no picture and was not restored, or matplotlib is missing.
    """
    pictures = _pictures(recording, number)
    figure = figure_or_new(figure, (_PICTURE_IN[0] * len(pictures), _PICTURE_IN[1]))
    upright = figure.bbox.height > figure.bbox.width
    shape = (len(pictures), 1) if upright else (1, len(pictures))
    axes = figure.subplots(*shape, squeeze=False).ravel()
    shown: Any = None
    for each, (title, picture) in zip(axes, pictures.items(), strict=True):
        each.set_facecolor("tab:red")
        shown = each.imshow(picture, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest")
        each.set_title(title)
        each.set_xticks([])
        each.set_yticks([])
    what = "intensity (1 = full)" if recording.rig.scene is not None else "share of the brightest pixel"
    where = "bottom" if upright else "right"
    figure.colorbar(shown, ax=list(axes), label=what, shrink=0.8, location=where)
    return figure


def _pictures(recording: Recording, number: int) -> dict[str, FloatArray]:
    """Pictures of one exposure by their description, intensity; NaN where a pixel never came."""
    exposure, sensor, found = step_of(recording, number, []).exposure, recording.rig.scene, {}
    restored = next((each for each in recording.restored() if each.frame_id == exposure.frame_id), None)
    how = f"{SCENES['restored']} ({restored.estimator}, {restored.method})" if restored is not None else ""
    if (came := scene_of(sensor, exposure)) is not None and sensor is not None:
        found[SCENES["came"]] = came
        if restored is not None and restored.scene is not None:
            found[how] = restored.scene.astype(np.float64)
        if (true := recording.true_scene) is not None:
            found[SCENES["true"]] = sensor.to_intensity(true)
    elif restored is not None and restored.spots is not None:
        light = exposure.pixels.astype(np.float64) - recording.rig.sensor.black_level
        pictures = {f"the frame {SCENES['came']}": np.where(exposure.mask, light, np.nan), how: restored.spots}
        found = {title: picture / max(float(np.nanmax(picture)), 1e-12) for title, picture in pictures.items()}
    if not found:
        raise ExportError(f"exposure {number} of {recording.path} has no picture; `aolink deblur` restores frames")
    return found
