"""Spots that their motion blurs: where they are, and the kernel that is the widest to explain them."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import ImportingError
from aolink.films.film import Film, array_film
from aolink.importing.frames import FilmSettings
from aolink.jobs.look_spots import find_spots
from aolink.optics.kernel import pixel_masses

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from judging.films import draw

FRAMES, SHAPE = 60, (48, 64)


def shaken(
    *, sd: float = 1.8, amplitude: float = 3.2, angle: float = 0.3, cycles: float = 0.67, light: float = 20_000.0,
    middles: tuple[tuple[float, float], ...] = ((30.3, 24.6),), noise: float = 20.0, step: float = 0.746,
    phases: tuple[float, ...] = (0.0, 0.0),
) -> Film:  # fmt: skip
    """Spots on a sinusoid of so many cycles in an exposure, whose phase goes on by ``step`` cycles from frame to frame;
    ``phases`` are those at which each spot begins, rad."""
    rng = np.random.default_rng(3)
    phase = 2 * np.pi * (step * np.arange(FRAMES)[:, None] + cycles * (np.arange(40) + 0.5) / 40)
    frames = 1000 + noise * rng.normal(size=(FRAMES, *SHAPE))
    for middle, begun in zip(middles, phases, strict=False):
        for k, each in enumerate(amplitude * np.sin(phase + begun)):
            x, y = (
                pixel_masses(sd**2, np.arange(-0.5, size), middle[d] + each * (np.cos(angle), np.sin(angle))[d], 0)[0]
                for d, size in ((0, SHAPE[1]), (1, SHAPE[0]))
            )
            frames[k] += light / 40 * y.T @ x
    return array_film(np.clip(np.rint(frames), 0, 65535).astype(np.uint16), "shaken", rate_hz=50.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sd", "amplitude", "angle"),
    [(1.8, 3.2, 0.0), (1.8, 3.2, 0.7), (3.1, 4.0, 0.7), (1.0, 3.0, 0.3), (1.8, 0.0, 0.0), (1.8, 1.0, 0.5)],
)
def test_the_kernel_is_found_whether_frames_are_sharp_or_blurred(sd: float, amplitude: float, angle: float) -> None:
    found = find_spots(shaken(sd=sd, amplitude=amplitude, angle=angle), FilmSettings(), FRAMES)
    # Where nothing is sharp, somewhat wider kernels explain the frames nearly as well.
    assert 0.96 * sd < found.sd < 1.15 * sd
    if amplitude == 0:
        assert found.sd == pytest.approx(sd, rel=0.02)


@pytest.mark.slow
def test_a_spot_that_swings_several_times_in_each_exposure_has_a_kernel_still() -> None:
    assert find_spots(shaken(cycles=2.2), FilmSettings(), FRAMES).sd == pytest.approx(1.8, rel=0.12)


@pytest.mark.slow
def test_windows_hold_the_spots_and_their_light() -> None:
    middles = ((16.0, 15.0), (46.0, 30.0))
    film = shaken(middles=middles, amplitude=2.0)
    found = find_spots(film, FilmSettings(), FRAMES)
    side = found.light.shape[-1]
    assert found.light.shape == (FRAMES, 2, side, side)
    order = np.argsort(found.corners[:, 0])
    np.testing.assert_allclose(found.corners[order] + (side - 1) / 2, middles, atol=1.5)
    np.testing.assert_allclose(np.nansum(found.light, axis=(2, 3)), 1.0, atol=0.12)
    assert found.noise == pytest.approx(20 / 20_000, rel=0.1)
    assert not found.at_edge


def test_what_cannot_be_looked_at_is_said_in_one_line() -> None:
    dark = array_film(np.random.default_rng(1).normal(100, 3, (30, 48, 64)), "dark")
    with pytest.raises(ImportingError, match="shows no spot"):
        find_spots(dark, FilmSettings(), FRAMES)
    one = shaken()
    with pytest.raises(ImportingError, match=r"1 frame\(s\)"):
        find_spots(array_film(next(iter(one.frames())), "one"), FilmSettings(), FRAMES)


@pytest.mark.slow
def test_a_hot_pixel_is_no_spot() -> None:
    film = shaken(amplitude=2.0)
    frames = np.stack(list(film.frames()))
    frames[:, 8, 50] = 4000
    found = find_spots(array_film(frames, "hot", rate_hz=50.0), FilmSettings(), FRAMES)
    assert len(found.corners) == 1


@pytest.mark.slow
def test_the_kernel_is_found_beside_shot_noise() -> None:
    film = draw(26, motion="sinusoid")
    found = find_spots(film.film, film.settings, FRAMES)
    assert found.electrons > 0
    assert found.sd == pytest.approx(film.sd, rel=0.1)


def test_a_window_beyond_the_edge_is_dark_there() -> None:
    found = find_spots(shaken(middles=((57.0, 24.6),), angle=np.pi / 2, amplitude=2.0), FilmSettings(), FRAMES)
    side = found.light.shape[-1]
    beyond = found.corners[0, 0] + np.arange(side) >= SHAPE[1]
    assert beyond.any()
    assert np.isfinite(found.light).all(), "sums over a window can be used"
    assert not found.light[..., beyond].any()
