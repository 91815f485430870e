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
from aolink.importing.first_rig import first_rig
from aolink.importing.frames import FilmSettings
from aolink.importing.recording import import_film
from aolink.importing.survey import survey
from aolink.importing.tracker import find_objects
from aolink.numerics.arrays import FloatArray
from aolink.recording.reader import Recording
from aolink.rig import load_rig, parse_rig
from aolink.simulation.model import simulate

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from paper_report.spot_films import SpotFilm, random_walk, resonance, spot_film

MIDDLES = np.array([[24.0, 32.0], [70.0, 30.0]])
SETTINGS = FilmSettings(rate_hz=100.0, subtract_median=True, track=2, places=tuple(map(tuple, MIDDLES.tolist())))
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


@pytest.mark.parametrize("sd", [0.8, 1.8, 3.0])
@pytest.mark.parametrize("motion", [still, walk, vibration])
def test_a_film_without_hot_pixels_has_none(motion, sd):
    rng = np.random.default_rng([12, round(10 * sd)])
    frames = spot_film(rng, motion(rng), MIDDLES, sd=sd).frames
    settings = FilmSettings(track=2, places=SETTINGS.places)
    for shown, invert in ((frames, False), (dark(frames), True), (few_bits(frames), False)):
        found = find_objects(array_film(shown, "film"), FilmSettings(**{**vars(settings), "invert": invert}))
        assert found.defects is None


def with_hot(film: SpotFilm, by: float, at: Sequence[tuple[int, int]] = AT) -> NDArray[np.uint16]:
    frames = film.frames.astype(np.float64)
    for x, y in at:
        frames[:, y, x] += by
    return np.asarray(frames.clip(0).round().astype(np.uint16))


@pytest.mark.parametrize("motion", [still, walk, vibration])
@pytest.mark.parametrize("by", [-1000.0, 800.0, 30_000.0])
def test_hot_and_dead_pixels_are_found_where_they_are(motion, by):
    rng = np.random.default_rng(13)
    film = array_film(with_hot(spot_film(rng, motion(rng), MIDDLES), by), "film")
    found = find_objects(film, SETTINGS)
    assert found.defects is not None
    assert {(int(x), int(y)) for y, x in np.argwhere(found.defects)} == set(AT)


@pytest.mark.parametrize("motion", [still, walk, vibration])
def test_three_hot_pixels_beside_each_other_are_found(motion):
    rng = np.random.default_rng(15)
    film = array_film(with_hot(spot_film(rng, motion(rng), MIDDLES), 3000.0, THREE), "film")
    found = find_objects(film, SETTINGS)
    assert found.defects is not None
    assert {(int(x), int(y)) for y, x in np.argwhere(found.defects)} == set(THREE)


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


@pytest.mark.slow
@pytest.mark.parametrize("frames", [8, 9])
def test_a_film_too_short_to_find_hot_pixels_says_so(frames):
    film = array_film(
        spot_film(np.random.default_rng(17), still(np.random.default_rng())[:frames], MIDDLES).frames, "film"
    )
    notes = list(survey(film, SETTINGS, find_objects(film, SETTINGS)).notes())
    assert ("8 frames are too few to find hot and dead pixels: 9 are needed" in notes) == (frames == 8)


@pytest.mark.rare
def test_a_hot_pixel_is_masked_in_a_window_that_moves_over_it(tmp_path):
    """The window follows an object that goes by it; the places are as in the same film without hot pixels."""
    rng = np.random.default_rng(14)
    motion = random_walk(rng, FRAMES, 2, 0.1)
    motion[..., 0, 0] += np.linspace(-8, 8, FRAMES)[:, None]
    film = spot_film(rng, motion, MIDDLES)
    places = tuple((float(x), float(y)) for x, y in film.places[0])
    settings = FilmSettings(rate_hz=100.0, subtract_median=True, track=2, frames_per_exposure=8, places=places)
    source = array_film(with_hot(film, 5000.0), "film")
    known = survey(source, settings, find_objects(source, settings))
    assert np.sqrt(np.mean((known.places - film.places) ** 2)) < 0.1
    first = first_rig(source, settings, "film")
    assert "5 hot or dead pixels are left out, at 50,10, 26,35, 27,35 and others" in first.notes
    rig = parse_rig(first.text)
    import_film(source, rig, settings, tmp_path / "film.mcap")
    exposures = list(Recording(tmp_path / "film.mcap").exposures())
    side, masked = rig.sensor.shape[0], set()
    for each in exposures:
        assert each.truth is not None
        # The first object's place at the end, in its window, and the hot pixels that are beside it there.
        x, y = (each.truth.path[:2, -1] - rig.sensor.field[0]) / rig.sensor.pixel_width - 0.5
        at = film.places[each.first_step + 7, 0]
        beside = [hot for hot in AT if np.hypot(*(at - hot)) < 4.0]
        there = {(round(row - at[1] + y), round(column - at[0] + x)) for column, row in beside}
        found = {(int(row), int(column)) for row, column in np.argwhere(~each.mask) if column < side}
        assert there <= found
        assert len(found) <= 2
        masked |= there
    assert len(masked) > 2
