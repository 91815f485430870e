"""The lattice of spots on a frame, found from the frame alone: kind, pitch, rotation, and which spots are missing."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from aolink.errors import FrameError
from aolink.numerics.arrays import BoolArray, FloatArray, IntArray
from aolink.optics.maxima import (
    Maxima,
    find_maxima,
    flatten,
    likeness,
    maxima_above,
    noise_map,
    refine,
    smoothed_noise,
    spot_sd,
    with_sharp_spots,
)

Kind = Literal["square", "hexagonal"]

# The fewest spots of a lattice, and the fewest that must be neighbours for the search to start from them.
_FEWEST_SPOTS, _SEED = 7, 4
# How far from its node a spot may be to belong to it, in pitches.
_NEAR = 0.25
# Steps from a node to half of its neighbours, as (columns, rows); the other half are their opposites. The first
# step of a hexagonal lattice goes along the row and the second one 60 degrees from it.
_MOVES: dict[Kind, IntArray] = {"square": np.array([(1, 0), (0, 1)]), "hexagonal": np.array([(1, 0), (0, 1), (-1, 1)])}
_ANGLE: dict[Kind, float] = {"square": math.pi / 2, "hexagonal": math.pi / 3}
# The search takes differences to this many neighbours, from this many spots, tries this many of the commonest
# differences as steps, and follows this many of the lattices that they suggest.
_NEIGHBOURS, _ASKED, _STEPS, _GUESSES = 24, 400, 16, 6
# How often a lattice is fitted anew to the spots that lie on it, each time further out.
_ROUNDS = 12
# A guessed step and a difference of two spots count as equal if they differ by less than this share of the step.
_ALIKE = 0.15
# A maximum less bright than this share of the spots' median is a ring or a ghost, which the lattice need not explain.
_RIVAL = 0.25
# A lattice that explains this share of the maxima is taken at once; below it, other scales may show a better one.
_CONVINCING = 0.8
# A lattice of at least this many spots is followed where it bends, up to this many pitches from the known spots.
_MANY_SPOTS, _REACH = 40, 2.5
# How far the two steps may be from those of a regular lattice, and a frame's from its reference's, in pitches.
_IRREGULAR, _FOREIGN = 0.2, 0.25
# A maximum fainter than this share of the brightest spot beside it is a ring of that spot. Light apart from the
# largest group of spots is a spot if its shape has at least this correlation with theirs.
_RING, _SHAPE = 0.02, 0.7
# The frame is dark further than this from every known spot, pitches.
_DARK = 1.5
# Spots that are lower than this share of the light between them, over the darkest part of the frame, are out of focus.
_VEILED, _DARKEST = 0.5, 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class Lattice:
    """Spots of a frame and the lattice that fits them: node (i, j) lies at origin + i column_step + j row_step.

    Positions are (x, y) in pixels, 0 is the middle of the first one. On a hexagonal lattice the two steps are 60
    degrees apart, so that each row begins half a pitch further on than the one before.
    """

    kind: Kind
    origin: FloatArray
    column_step: FloatArray
    """Step from a spot to the next one along the row, (2,)."""
    row_step: FloatArray
    """Step from a spot to the one in the next row, (2,)."""
    nodes: IntArray
    """Column i and row j of each spot, from 0, (n, 2), in the order of rows."""
    spots: FloatArray
    """Centroid of each spot, pixels, (n, 2)."""
    background: float
    """Median background of the frame, counts."""

    @property
    def steps(self) -> FloatArray:
        """Column step and row step, (2, 2)."""
        return np.stack([self.column_step, self.row_step])

    @property
    def pitch(self) -> float:
        """Distance between neighbouring spots, pixels, on the regular lattice with cells of the same area."""
        return _pitch(self.kind, self.steps)

    @property
    def turn_deg(self) -> float:
        """Angle from the frame's rows to the lattice's, degrees."""
        return math.degrees(math.atan2(self.column_step[1], self.column_step[0]))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns from the first spot to the last."""
        return int(self.nodes[:, 1].max()) + 1, int(self.nodes[:, 0].max()) + 1

    @property
    def lit(self) -> BoolArray:
        """Mask of the nodes that have a spot, of shape `shape`."""
        lit = np.zeros(self.shape, dtype=np.bool_)
        lit[self.nodes[:, 1], self.nodes[:, 0]] = True
        return lit

    def node_positions(self, nodes: IntArray) -> FloatArray:
        """Positions of nodes (..., 2), pixels."""
        return np.asarray(self.origin + nodes @ self.steps)

    @property
    def lenslet(self) -> FloatArray:
        """Points that fill the cell about a node (a square or a hexagon) evenly, pixels from the node, (144, 2)."""
        part = (np.arange(12) + 0.5) / 12
        points = np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2) @ self.steps
        corners = np.array([(0, 0), (1, 0), (0, 1), (1, 1)]) @ self.steps
        nearest = np.linalg.norm(points[:, None] - corners, axis=-1).argmin(axis=1)
        return np.asarray(points - corners[nearest])

    @property
    def neighbours(self) -> IntArray:
        """Pairs of spots that are side by side, as their numbers, (pairs, 2)."""
        return _side_by_side(self.nodes, _MOVES[self.kind])


def find_lattice(frame: NDArray[np.generic]) -> Lattice:
    """Find the spots of a Shack-Hartmann frame and the square or hexagonal lattice that they lie on.

    The frame has counts of any real type and scale, (rows, columns). Background and single hot pixels are removed, and
    maxima above the noise are found. The differences between neighbouring maxima suggest lattices; each one is followed
    from spot to spot over the largest connected group, and from there to all other spots that lie on its nodes. The
    lattice that explains most spots is taken. Spots may be missing anywhere, and the groups that remain need not touch.
    Raises `FrameError` where there are no spots, or they do not lie on a lattice.
    """
    flat, background = flatten(frame)
    most, rejected = 0, ""
    best: Lattice | None = None
    best_share = 0.0
    for maxima in find_maxima(flat):
        most = max(most, len(maxima.places))
        if len(maxima.places) < _FEWEST_SPOTS:
            continue
        try:
            share, lattice = _explain(maxima, float(np.median(background)))
            if maxima.dense:
                _refuse_veiled(lattice, flat, background)
        except FrameError as error:
            rejected = rejected or str(error)
            continue
        if share > best_share:
            best_share, best = share, lattice
        if share > _CONVINCING:
            break
    if best is None:
        raise FrameError(
            rejected
            or f"no usable spots: {most} stand out of the noise, a grid needs {_FEWEST_SPOTS};"
            " expose longer, or check whether the spots are in focus"
        )
    lattice = _look_again(best, flat)
    flat = with_sharp_spots(frame, flat, background, lattice.spots, lattice.pitch)
    return _fit(lattice.kind, refine(flat, lattice.spots, lattice.pitch), lattice.nodes, lattice.background)


def _explain(maxima: Maxima, background: float) -> tuple[float, Lattice]:
    """The lattice that explains most of the maxima, which are its spots, and the share of these among the maxima of
    their brightness."""
    followed = [_follow(kind, steps, maxima, background) for kind, steps in _guesses(maxima.places)]
    best = max((lattice for lattice in followed if lattice), key=lambda each: len(each.spots), default=None)
    if best is None:
        raise FrameError(
            f"no grid: {len(maxima.places)} spots, and too few of them are neighbours on a square or hexagonal grid;"
            " is this a Shack-Hartmann frame?"
        )
    heights = maxima.heights[cKDTree(maxima.places).query(best.spots)[1]]
    rivals = int((maxima.heights > _RIVAL * np.median(heights)).sum())
    share = len(best.spots) / max(rivals, len(best.spots))
    if share < 0.5:
        raise FrameError(
            f"no grid: of {rivals} spots only {len(best.spots)} lie on one; is this a Shack-Hartmann frame?"
        )
    return share, best


def _guesses(places: FloatArray) -> list[tuple[Kind, FloatArray]]:
    """Lattices that the differences between neighbours suggest, as kind and steps (2, 2), the likeliest first."""
    asked = places[:: math.ceil(len(places) / _ASKED)]
    _, near = cKDTree(places).query(asked, k=min(_NEIGHBOURS + 1, len(places)))
    differences = (places[np.asarray(near)[:, 1:]] - asked[:, None]).reshape(-1, 2)
    tree, length = cKDTree(differences), np.linalg.norm(differences, axis=1)
    votes = np.asarray(tree.query_ball_point(differences, _ALIKE * length, return_length=True))
    found: list[tuple[int, float, Kind, FloatArray]] = []
    while len(found) < 2 * _STEPS and votes.any():
        top = int(votes.argmax())
        step, radius = differences[top], _ALIKE * length[top]
        step = differences[tree.query_ball_point(step, radius)].mean(axis=0)
        for kind, angle in _ANGLE.items():
            pair = _pair(kind, step)
            moves = _MOVES[kind] @ pair
            support = int(np.min(tree.query_ball_point(moves, _ALIKE * np.linalg.norm(step), return_length=True)))
            found.append((support, float(np.linalg.norm(step)), kind, pair))
            # Differences like this step, or like its images under the lattice's symmetry, suggest nothing new.
            for quarter in range(round(2 * math.pi / angle)):
                votes[tree.query_ball_point(step @ _turned(quarter * angle), radius)] = 0
    most = max((support for support, *_ in found), default=0)
    # Twice a step is common as well: among those with good support the shortest come first.
    found.sort(key=lambda guess: (guess[0] < 0.6 * most, guess[1]))
    return [(kind, pair) for support, _, kind, pair in found[:_GUESSES] if support > 0]


def _turned(angle: float) -> FloatArray:
    """The matrix that turns row vectors from x towards y, (2, 2)."""
    return np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])


def _pair(kind: Kind, step: FloatArray) -> FloatArray:
    """Column step and row step of a regular lattice that has this step, the column step nearest to x, (2, 2)."""
    angle = _ANGLE[kind]
    column = step @ _turned(-angle * round(math.atan2(step[1], step[0]) / angle))
    return np.stack([column, column @ _turned(angle)])


def _pitch(kind: Kind, steps: FloatArray) -> float:
    return math.sqrt(abs(float(np.linalg.det(steps))) / math.sin(_ANGLE[kind]))


def _regular(lattice: Lattice) -> bool:
    """Whether the steps have about the lengths and the angle of the kind of lattice."""
    column, row = lattice.steps
    ideal = column @ _turned(_ANGLE[lattice.kind])
    return bool(np.linalg.norm(row - ideal) < _IRREGULAR * np.linalg.norm(column))


def _follow(kind: Kind, steps: FloatArray, maxima: Maxima, background: float) -> Lattice | None:
    """All maxima on the lattice with about these steps, or None where too few are connected."""
    group, nodes = _walk(maxima.places, _MOVES[kind], steps)
    if len(group) < _SEED or np.linalg.matrix_rank(nodes - nodes[0]) < 2:
        return None
    return _grow(_fit(kind, maxima.places[group], nodes, background), maxima)


def _grow(lattice: Lattice, maxima: Maxima) -> Lattice | None:
    """The lattice with all maxima that lie on it, round by round, or None where they bend it out of shape."""
    for _ in range(_ROUNDS):
        # The lattice is extended by its present size about the known spots: further out its nodes are not known yet.
        middle = lattice.spots.mean(axis=0)
        extent = np.linalg.norm(lattice.spots - middle, axis=1).max()
        reached = np.asarray(np.linalg.norm(maxima.places - middle, axis=1) < 2 * extent)
        before, fine = lattice, (maxima.places - lattice.origin) @ np.linalg.inv(lattice.steps)
        found = _assign(lattice, maxima, fine, reached)
        if found is None or not _regular(found):
            return None
        lattice = found
        if np.array_equal(before.spots, lattice.spots):
            break
    return lattice


def _bend(lattice: Lattice, maxima: Maxima) -> Lattice:
    """The lattice with the maxima that lie on it where it bends, as an aberrated wavefront makes it.

    A polynomial of the third degree of a maximum's position gives the node that it belongs to.
    """
    for _ in range(_ROUNDS):
        before, spots = lattice, lattice.spots
        bend = np.linalg.lstsq(_cubic(spots, spots), lattice.nodes, rcond=None)[0]
        reached = np.asarray(cKDTree(spots).query(maxima.places)[0] < _REACH * lattice.pitch)
        found = _assign(lattice, maxima, _cubic(maxima.places, spots) @ bend, reached)
        if found is None or len(found.spots) < len(lattice.spots):
            return before
        lattice = found
        if np.array_equal(before.spots, lattice.spots):
            break
    return lattice


def _assign(lattice: Lattice, maxima: Maxima, fine: FloatArray, reached: BoolArray) -> Lattice | None:
    """The lattice of those maxima whose places in steps, ``fine`` (n, 2), are near a node; the brightest at each node
    is taken."""
    nodes = np.rint(fine).astype(np.int64)
    near = np.flatnonzero(reached & (np.linalg.norm((fine - nodes) @ lattice.steps, axis=1) < _NEAR * lattice.pitch))
    near = near[np.argsort(-maxima.heights[near], kind="stable")]
    _, first = np.unique(nodes[near], axis=0, return_index=True)
    chosen = near[first]
    if len(chosen) < _FEWEST_SPOTS or np.linalg.matrix_rank(nodes[chosen] - nodes[chosen[0]]) < 2:
        return None
    return _fit(lattice.kind, maxima.places[chosen], nodes[chosen], lattice.background)


def _cubic(places: FloatArray, spots: FloatArray) -> FloatArray:
    """Powers of x and y up to the third degree together, in units of the spots' spread, (n, 10)."""
    x, y = ((places - spots.mean(axis=0)) / spots.std(axis=0)).T
    return np.stack([x**p * y**q for p in range(4) for q in range(4 - p)], axis=1)


def _look_again(lattice: Lattice, flat: FloatArray) -> Lattice:
    """The lattice with its fainter spots, where it bends as well, and without light that is near a node by chance.

    The frame is smoothed by the width of the spots, which is known now, and maxima must stand out of the noise far
    from all spots, where there is such a part. Those outside the largest group must have the shape of its spots.
    """
    scale = max(spot_sd(flat, lattice.spots, lattice.pitch) / 2, 0.75)
    smooth = ndimage.gaussian_filter(flat, scale)
    dark = np.ones(flat.shape, dtype=np.bool_)
    dark[tuple(np.rint(lattice.spots).astype(np.int64).T[::-1])] = False
    dark = ndimage.distance_transform_edt(dark) > _DARK * lattice.pitch
    if dark.mean() > _DARKEST:
        maxima = maxima_above(smooth, scale, noise_map(smooth, dark), float(np.median(smooth[dark])))
    else:
        maxima = maxima_above(smooth, scale, smoothed_noise(flat, scale), float(np.quantile(smooth, 0.25)))
    label = _groups(lattice.nodes, _MOVES[lattice.kind])
    known = lattice.spots[label == np.bincount(label).argmax()]
    good = (likeness(flat, maxima.places, known, lattice.pitch) > _SHAPE) | (
        cKDTree(known).query(maxima.places)[0] < lattice.pitch / 8
    )
    candidates = replace(maxima, places=maxima.places[good], heights=maxima.heights[good])
    whole = _grow(lattice, candidates)
    if whole is None:
        return lattice
    if len(whole.spots) >= _MANY_SPOTS:
        whole = _bend(whole, candidates)
    # The rings of a bright spot may reach the nodes beside it.
    heights = ndimage.map_coordinates(smooth, whole.spots.T[::-1], order=1)
    brightest = heights.copy()
    for a, b in (whole.neighbours.T, whole.neighbours.T[::-1]):
        np.maximum.at(brightest, a, heights[b])
    kept = heights > _RING * brightest
    return _fit(whole.kind, whole.spots[kept], whole.nodes[kept], whole.background)


def _refuse_veiled(lattice: Lattice, flat: FloatArray, background: FloatArray) -> None:
    """Raise `FrameError` where the light between blurred spots exceeds their height above it."""
    x, y = np.rint(lattice.spots).astype(np.int64).T
    height = float(np.median(flat[y, x]))
    veil = float(np.median(background[y, x]) - np.quantile(background, _DARKEST))
    if height < _VEILED * veil:
        raise FrameError(
            f"no grid: its spots stand out by {height:.3g} from {veil:.3g} of light between them; are they in focus?"
        )


def _walk(places: FloatArray, moves: IntArray, steps: FloatArray) -> tuple[IntArray, IntArray]:
    """The largest group of spots that are connected by steps, and the node of each."""
    tree, near = cKDTree(places), _NEAR * float(np.linalg.norm(steps[0]))
    edges, taken = [], []
    for move in moves:
        distance, other = tree.query(places + move @ steps, distance_upper_bound=near)
        found = np.flatnonzero(np.isfinite(distance))
        edges.append(np.stack([found, np.asarray(other)[found]]))
        taken.append(np.tile(move, (len(found), 1)))
    (a, b), step = np.concatenate(edges, axis=1), np.concatenate(taken)
    n = len(places)
    graph = sparse.coo_array((np.ones(len(a)), (a, b)), shape=(n, n)).tocsr()
    _, label = connected_components(graph, directed=False)
    group = np.flatnonzero(np.asarray(label) == np.bincount(label).argmax())
    distance, before = dijkstra(graph, directed=False, indices=group[0], unweighted=True, return_predecessors=True)
    sign = {(int(p), int(q)): move for p, q, move in zip(a, b, step, strict=True)}
    nodes = np.zeros((n, 2), dtype=np.int64)
    for k in group[np.argsort(distance[group])][1:]:
        p = int(before[k])
        nodes[k] = nodes[p] + (sign[p, k] if (p, k) in sign else -sign[int(k), p])
    return group, nodes[group]


def _side_by_side(nodes: IntArray, moves: IntArray) -> IntArray:
    """Pairs of nodes that are a move apart, as their numbers, (pairs, 2)."""
    low, high = nodes.min(axis=0) - 1, nodes.max(axis=0) + 1
    number = np.full(high - low + 1, -1)
    at = nodes - low
    number[at[:, 0], at[:, 1]] = np.arange(len(nodes))
    pairs = [np.stack([np.arange(len(nodes)), number[tuple((at + move).T)]], axis=1) for move in moves]
    joined = np.concatenate(pairs)
    return np.asarray(joined[joined[:, 1] >= 0])


def _groups(nodes: IntArray, moves: IntArray) -> IntArray:
    """The number of the connected group that each node belongs to, (n,)."""
    a, b = _side_by_side(nodes, moves).T
    graph = sparse.coo_array((np.ones(len(a)), (a, b)), shape=(len(nodes), len(nodes)))
    return np.asarray(connected_components(graph.tocsr(), directed=False)[1])


def _fit(kind: Kind, spots: FloatArray, nodes: IntArray, background: float) -> Lattice:
    """The lattice that fits spots best in the sense of least squares, its nodes counted from 0."""
    order = np.lexsort((nodes[:, 0], nodes[:, 1]))
    spots, nodes = spots[order], nodes[order] - nodes.min(axis=0)
    design = np.column_stack([np.ones(len(nodes)), nodes])
    (origin, column, row), *_ = np.linalg.lstsq(design, spots, rcond=None)
    return Lattice(
        kind=kind, origin=origin, column_step=column, row_step=row, nodes=nodes, spots=spots, background=background
    )


def match(lattice: Lattice, reference: Lattice) -> Lattice:
    """The lattice with its nodes counted as the reference counts them, and the spots that both have.

    Spots correspond up to whole steps of the lattice: the correspondence that moves the spots least is taken. Raises
    `FrameError` where the two lattices do not belong to one instrument, or share too few spots.
    """
    back = np.linalg.inv(reference.steps)
    # The two may have chosen different directions of a lattice as its rows: 44 and -46 degrees are one square grid.
    turn = np.rint(lattice.steps @ back)
    moved = np.linalg.norm(lattice.steps - turn @ reference.steps, axis=1) / reference.pitch
    if lattice.kind != reference.kind or abs(np.linalg.det(turn) - 1) > 1e-9 or moved.max() > _FOREIGN:
        raise FrameError(
            f"the frame's grid ({lattice.kind}, pitch {lattice.pitch:.2f} px, turned by {lattice.turn_deg:.1f} degrees)"
            f" is not the reference's ({reference.kind}, {reference.pitch:.2f} px, {reference.turn_deg:.1f} degrees)"
        )
    nodes = lattice.nodes @ turn.astype(np.int64)
    offset = np.rint(((lattice.spots - reference.origin) @ back - nodes).mean(axis=0)).astype(np.int64)
    nodes = nodes + offset
    rows, columns = reference.shape
    inside = ((nodes >= 0) & (nodes < [columns, rows])).all(axis=1)
    known = inside & reference.lit[tuple(np.where(inside[:, None], nodes, 0).T[::-1])]
    if known.sum() < _FEWEST_SPOTS:
        raise FrameError(f"the frame and the reference share {int(known.sum())} spots, {_FEWEST_SPOTS} are needed")
    steps = np.linalg.inv(turn) @ lattice.steps
    return replace(
        lattice, origin=lattice.origin - offset @ steps, column_step=steps[0], row_step=steps[1],
        nodes=nodes[known], spots=lattice.spots[known],
    )  # fmt: skip
