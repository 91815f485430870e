"""The lattice of spots: synthetic frames of any pitch and turn with what is missing, and what is none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aolink.errors import FrameError
from aolink.optics.lattice import find_lattice, match
from aolink.optics.maxima import cut_windows


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


@given(pitch=st.floats(12, 24), turn=st.floats(-20, 20), missing=st.floats(0, 0.2), seed=st.integers(0, 99))
@settings(max_examples=15, deadline=None)
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


def test_displacements_are_from_the_lattice():
    frame, places, _ = synthetic(jitter=0.8, noise=1.0)
    lattice = find_lattice(frame)
    assert lattice.shape == (9, 11)
    assert lattice.lit.all()
    assert lattice.displacements.std() == pytest.approx(0.8, rel=0.15)
    np.testing.assert_allclose(lattice.spots[0], places[0], atol=0.1)
    np.testing.assert_allclose(lattice.displacements.sum(axis=0), 0, atol=1e-9)


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
        (np.zeros((64, 64)), "no usable spots"),
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
