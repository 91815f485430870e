"""The lattice of spots on a frame, found without knowing anything of it: spots, pitch, turn, which are missing."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from aolink.errors import FrameError
from aolink.optics.centroid import weighted_centroid

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# A spot is a maximum that stands out so many times above the noise of the smoothed frame.
_SIGNIFICANCE = 8.0
_FEWEST_SPOTS = 9
# A pixel so many times as bright as its neighbours is hot: a spot of sd 0.6 pixels or more makes none such.
_HOT = 4.0
# How far from its node a spot may be to belong to it, in pitches.
_NEAR = 0.25
# Background: medians of blocks of so many pixels.
_BLOCK = 32


@dataclass(frozen=True, kw_only=True, eq=False)
class Lattice:
    """Spots of a frame and the lattice that fits them: node (i, j) lies at origin + i column_step + j row_step.

    Positions are (x, y) in pixels, 0 is the middle of the first one.
    """

    origin: FloatArray
    column_step: FloatArray
    """From a spot to the next one along the row, (2,)."""
    row_step: FloatArray
    """From a spot to the one in the next row, (2,)."""
    nodes: IntArray
    """Column i and row j of each spot, from 0, (n, 2), in the order of rows."""
    spots: FloatArray
    """Where each spot is, (n, 2)."""
    background: float
    """Median background of the frame, counts."""

    @property
    def pitch(self) -> float:
        """Side of a cell, the root of its area, pixels."""
        return math.sqrt(abs(float(np.linalg.det(np.stack([self.column_step, self.row_step])))))

    @property
    def turn_deg(self) -> float:
        """Angle of the rows against the frame's, degrees."""
        return math.degrees(math.atan2(self.column_step[1], self.column_step[0]))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns from the first spot to the last."""
        return int(self.nodes[:, 1].max()) + 1, int(self.nodes[:, 0].max()) + 1

    @property
    def lit(self) -> NDArray[np.bool_]:
        """Which nodes have a spot, `shape`."""
        lit = np.zeros(self.shape, dtype=np.bool_)
        lit[self.nodes[:, 1], self.nodes[:, 0]] = True
        return lit

    def node_positions(self, nodes: IntArray) -> FloatArray:
        """Where the lattice has nodes (..., 2), pixels."""
        return np.asarray(self.origin + nodes @ np.stack([self.column_step, self.row_step]))

    @property
    def displacements(self) -> FloatArray:
        """From each spot's node to the spot, pixels, (n, 2)."""
        return self.spots - self.node_positions(self.nodes)


def find_lattice(frame: NDArray[np.generic], *, spot_sd: float = 1.5) -> Lattice:
    """Find the spots of a Shack-Hartmann frame and the lattice that they lie on.

    Background and single hot pixels are taken out, maxima above the noise are found, the differences between
    neighbours tell the two steps, and from spot to neighbouring spot each gets its node; spots may be missing
    anywhere as long as the others hang together.

    Parameters
    ----------
    frame:
        Counts, (rows, columns).
    spot_sd:
        Standard deviation of a spot, about, pixels.

    Raises
    ------
    FrameError
        There are no spots, or they lie on no lattice.
    """
    flat, background = flatten(frame)
    places = _maxima(flat, spot_sd)
    if len(places) < _FEWEST_SPOTS:
        raise FrameError(
            f"no usable spots: {len(places)} stand out of the noise, a grid needs {_FEWEST_SPOTS};"
            " expose longer, or look whether the spots are in focus"
        )
    steps = _steps(places)
    group, nodes = _walk(places, steps)
    # Now with the steps of all spots together, and each spot where a lattice that fits them all has a node.
    lattice = _fit(places[group], nodes, background)
    for _ in range(3):
        wanted = np.rint(np.linalg.solve(_frame_steps(lattice).T, (places - lattice.origin).T).T).astype(np.int64)
        away = np.linalg.norm(places - lattice.node_positions(wanted), axis=1)
        order = np.argsort(away)
        order = order[away[order] < _NEAR * lattice.pitch]
        _, first = np.unique(wanted[order], axis=0, return_index=True)
        chosen = order[first]
        chosen = chosen[_largest_patch(wanted[chosen])]
        lattice = _fit(places[chosen], wanted[chosen], background)
    if len(lattice.spots) < max(_FEWEST_SPOTS, len(places) / 2):
        raise FrameError(
            f"no grid: of {len(places)} spots only {len(lattice.spots)} lie on one; is this a Shack-Hartmann frame?"
        )
    refined = _refine(flat, lattice, spot_sd)
    return _fit(refined, lattice.nodes, background)


def flatten(frame: NDArray[np.generic]) -> tuple[FloatArray, float]:
    """A frame without its background and its isolated hot pixels, and the median background.

    Raises
    ------
    FrameError
        It is not a picture, or has pixels that are not numbers.
    """
    if frame.ndim != 2 or min(frame.shape) < _BLOCK:
        raise FrameError(f"a frame of {_BLOCK} x {_BLOCK} pixels or more is needed, found {frame.shape}")
    counts = frame.astype(np.float64)
    if not np.isfinite(counts).all():
        raise FrameError(f"{int((~np.isfinite(counts)).sum())} pixels are not numbers")
    rows, columns = (max(1, n // _BLOCK) for n in counts.shape)
    blocks = [[np.median(part) for part in np.array_split(strip, columns, 1)] for strip in np.array_split(counts, rows)]
    smooth = ndimage.zoom(
        np.array(blocks), (counts.shape[0] / rows, counts.shape[1] / columns), order=1, mode="nearest", grid_mode=True
    )  # fmt: skip
    flat = counts - smooth
    ring = np.ones((3, 3), dtype=np.bool_)
    ring[1, 1] = False
    # A hot pixel, or one of a pair, is far brighter than its second brightest neighbour; light through a lens is not.
    second = ndimage.rank_filter(flat, -2, footprint=ring)
    alone = flat - _HOT * np.maximum(second, 0) > 6 * _spread(flat)
    around = ndimage.median_filter(flat, 3)
    return np.where(alone, around, flat), float(np.median(smooth))


def _spread(values: FloatArray) -> float:
    """Standard deviation by the median of what deviates: spots do not count."""
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 1e-12)


def _maxima(flat: FloatArray, spot_sd: float) -> FloatArray:
    """Maxima of the smoothed frame that stand out of its noise, (n, 2) as (x, y)."""
    smooth = ndimage.gaussian_filter(flat, spot_sd)
    top = ndimage.maximum_filter(smooth, 2 * math.ceil(2 * spot_sd) + 1)
    y, x = np.nonzero((smooth == top) & (smooth > _SIGNIFICANCE * _spread(smooth)))
    return np.stack([x, y], axis=1).astype(np.float64)


def _steps(places: FloatArray) -> FloatArray:
    """The two steps of the lattice, from the differences that neighbours have most often, (2, 2)."""
    _, neighbours = cKDTree(places).query(places, k=min(9, len(places)))
    difference = (places[np.asarray(neighbours)[:, 1:]] - places[:, None]).reshape(-1, 2)
    difference = difference[difference[:, 0] > np.abs(difference[:, 1]) * 0.9]  # to the right
    if len(difference) < _FEWEST_SPOTS:
        raise FrameError(f"no grid: the {len(places)} spots have no step in common along a row")
    length = np.linalg.norm(difference, axis=1)
    tree = cKDTree(difference)
    votes = np.asarray(tree.query_ball_point(difference, 0.15 * length, return_length=True))
    # Of all steps that are common, the shortest: two lenslets' step is common as well.
    common = np.flatnonzero(votes > 0.5 * votes.max())
    chosen = common[length[common].argmin()]
    along = difference[tree.query_ball_point(difference[chosen], 0.15 * length[chosen])].mean(axis=0)
    return np.stack([along, [-along[1], along[0]]])


def _walk(places: FloatArray, steps: FloatArray) -> tuple[IntArray, IntArray]:
    """The largest group of spots that are steps apart, and each one's node."""
    tree, near = cKDTree(places), _NEAR * float(np.linalg.norm(steps[0]))
    edges, moves = [], []
    for move in ((1, 0), (0, 1)):
        distance, other = tree.query(places + np.array(move) @ steps, distance_upper_bound=near)
        found = np.flatnonzero(np.isfinite(distance))
        edges.append(np.stack([found, np.asarray(other)[found]]))
        moves.append(np.tile(move, (len(found), 1)))
    (a, b), step = np.concatenate(edges, axis=1), np.concatenate(moves)
    n = len(places)
    graph = sparse.coo_array((np.ones(len(a)), (a, b)), shape=(n, n)).tocsr()
    _, label = connected_components(graph, directed=False)
    group = np.flatnonzero(np.asarray(label) == np.bincount(label).argmax())
    if len(group) < _FEWEST_SPOTS:
        raise FrameError(f"no grid: of {n} spots no more than {len(group)} hang together in steps of a lattice")
    distance, before = dijkstra(graph, directed=False, indices=group[0], unweighted=True, return_predecessors=True)
    sign = {(int(p), int(q)): move for p, q, move in zip(a, b, step, strict=True)}
    nodes = np.zeros((n, 2), dtype=np.int64)
    for k in group[np.argsort(distance[group])][1:]:
        p = int(before[k])
        nodes[k] = nodes[p] + (sign[p, k] if (p, k) in sign else -sign[int(k), p])
    return group, nodes[group]


def _largest_patch(nodes: IntArray) -> NDArray[np.bool_]:
    """Which nodes hang together side by side: what only happens to lie near a node far away is no spot."""
    column, row = (nodes - nodes.min(axis=0)).T
    lit = np.zeros((row.max() + 1, column.max() + 1), dtype=np.bool_)
    lit[row, column] = True
    patch = np.asarray(ndimage.label(lit)[0])[row, column]
    return np.asarray(patch == np.bincount(patch).argmax())


def _fit(spots: FloatArray, nodes: IntArray, background: float) -> Lattice:
    """The lattice that fits spots best in the sense of least squares, its nodes counted from 0."""
    order = np.lexsort((nodes[:, 0], nodes[:, 1]))
    spots, nodes = spots[order], nodes[order] - nodes.min(axis=0)
    design = np.column_stack([np.ones(len(nodes)), nodes])
    (origin, column, row), *_ = np.linalg.lstsq(design, spots, rcond=None)
    return Lattice(
        origin=origin, column_step=column, row_step=row, nodes=nodes, spots=spots, background=background
    )  # fmt: skip


def _frame_steps(lattice: Lattice) -> FloatArray:
    return np.stack([lattice.column_step, lattice.row_step])


def _refine(flat: FloatArray, lattice: Lattice, spot_sd: float) -> FloatArray:
    """Each spot's weighted centroid in a window about it."""
    half = max(2, math.floor(lattice.pitch / 2 - 0.5))
    windows, corners = cut_windows(flat, lattice.spots, half)
    found = corners + weighted_centroid(windows, 1.5 * spot_sd)
    moved = np.linalg.norm(found - lattice.spots, axis=1) < _NEAR * lattice.pitch
    return np.where(moved[:, None], found, lattice.spots)


def cut_windows(frame: FloatArray, middles: FloatArray, half: int) -> tuple[FloatArray, FloatArray]:
    """Square windows of 2 half + 1 pixels about the pixels nearest to ``middles``, zero beyond the frame.

    Returns
    -------
    (n, side, side), and the middle of each window's first pixel on the frame as (x, y), (n, 2).
    """
    side = 2 * half + 1
    corners = np.rint(middles).astype(np.int64) - half
    padded = np.pad(frame, side)
    view = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    inside = np.clip(corners + side, 0, np.array(view.shape[1::-1]) - 1)
    return view[inside[:, 1], inside[:, 0]].copy(), corners.astype(np.float64)


def match(lattice: Lattice, reference: Lattice) -> Lattice:
    """The lattice with its nodes counted as the reference counts them, and the spots that both have.

    Which spot is which is known up to a whole step: the step is taken that moves the spots least.

    Raises
    ------
    FrameError
        The two are not of one instrument, or share too few spots.
    """
    if abs(lattice.pitch / reference.pitch - 1) > 0.2 or abs(lattice.turn_deg - reference.turn_deg) > 10:
        raise FrameError(
            f"the frame's grid (pitch {lattice.pitch:.2f} px, turned by {lattice.turn_deg:.1f} degrees) is not the"
            f" reference's ({reference.pitch:.2f} px, {reference.turn_deg:.1f} degrees)"
        )
    middle = lattice.spots.mean(axis=0)
    steps = _frame_steps(reference)
    here = np.linalg.solve(_frame_steps(lattice).T, middle - lattice.origin)
    offset = np.rint(np.linalg.solve(steps.T, middle - reference.origin) - here).astype(np.int64)
    nodes = lattice.nodes + offset
    known = (nodes[:, None] == reference.nodes).all(axis=-1).any(axis=1)
    if known.sum() < _FEWEST_SPOTS:
        raise FrameError(f"the frame and the reference share {int(known.sum())} spots, {_FEWEST_SPOTS} are needed")
    return replace(
        lattice, origin=lattice.origin - offset @ _frame_steps(lattice), nodes=nodes[known], spots=lattice.spots[known]
    )  # fmt: skip
