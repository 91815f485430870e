"""The lattice of spots: synthetic frames of any pitch and turn with what is missing, and what is none."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from aolink.errors import FrameError
from aolink.optics.lattice import find_lattice, match
from aolink.optics.maxima import cut_windows
from tests.spot_frames import ANGLES, as_dtype, nodes_and_places, spots_frame


def synthetic(pitch=18.3, turn=2.0, shape=(9, 11), missing=0.0, seed=0, noise=5.0, side=256, jitter=0.0, sd=1.5):
    """A frame, where its spots are, and their nodes."""
    rng = np.random.default_rng(seed)
    turn = np.deg2rad(turn)
    steps = pitch * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    nodes = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1).reshape(-1, 2)
    nodes = nodes[rng.random(len(nodes)) >= missing]
    places = (nodes - (np.array(shape[::-1]) - 1) / 2) @ steps + side / 2 + rng.uniform(-3, 3, 2)
    places += rng.normal(0, jitter, places.shape)
    y, x = np.mgrid[:side, :side]
    frame = 1000 + 0.5 * x + rng.normal(0, noise, (side, side))  # the background slopes
    for place in places:
        frame += 600 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * sd**2))
    hot = rng.integers(0, side, (25, 2))
    frame[hot[:, 0], hot[:, 1]] += rng.uniform(200, 5000, 25)
    return frame, places, nodes


def displacements(lattice):
    """From each spot's node to the spot, pixels, (n, 2)."""
    return lattice.spots - lattice.node_positions(lattice.nodes)


@pytest.mark.slow
@given(pitch=st.floats(12, 24), turn=st.floats(-20, 20), missing=st.floats(0, 0.2), seed=st.integers(0, 99))
@example(pitch=12, turn=0, missing=0.1875, seed=87)  # what is missing parts the spots in two groups
@settings(max_examples=15)
def test_spots_are_found_and_numbered_whatever_is_missing(pitch, turn, missing, seed):
    frame, places, nodes = synthetic(pitch, turn, (7, 8), missing, seed)
    lattice = find_lattice(frame)
    assert lattice.pitch == pytest.approx(pitch, rel=2e-3)
    assert lattice.turn_deg == pytest.approx(turn, abs=0.2)
    distance = np.linalg.norm(lattice.spots[:, None] - places, axis=-1)
    nearest = distance.argmin(axis=1)
    # All but those that a hot pixel spoiled or that stand alone, each once, and none that is not there.
    assert len(set(nearest)) == len(lattice.spots) >= 0.85 * len(places)
    assert np.median(distance.min(axis=1)) < 0.05
    offset = lattice.nodes - nodes[nearest]
    assert (offset == offset[0]).all()


def check(lattice, kind, pitch, turn, nodes, places, most_missed=0.05):
    """The lattice is the one that the frame was made with: its nodes, counted from anywhere, along any of its rows."""
    assert lattice.kind == kind
    assert lattice.pitch == pytest.approx(pitch, rel=0.01)
    fold = np.rad2deg(ANGLES[kind])
    assert abs((lattice.turn_deg - turn + fold / 2) % fold - fold / 2) < 1
    distance = np.linalg.norm(lattice.spots[:, None] - places, axis=-1)
    nearest = distance.argmin(axis=1)
    assert distance.min(axis=1).max() < 0.3 * pitch
    assert len(set(nearest)) == len(lattice.spots) >= (1 - most_missed) * len(places)
    assert np.median(distance.min(axis=1)) < 0.1 * max(1, pitch / 20)
    design = np.column_stack([nodes[nearest], np.ones(len(nearest))])
    counted, *_ = np.linalg.lstsq(design, lattice.nodes, rcond=None)
    np.testing.assert_allclose(design @ counted, lattice.nodes, atol=1e-6)
    assert abs(np.linalg.det(counted[:2])) == pytest.approx(1)


@pytest.mark.slow
@given(
    kind=st.sampled_from(["square", "hexagonal"]),
    pitch=st.floats(8, 30),
    turn=st.floats(-180, 180),
    width=st.floats(0.09, 0.16),
    pupil=st.sampled_from(["round", "square", "annular", "wedge", "halves"]),
    missing=st.sampled_from([0, 0.1, 0.25]),
    brightness=st.sampled_from([1, 3, 10]),
    dtype=st.sampled_from(["uint8", "uint16", "float32", "float64"]),
    seed=st.integers(0, 2**32 - 1),
)
@settings(max_examples=25)
def test_lattices_of_any_kind_turn_and_pupil_are_found(
    kind, pitch, turn, width, pupil, missing, brightness, dtype, seed
):
    rng = np.random.default_rng(seed)
    side = int(min(11 * pitch, 320))
    nodes, places = nodes_and_places(kind, pitch, turn, side, side / 2 - 1.5 * pitch, pupil)
    lit = rng.random(len(nodes)) >= missing
    nodes, places = nodes[lit], places[lit] + side / 2 + rng.uniform(-0.5, 0.5, 2)
    places = places + rng.normal(0, 0.02 * pitch, places.shape)
    heights = np.exp(rng.uniform(-np.log(brightness), 0, len(places)))
    frame = 0.2 + spots_frame(side, places, max(0.9, width * pitch), heights)
    frame += rng.normal(0, 0.02 / brightness**0.5, frame.shape)
    check(find_lattice(as_dtype(frame, dtype)), kind, pitch, turn, nodes, places)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_lattices_of_diffraction_spots_are_found(kind):
    # Spots of a square lenslet, whose rings are maxima as well, with a background and photo-electrons.
    rng, side = np.random.default_rng(3), 256
    nodes, places = nodes_and_places(kind, 17, 11, side, 105)
    places = places + side / 2 + rng.normal(0, 0.3, places.shape)
    along_x, along_y = np.sinc((np.arange(side) - places.T[..., None]) / 3.0) ** 2 / 3.0
    frame = 20 + 40_000 * along_y.T @ along_x
    check(find_lattice(rng.poisson(frame).astype(np.uint16)), kind, 17, 11, nodes, places, 0)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_a_bent_lattice_is_followed_further_than_a_straight_one_reaches(kind):
    # Coma moves the spots at the edge by half a pitch, and those beside them nearly as much.
    nodes, places = nodes_and_places(kind, 16, 5, 320, 130)
    x, y = places.T / 130
    moved = places + 160 + 2.6 * np.stack([2 * x * y, x**2 + 3 * y**2], axis=1)
    lattice = find_lattice(100 + 50 * spots_frame(320, moved, 1.6))
    assert np.linalg.norm(displacements(lattice), axis=1).max() > 0.25 * 16
    check(lattice, kind, lattice.pitch, 5, nodes, moved, 0)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_large_spots_and_small_ones_are_found(kind):
    for pitch, sd, side in ((6, 0.8, 96), (40, 6.0, 400)):
        nodes, places = nodes_and_places(kind, pitch, 8, side, side / 2 - 1.5 * pitch)
        frame = spots_frame(side, places + side / 2, sd) + np.random.default_rng(1).normal(0, 0.03, (side, side))
        check(find_lattice(frame), kind, pitch, 8, nodes, places + side / 2, 0)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_a_frame_is_matched_though_its_rows_are_called_otherwise(kind):
    # Just this side and that side of the angle at which another direction of the lattice is nearer to the frame's rows.
    fold = np.rad2deg(ANGLES[kind]) / 2
    pair = []
    for turn in (fold - 0.5, fold + 0.5):
        nodes, places = nodes_and_places(kind, 16, turn, 256, 100)
        pair.append((find_lattice(50 + 100 * spots_frame(256, places + 128, 1.6)), nodes, places + 128))
    (reference, *_), (lattice, nodes, places) = pair
    assert abs(lattice.turn_deg - reference.turn_deg) > fold
    matched = match(lattice, reference)
    check(matched, kind, 16, matched.turn_deg, nodes, places, 0.1)
    assert matched.turn_deg == pytest.approx(fold + 0.5, abs=0.1)
    assert np.abs(displacements(matched)).max() < 0.1


def test_kinds_are_not_matched_with_one_another():
    square, hexagonal = (
        find_lattice(spots_frame(256, nodes_and_places(kind, 16, 0, 256, 100)[1] + 128, 1.6)) for kind in ANGLES
    )
    with pytest.raises(FrameError, match=r"hexagonal.* is not the reference's \(square"):
        match(hexagonal, square)


def test_displacements_are_from_the_lattice():
    frame, places, _ = synthetic(jitter=0.8, noise=1.0)
    lattice = find_lattice(frame)
    assert lattice.shape == (9, 11)
    assert lattice.lit.all()
    assert displacements(lattice).std() == pytest.approx(0.8, rel=0.15)
    np.testing.assert_allclose(lattice.spots[0], places[0], atol=0.1)
    np.testing.assert_allclose(displacements(lattice).sum(axis=0), 0, atol=1e-9)


def test_a_hole_in_the_middle_is_no_matter():
    frame, places, nodes = synthetic(pitch=16, shape=(13, 13), noise=2.0)
    hole = np.linalg.norm(nodes - 6, axis=1) < 2.5
    y, x = np.mgrid[:256, :256]
    for place in places[hole]:
        frame[np.hypot(x - place[0], y - place[1]) < 7] = 1000 + 0.5 * place[0]
    lattice = find_lattice(frame)
    assert lattice.shape == (13, 13)
    np.testing.assert_array_equal(lattice.lit[~hole.reshape(13, 13)], True)
    np.testing.assert_array_equal(lattice.lit[hole.reshape(13, 13)], False)


@pytest.mark.slow
def test_a_frame_is_matched_to_its_reference_by_spots_nearest():
    reference = find_lattice(synthetic(shape=(9, 11), seed=1)[0])
    frame, _, nodes = synthetic(shape=(9, 11), seed=1)
    edge = (nodes[:, 0] < 2) | (nodes[:, 1] < 1)  # the frame's pupil is smaller
    lattice = find_lattice(frame)
    y, x = np.mgrid[:256, :256]
    for place in lattice.spots[edge]:
        frame[np.hypot(x - place[0], y - place[1]) < 7] = 1000 + 0.5 * place[0]
    moved = match(find_lattice(np.roll(frame, (3, -4), (0, 1))), reference)
    assert moved.nodes.min(axis=0).tolist() == [2, 1]
    by_node = {tuple(n): p for n, p in zip(reference.nodes.tolist(), reference.spots, strict=True)}
    shift = [p - by_node[tuple(n)] for n, p in zip(moved.nodes.tolist(), moved.spots, strict=True)]
    np.testing.assert_allclose(np.median(shift, axis=0), [-4, 3], atol=0.05)


def test_frames_of_another_instrument_are_not_matched():
    one, other = find_lattice(synthetic()[0]), find_lattice(synthetic(pitch=13.0)[0])
    with pytest.raises(FrameError, match="is not the reference's"):
        match(other, one)


RNG = np.random.default_rng(7)


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        (RNG.normal(1000, 10, (128, 128)), "no usable spots"),
        (np.zeros((64, 64)), "every pixel is 0"),
        (np.full((64, 64), 255, dtype=np.uint8), "every pixel is 255"),
        (np.zeros((64, 64, 3)), "is needed, found"),
        (np.zeros((0, 0)), "is needed, found"),
        (np.zeros((64, 64), dtype=complex), "is needed, found"),
        (spots_frame(64, np.array([[30.0, 30.0]]), 1.5), "no usable spots: 1 "),
        (spots_frame(64, np.array([[30.0, 30.0], [40.0, 30.0]]), 1.5), "no usable spots: 2 "),
        (spots_frame(256, np.stack([np.arange(20, 230, 14.0), np.full(15, 128.0)], axis=1), 1.5), "no grid"),
        (np.full((64, 64), np.nan), "not numbers"),
        (np.zeros((5, 64)), "is needed, found"),
        (np.zeros(64), "is needed, found"),
    ],
)
def test_frames_without_spots_are_refused(frame, says):
    with pytest.raises(FrameError, match=says):
        find_lattice(frame)


@pytest.mark.parametrize("seed", range(5))
def test_spots_anywhere_are_no_grid(seed):
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:256, :256]
    frame = rng.normal(1000, 5, (256, 256))
    for place in rng.uniform(10, 246, (60, 2)):
        frame += 600 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / 4)
    with pytest.raises(FrameError, match="no grid"):
        find_lattice(frame)


def test_windows_reach_beyond_the_frame_into_the_dark():
    frame = np.arange(1.0, 26.0).reshape(5, 5)
    windows, corners = cut_windows(frame, np.array([[0.0, 0.0], [3.4, 2.0]]), 1)
    np.testing.assert_array_equal(windows[0], [[0, 0, 0], [0, 1, 2], [0, 6, 7]])
    np.testing.assert_array_equal(windows[1], frame[1:4, 2:5])
    np.testing.assert_array_equal(corners, [[-1, -1], [2, 1]])
