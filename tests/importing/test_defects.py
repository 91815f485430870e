"""Hot and dead pixels of a film's camera are found, and nothing else is."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from aolink.estimation import run
from aolink.films.film import array_film
from aolink.importing.defects import find_defects
from aolink.importing.frames import FilmLight, FilmSettings
from aolink.importing.recording import import_film
from aolink.numerics.arrays import FloatArray
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.simulation.model import simulate

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from judging.films import SpotFilm, random_walk, resonance, spot_film

MIDDLES = np.array([[24.0, 32.0], [70.0, 30.0]])
FRAMES = 96
AT = ((26, 35), (27, 35), (50, 10), (0, 60), (95, 63))
"""Pixels (x, y) that are made hot: a pair beside an object, one on the ground, one at an edge, one in a corner."""
THREE = ((10, 10), (11, 10), (12, 10), (50, 10), (50, 11), (51, 11), (71, 34), (72, 34), (72, 35))
"""Three in a row, and three about a corner: on the ground, and in light."""
NOTE = "1 hot or dead pixel is left out, at 31,30"


def still(rng: np.random.Generator) -> FloatArray:
    return np.zeros((FRAMES, 8, 2, 2))


def walk(rng: np.random.Generator) -> FloatArray:
    return random_walk(rng, FRAMES, 2, 0.3)


def vibration(rng: np.random.Generator) -> FloatArray:
    """Its places repeat each other, so that their median has steps from pixel to pixel."""
    return resonance(rng, FRAMES, 2, 1.5, 12.0)


def dark(frames: NDArray[np.uint16]) -> NDArray[np.uint16]:
    return (20_000 - frames.astype(np.int64)).clip(0).astype(np.uint16)


def few_bits(frames: NDArray[np.uint16]) -> NDArray[np.uint8]:
    return np.asarray((frames / frames.max() * 250).round(), dtype=np.uint8)


def found(frames: NDArray[np.generic], sd: float = 1.8, invert: bool = False) -> set[tuple[int, int]]:
    """Hot and dead pixels (x, y) that are found."""
    film = array_film(frames, "film")
    light = FilmLight(film, FilmSettings(subtract_median=not invert, invert=invert))
    return {(int(x), int(y)) for y, x in np.argwhere(find_defects(film, light, sd))}


@pytest.mark.parametrize("sd", [0.8, 1.8, 3.0])
@pytest.mark.parametrize("motion", [still, walk, vibration])
def test_a_film_without_hot_pixels_has_none(motion, sd):
    rng = np.random.default_rng([12, round(10 * sd)])
    frames = spot_film(rng, motion(rng), MIDDLES, sd=sd).frames
    for shown, invert in ((frames, False), (dark(frames), True), (few_bits(frames), False)):
        assert found(shown, sd, invert) == set()


def with_hot(film: SpotFilm, by: float, at: Sequence[tuple[int, int]] = AT) -> NDArray[np.uint16]:
    frames = film.frames.astype(np.float64)
    for x, y in at:
        frames[:, y, x] += by
    return np.asarray(frames.clip(0).round().astype(np.uint16))


@pytest.mark.parametrize("motion", [still, walk, vibration])
@pytest.mark.parametrize("by", [-1000.0, 800.0, 30_000.0])
def test_hot_and_dead_pixels_are_found_where_they_are(motion, by):
    rng = np.random.default_rng(13)
    assert found(with_hot(spot_film(rng, motion(rng), MIDDLES), by)) == set(AT)


@pytest.mark.parametrize("motion", [still, walk, vibration])
def test_three_hot_pixels_beside_each_other_are_found(motion):
    rng = np.random.default_rng(15)
    assert found(with_hot(spot_film(rng, motion(rng), MIDDLES), 3000.0, THREE)) == set(THREE)


@pytest.mark.slow
def test_a_hot_pixel_of_a_film_that_nothing_is_followed_in(tmp_path):
    """It is masked, and estimates are as in the same film without it."""
    rig = load_rig("sh-4x4")
    clean = np.array([each.pixels for each in simulate(rig, 12, seed=16)])
    hot = clean.copy()
    hot[:, 30, 31] += 5000
    note = f"{NOTE}; with another film of this camera: sensor.defects = [[30, 31]]"
    paths = []
    for name, counts, notes, masked in (
        ("clean", clean, (), set()),
        ("hot", hot, (note,), {(30, 31)}),
    ):
        target = tmp_path / f"{name}.mcap"
        account = import_film(array_film(counts, name), rig, FilmSettings(), target)
        assert tuple(note for note in account.notes if "hot" in note) == notes
        exposures = list(Recording(target).exposures())
        assert {tuple(at) for each in exposures for at in np.argwhere(~each.mask).tolist()} == masked
        paths.append(np.array([each.path for each in run(rig, exposures, ["profile"])["profile"]]))
    assert np.abs(paths[1] - paths[0]).max() < 0.02


@pytest.mark.parametrize("frames", [8, 9])
def test_hot_pixels_are_found_in_nine_frames_or_more(frames):
    rng = np.random.default_rng(17)
    assert found(with_hot(spot_film(rng, still(rng)[:frames], MIDDLES), 3000.0)) == (set(AT) if frames == 9 else set())
