"""Views of the picture sensor's scene as it came, without its blur, and at rest; and of the spots' frames without their
blur.

All scenes are drawn alike: black is dark, white an intensity of one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from aolink.exposure import Exposure
from aolink.optics.scene import SceneSensor
from aolink.viewing.entities import RESTORED_SCENE, RESTORED_SPOTS, SCENE, TRUE_SCENE
from aolink.viewing.palette import MISSING
from aolink.viewing.series import Drawing
from aolink.viewing.timebase import Timebase

if TYPE_CHECKING:
    from aolink.restoration import RestoredPictures


def log_scenes(drawing: Drawing, sensor: SceneSensor, timebase: Timebase, exposures: Sequence[Exposure]) -> bool:
    """Scenes as they came, lost pixels in a colour of their own: ``/scene/image``; gives whether there is one."""
    known = [(e, e.scene) for e in exposures if e.scene is not None]
    pictures = []
    for _, scene in known:
        grey = np.repeat(_grey(sensor.to_intensity(scene.pixels))[..., None], 3, axis=2)
        grey[~scene.mask] = MISSING
        pictures.append(grey)
    _send(drawing, SCENE, timebase, [e.first_step for e, _ in known], [e.frame_id for e, _ in known], pictures)
    return bool(known)


def log_true_scene(drawing: Drawing, sensor: SceneSensor, counts: NDArray[np.uint16]) -> None:
    """The scene at rest: ``/scene/true``."""
    drawing.log(TRUE_SCENE, rr.Image(_grey(sensor.to_intensity(counts)), color_model="L"))


def log_restored(
    drawing: Drawing, timebase: Timebase, starts: Mapping[int, int], restored: Sequence[RestoredPictures]
) -> bool:
    """Pictures without their blur: ``/restored/image``, ``/restored/spot`` (the most light in it is white).

    ``starts`` has the first steps of their exposures by frame id. Gives whether there was a scene.
    """
    scenes = [(each.frame_id, _grey(each.scene)) for each in restored if each.scene is not None]
    lit = [(each.frame_id, each.spots) for each in restored if each.spots is not None]
    spots = [(frame_id, _grey(light / max(float(light.max()), 1e-6))) for frame_id, light in lit]
    for path, pictures in ((RESTORED_SCENE, scenes), (RESTORED_SPOTS, spots)):
        frames = [frame_id for frame_id, _ in pictures]
        _send(drawing, path, timebase, [starts[k] for k in frames], frames, [picture for _, picture in pictures])
    return bool(scenes)


def _grey(intensity: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.asarray(np.rint(255 * np.clip(intensity, 0.0, 1.0)), dtype=np.uint8)


def _send(
    drawing: Drawing, path: str, timebase: Timebase, steps: Sequence[int], frames: Sequence[int],
    pictures: Sequence[NDArray[np.uint8]],
) -> None:  # fmt: skip
    """Send pictures of one shape, (rows, columns) or (rows, columns, 3), one for each row of the time columns."""
    if not pictures:
        return
    height, width = pictures[0].shape[:2]
    model = rr.ColorModel.RGB if pictures[0].ndim == 3 else rr.ColorModel.L
    layout = rr.components.ImageFormat(width=width, height=height, color_model=model, channel_datatype="U8")
    drawing.log(path, rr.Image.from_fields(format=layout))
    buffers = np.stack([picture.ravel() for picture in pictures])
    drawing.send_columns(path, timebase.at_steps(steps, frames), rr.Image.columns(buffer=buffers))
