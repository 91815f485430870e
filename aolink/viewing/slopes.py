"""One Shack-Hartmann frame against its reference as a Rerun file: spots, arrows, wavefront."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from aolink.slopes import FrameSlopes
from aolink.viewing.rrd_file import new_rrd

_ARROW = 5.0
"""How much longer than the displacements the arrows are."""
_DARK = (40, 40, 40)
"""Of a lenslet without a spot."""


def save_slopes(result: FrameSlopes, path: Path, *, overwrite: bool = False) -> None:
    """Write the picture of a frame's slopes as .rrd. Raises `ViewerError`."""
    low, high = np.percentile(result.frame, [1, 99.7])
    grey = (np.clip((result.frame - low) / max(high - low, 1e-12), 0, 1) ** 0.7 * 255).astype(np.uint8)
    lattice = result.lattice
    column, row = lattice.nodes.T
    arrows = _ARROW * result.displacements_px[row, column]
    middle = 0.5  # Rerun counts a picture from its first pixel's corner
    with new_rrd("aolink_slopes", path, overwrite=overwrite) as stream:
        stream.log("frame", rr.Image(grey), static=True)
        for name, places, colour, size in (
            ("reference", result.reference.spots, (90, 130, 255), 1.5),
            ("spots", lattice.spots, (255, 160, 0), 3.0),
        ):
            points = rr.Points2D(places + middle, colors=colour, radii=rr.Radius.ui_points(size))
            stream.log(f"frame/{name}", points, static=True)
        drawn = rr.Arrows2D(origins=lattice.spots + middle, vectors=arrows, colors=(0, 230, 60), radii=0.4)
        stream.log("frame/slopes", drawn, static=True)
        stream.log("wavefront", rr.Image(_coloured(result.wavefront)), static=True)
        views = [
            rrb.Spatial2DView(origin="frame", name=f"frame; displacements x {_ARROW:g}, less their mean"),
            rrb.Spatial2DView(origin="wavefront", name="wavefront: red ahead, blue behind"),
        ]
        panels = rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
        stream.send_blueprint(rrb.Blueprint(rrb.Horizontal(contents=views), *panels, rrb.TimePanel(state="hidden")))


def _coloured(wavefront: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Grey at zero, red above, blue below, (rows, columns, 3)."""
    known = np.isfinite(wavefront)
    share = np.where(known, wavefront, 0) / max(float(np.abs(wavefront[known]).max()), 1e-300)
    colour = np.stack([127 + 127 * share, 127 - 100 * np.abs(share), 127 - 127 * share], axis=-1)
    return np.where(known[..., None], colour, _DARK).astype(np.uint8)
