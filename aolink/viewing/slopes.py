"""One Shack-Hartmann frame against its reference as a Rerun file: spots, arrows, wavefront."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aolink.optics.slopes import FrameSlopes
from aolink.viewing.rrd_file import new_rrd

_ARROW = 5.0
"""Length of an arrow divided by the displacement that it shows."""
_CELL = 12
"""Points of the wavefront's picture from a lenslet to the next one."""
_DARK = (40, 40, 40)
"""Colour of a lenslet without a spot."""


def save_slopes(result: FrameSlopes, path: Path, *, overwrite: bool = False) -> None:
    """Write the picture of a frame's slopes as .rrd. Raises `ViewerError`."""
    low, high = np.percentile(result.frame, [1, 99.7])
    grey = (np.clip((result.frame - low) / max(high - low, 1e-12), 0, 1) ** 0.7 * 255).astype(np.uint8)
    lattice = result.lattice
    column, row = lattice.nodes.T
    cells = lenslet_map(result)
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
        stream.log("wavefront", rr.Image(_coloured(cells)), static=True)
        views = [
            rrb.Spatial2DView(origin="frame", name=f"frame; displacements x {_ARROW:g}, less their mean"),
            rrb.Spatial2DView(origin="wavefront", name="wavefront: red ahead, blue behind"),
        ]
        panels = rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
        stream.send_blueprint(rrb.Blueprint(rrb.Horizontal(contents=views), *panels, rrb.TimePanel(state="hidden")))


def lenslet_map(result: FrameSlopes) -> NDArray[np.float64]:
    """The wavefront in the frame's orientation; each lenslet is a square or a hexagon, turned like the lattice.

    Returns
    -------
    (rows, columns) of some `_CELL` points a pitch over the reference's lenslets; NaN where there is no spot.
    """
    reference = result.reference
    step = reference.pitch / _CELL
    middles = reference.node_positions(reference.nodes)
    low, high = middles.min(axis=0) - reference.pitch, middles.max(axis=0) + reference.pitch
    x, y = (np.arange(start, stop, step) for start, stop in zip(low, high, strict=True))
    # The cell of a node is the region nearer to it than to any other node, with a spot or without.
    rows, columns = result.wavefront.shape
    nodes = np.stack(np.meshgrid(np.arange(-1, columns + 1), np.arange(-1, rows + 1)), axis=-1)
    tree = cKDTree(reference.node_positions(nodes).reshape(-1, 2))
    nearest = tree.query(np.stack(np.meshgrid(x, y), axis=-1))[1]
    return np.asarray(np.pad(result.wavefront, 1, constant_values=np.nan).ravel()[nearest])


def _coloured(wavefront: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Grey at zero, red above, blue below, (rows, columns, 3)."""
    known = np.isfinite(wavefront)
    share = np.where(known, wavefront, 0) / max(float(np.abs(wavefront[known]).max()), 1e-300)
    colour = np.stack([127 + 127 * share, 127 - 100 * np.abs(share), 127 - 127 * share], axis=-1)
    return np.where(known[..., None], colour, _DARK).astype(np.uint8)
