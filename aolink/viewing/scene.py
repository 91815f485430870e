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
from aolink.gathered import scene_of
from aolink.viewing.entities import RESTORED_SCENE, RESTORED_SPOTS, SCENE, TRUE_SCENE
from aolink.viewing.palette import MISSING
from aolink.viewing.series import Drawing, send_pictures
from aolink.viewing.timebase import Timebase

if TYPE_CHECKING:
    from aolink.restoration import RestoredPictures


def log_scenes(drawing: Drawing, timebase: Timebase, exposures: Sequence[Exposure]) -> None:
    """Scenes as they came, lost pixels in a colour of their own: ``/scene/image``."""
    sensor = drawing.rig.scene
    known = [(each, picture) for each in exposures if (picture := scene_of(sensor, each)) is not None]
    pictures = [
        np.where(np.isnan(each)[..., None], np.array(MISSING, np.uint8), _grey(each)[..., None]) for _, each in known
    ]
    send_pictures(drawing, SCENE, timebase.at_starts([each for each, _ in known]), pictures)


def log_true_scene(drawing: Drawing, counts: NDArray[np.uint16] | None) -> None:
    """The scene at rest: ``/scene/true``."""
    if drawing.rig.scene is not None and counts is not None:
        drawing.log(TRUE_SCENE, rr.Image(_grey(drawing.rig.scene.to_intensity(counts)), color_model="L"))


def log_restored(
    drawing: Drawing, timebase: Timebase, starts: Mapping[int, int], restored: Sequence[RestoredPictures]
) -> None:
    """Pictures without their blur: ``/restored/image``, ``/restored/spot`` (the most light in it is white).

    ``starts`` has the first steps of their exposures by frame id; a picture without one is left out.
    """
    known = [each for each in restored if each.frame_id in starts]
    found = {
        RESTORED_SCENE: [(each.frame_id, _grey(each.scene)) for each in known if each.scene is not None],
        RESTORED_SPOTS: [
            (each.frame_id, _grey(each.spots / max(float(each.spots.max()), 1e-6)))
            for each in known if each.spots is not None
        ],
    }  # fmt: skip
    for path, pictures in found.items():
        frames = [frame_id for frame_id, _ in pictures]
        times = timebase.at_steps([starts[frame_id] for frame_id in frames], frames)
        send_pictures(drawing, path, times, [picture for _, picture in pictures])


def _grey(intensity: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.asarray(np.rint(255 * np.clip(np.nan_to_num(intensity), 0.0, 1.0)), dtype=np.uint8)
