"""Objects followed through a film: places, windows, the first rig file, and what estimators make of it."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from aolink.errors import ImportingError
from aolink.estimation import run, smooth
from aolink.films.film import array_film
from aolink.importing.exposures import imported
from aolink.importing.first_rig import first_rig
from aolink.importing.frames import FilmAccount, FilmLight, FilmSettings
from aolink.importing.motion import Motion, fit_motion, vibration_mean
from aolink.importing.recording import import_film
from aolink.importing.survey import survey
from aolink.importing.tracker import Objects, Tracker, find_objects
from aolink.numerics.arrays import FloatArray
from aolink.recording.reader import Recording
from aolink.rig import Rig, parse_rig
from tests.kinds import truth_of

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from paper_report.spot_films import SpotFilm, random_walk, resonance, spot_film

MIDDLES = np.array([[24.0, 32.0], [70.0, 30.0]])
K = 8


@pytest.fixture(scope="module")
def walkers() -> SpotFilm:
    rng = np.random.default_rng(5)
    return spot_film(rng, random_walk(rng, 320, 2, 0.5), MIDDLES)


SETTINGS = FilmSettings(
    rate_hz=100.0, subtract_median=True, track=2, frames_per_exposure=K, places=tuple(map(tuple, MIDDLES.tolist()))
)


@pytest.mark.slow
def test_objects_are_found_and_followed_to_a_tenth_of_a_pixel(walkers: SpotFilm) -> None:
    film = array_film(walkers.frames, "walkers")
    objects = find_objects(film, SETTINGS)
    known = survey(film, SETTINGS, objects)
    error = known.places - walkers.places
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert known.sd == pytest.approx(1.8, rel=0.05)


@pytest.mark.rare
def test_light_beside_an_object_is_said_with_its_frames(tmp_path: Path) -> None:
    """A second object sticks to the first one in the second half of the film; a fainter one is no matter."""
    rng = np.random.default_rng(6)
    motion = random_walk(rng, 160, 2, 0.5)
    film = spot_film(rng, motion, MIDDLES)
    for k, brightness in enumerate((0.6, 0.15)):
        other = spot_film(
            rng, motion[80:, :, k : k + 1], MIDDLES[k : k + 1] + np.array([4.0, 3.0]), noise=0.0, ground=0.0,
            light=brightness * 20_000.0,
        )  # fmt: skip
        film.frames[80:] += other.frames
    source = array_film(film.frames, "film", start_ns=0)
    known = survey(source, SETTINGS, find_objects(source, SETTINGS))
    assert known.alone(0, 80).tolist() == [True, True]
    assert known.alone(72, 88).tolist() == known.alone(80, 160).tolist() == [False, True]
    rig = parse_rig(first_rig(source, SETTINGS, "film").text)
    (note,) = import_film(source, rig, SETTINGS, tmp_path / "a.mcap").notes
    assert "object 1" in note
    assert "in frames 80 to 159" in note


def passing(frames: int, least: float) -> np.ndarray:
    """Motion (frames, 8, 2, 2) of two objects about `MIDDLES`: they come towards each other along x up to ``least``
    pixels in the middle of the film, and go back, with a small random walk."""
    rng = np.random.default_rng(3)
    walk = random_walk(rng, frames, 2, 0.15)
    apart = MIDDLES[1] - MIDDLES[0]
    towards = (1 - np.abs(np.linspace(-1, 1, frames))) * (1 - least / np.linalg.norm(apart))
    walk[..., 0, :] += towards[:, None, None] * apart / 2
    walk[..., 1, :] -= towards[:, None, None] * apart / 2
    return walk


@pytest.mark.rare
def test_objects_beside_each_other_are_measured_apart() -> None:
    """Down to three standard deviations, where a centroid of one moves with the light of the other."""
    film = spot_film(np.random.default_rng(0), passing(160, 4.0), MIDDLES)
    source = array_film(film.frames, "film")
    known = survey(source, SETTINGS, find_objects(source, SETTINGS))
    assert np.linalg.norm(film.places[:, 0] - film.places[:, 1], axis=1).min() < 4 * 1.8
    assert not known.together.any()
    assert np.abs(known.places - film.places).max() < 0.5
    assert np.sqrt(np.mean((known.places - film.places) ** 2)) < 0.1


@pytest.mark.rare
def test_objects_that_meet_are_left_out_until_they_part(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    film = spot_film(rng, passing(320, 0.0), MIDDLES)
    source = array_film(film.frames, "film")
    known = survey(source, SETTINGS, find_objects(source, SETTINGS))
    distance = np.linalg.norm(film.places[:, 0] - film.places[:, 1], axis=1)
    together = np.asarray(known.together.any(axis=(1, 2)))
    assert together[distance < 2 * 1.8].all()
    assert not together[distance > 4 * 1.8].any()
    assert np.isnan(known.places[together]).all()
    # Once apart, there is a track on each of them; which one is not known.
    assert np.isfinite(known.places[~together]).all()
    error = known.places - film.places
    swapped = known.places[:, ::-1] - film.places
    after = np.arange(320) > np.flatnonzero(together).max()
    near = [float(np.sqrt(np.mean(one[after & (distance > 5 * 1.8)] ** 2))) for one in (error, swapped)]
    assert min(near) < 0.1
    rig = parse_rig(first_rig(source, SETTINGS, "film").text)
    account = import_film(source, rig, SETTINGS, tmp_path / "a.mcap")
    first, last = np.flatnonzero(together)[[0, -1]]
    assert any(f"objects 1 and 2 come together in frames {first} to {last}" in note for note in account.notes)
    exposures = list(Recording(tmp_path / "a.mcap").exposures())
    for k, each in enumerate(exposures):
        during = together[k * K : (k + 1) * K]
        assert not during.any() or each.truth is None
        assert not during.all() or not each.mask.all()
    (estimates,) = run(rig, exposures, ["profile"]).values()
    scored = [(e, truth_of(x)) for e, x in zip(estimates, exposures, strict=True) if x.truth is not None]
    inside = [np.abs(e.path - t.path) < 1.96 * np.hypot(e.path_sd, t.path_sd) for e, t in scored]
    assert np.mean(inside) > 0.85


@pytest.mark.rare
def test_objects_that_stay_together_on_a_long_way_are_found_again() -> None:
    """They go together for forty of their standard deviations, a third of the film."""
    rng = np.random.default_rng(4)
    motion = random_walk(rng, 300, 2, 0.05)
    apart = np.clip(np.abs(np.arange(300) - 150) - 50, 0, 20) / 20
    way = np.clip(np.arange(300) - 100, 0, 100) * 0.72
    motion += np.stack([way, 0 * way], axis=1)[:, None, None]
    motion += apart[:, None, None, None] * np.array([[0.0, -8.0], [0.0, 8.0]])
    film = spot_film(rng, motion, np.array([[16.0, 32.0], [16.0, 32.0]]), (64, 112))
    settings = replace(SETTINGS, places=((16.0, 24.0), (16.0, 40.0)))
    source = array_film(film.frames, "film")
    known = survey(source, settings, find_objects(source, settings))
    assert known.together[110:190].any(axis=(1, 2)).all()
    assert np.isfinite(known.places[230:]).all()
    errors = [np.abs(known.places[230:, order] - film.places[230:]).max() for order in ([0, 1], [1, 0])]
    assert min(errors) < 0.5


def test_an_object_that_moves_by_more_than_its_width_is_followed() -> None:
    """By up to five of its standard deviations from frame to frame, while the other one rests."""
    rng = np.random.default_rng(9)
    motion = np.zeros((60, 1, 2, 2))
    motion[:, 0, 0] = np.where(np.arange(60)[:, None] % 3 == 2, [7.0, 5.0], [0.0, 0.0])
    film = spot_film(rng, motion, MIDDLES)
    light = FilmLight(array_film(film.frames, "film"), SETTINGS)
    tracker = Tracker(Objects(MIDDLES, 1.8), None)
    places = np.array([tracker.follow(light.of(frame)[0]) for frame in film.frames])
    assert np.linalg.norm(np.diff(film.places[:, 0], axis=0), axis=1).max() > 4.5 * 1.8
    assert np.abs(places - film.places).max() < 0.3


@pytest.mark.rare
def test_an_object_that_passes_a_faded_one_is_followed_on() -> None:
    """The track of an object that has faded ends on the light of the other one: only the other one is seen."""
    rng = np.random.default_rng(4)
    motion = passing(160, 0.0)
    motion[..., 1, :] = 0.0
    motion[..., 0, :] *= 2.0  # up to where the second one stood
    film = spot_film(rng, motion[:, :, :1], MIDDLES[:1])
    film.frames[:40] += spot_film(rng, motion[:40, :, 1:], MIDDLES[1:], noise=0.0, ground=0.0).frames
    source = array_film(film.frames, "film")
    known = survey(source, SETTINGS, find_objects(source, SETTINGS))
    assert not known.together.any()
    assert np.isfinite(known.places[:, 0]).all()
    assert np.sqrt(np.mean((known.places[:, 0] - film.places[:, 0]) ** 2)) < 0.1


@pytest.mark.rare
def test_an_object_that_leaves_is_said_and_its_window_left_out(walkers: SpotFilm, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    frames = walkers.frames.copy()
    rng_noise = rng.normal(size=frames[160:, :, 48:].shape)
    frames[160:, :, 48:] = np.rint(1000 + 20 * rng_noise).astype(np.uint16)  # the second one is gone
    source = array_film(frames, "film")
    rig = parse_rig(first_rig(source, SETTINGS, 'a "quoted" name').text)
    account = import_film(source, rig, SETTINGS, tmp_path / "a.mcap")
    assert any("object 2 is not seen in frames 160 to 319" in note for note in account.notes)
    exposures = list(Recording(tmp_path / "a.mcap").exposures())
    columns = rig.sensor.shape[1] // 2
    assert all(each.mask[:, :columns].any() for each in exposures)
    assert all(each.mask[:, columns:].any() == (k < 20) for k, each in enumerate(exposures))


@pytest.mark.rare
def test_a_drift_of_all_objects_is_said() -> None:
    rng = np.random.default_rng(2)
    motion = random_walk(rng, 160, 2, 0.1)
    motion[..., 0] += 0.08 * np.arange(160)[:, None, None]
    source = array_film(spot_film(rng, motion, MIDDLES).frames, "film")
    (note,) = [each for each in first_rig(source, SETTINGS, "film").notes if "drift" in each]
    assert "by 0.0" in note


@pytest.mark.rare
def test_pixels_beyond_the_picture_are_no_darkness(tmp_path: Path) -> None:
    """An object at the edge: its window hangs over, and what is there is unknown, not dark."""
    rng = np.random.default_rng(2)
    film = spot_film(rng, random_walk(rng, 80, 2, 0.2), np.array([[8.0, 32.0], [70.0, 30.0]]))
    source = array_film(film.frames[:, :, 3:], "film")
    settings = replace(SETTINGS, places=((5.0, 32.0), (67.0, 30.0)))
    rig = parse_rig(first_rig(source, settings, "film").text)
    import_film(source, rig, settings, tmp_path / "a.mcap")
    exposures = list(Recording(tmp_path / "a.mcap").exposures())
    assert any(not each.mask.all() for each in exposures)
    (estimates,) = run(rig, exposures, ["profile"]).values()
    errors = np.array([e.path - truth_of(x).path for e, x in zip(estimates, exposures, strict=True)])
    spread = np.hypot([e.path_sd for e in estimates], truth_of(exposures[0]).path_sd)
    known = np.isfinite(errors)  # where it comes near the edge, its place is not known
    assert known.mean() > 0.7
    assert np.mean((np.abs(errors) < 1.96 * spread)[known]) > 0.9


@pytest.mark.rare
def test_a_bright_object_keeps_its_light() -> None:
    """What an exposure lacks of it, taken as light of others, is less than twice the noise of its light."""
    rng = np.random.default_rng(6)
    noise = 3.0
    film = spot_film(rng, random_walk(rng, 80, 2, 0.3), MIDDLES, noise=noise)
    source = array_film(film.frames, "film")
    known = survey(source, SETTINGS, find_objects(source, SETTINGS))
    lacks = np.exp(-(known.rest**2) / 2)
    assert lacks < 2 * noise * np.sqrt(np.pi * (known.rest * 1.8) ** 2) / 20_000
    rig = parse_rig(first_rig(source, SETTINGS, "film").text)
    account = FilmAccount()
    frames = np.array([each.frame.pixels for each in imported(source, rig, SETTINGS, account)], dtype=float)
    counts = frames.reshape(len(frames), *rig.sensor.grid, -1, rig.sensor.profile.pixels) - rig.sensor.black_level
    assert account.exposures == 10
    light = counts.sum(axis=(1, 2, 3, 4)) / rig.sensor.counts_per_density * rig.sensor.pixel_size
    assert light == pytest.approx(np.full(10, 2.0), rel=0.01)


def leaving() -> tuple[NDArray[np.uint16], FloatArray]:
    """Frames of two objects, the first of which goes out of the picture at a steady speed and the second walks, and
    their places."""
    rng = np.random.default_rng(3)
    motion = random_walk(rng, 200, 2, 0.1)
    motion[..., 0, 0] += 0.15 * np.arange(200)[:, None]
    film = spot_film(rng, motion, np.array([[64.0, 32.0], [24.0, 30.0]]))
    return film.frames[:, :, :80], film.places


@pytest.mark.rare
def test_an_object_that_goes_out_of_the_picture_is_not_seen_at_its_edge() -> None:
    """Light beyond the edge is missing, and a centroid of the rest is off."""
    frames, places = leaving()
    source = array_film(frames, "film")
    settings = replace(SETTINGS, places=((64.0, 32.0), (24.0, 30.0)), subtract_median=False)
    known = survey(source, settings, find_objects(source, settings))
    errors = np.linalg.norm(known.places - places, axis=2)
    assert np.isnan(errors[places[:, 0, 0] > 76, 0]).all()
    assert np.isfinite(errors[places[:, 0, 0] < 73, 0]).all()
    assert np.isfinite(errors[:, 1]).all()
    assert np.nanmax(errors[:, 0]) < 0.25


@pytest.mark.rare
def test_saturated_pixels_do_not_widen_the_kernel(walkers: SpotFilm) -> None:
    flat = np.minimum(walkers.frames, np.uint16(1700))
    full = np.where(flat == 1700, np.uint16(65535), flat)
    film = array_film(full, "bright")
    made = first_rig(film, SETTINGS, "bright")
    known = survey(film, SETTINGS, find_objects(film, SETTINGS))
    assert known.left_out > 0
    assert known.sd == pytest.approx(1.8, rel=0.03)
    assert any("saturated" in note for note in made.notes)
    assert "# Note: " in made.text
    assert not first_rig(array_film(walkers.frames, "film"), SETTINGS, "film").notes


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_motion_that_is_none_of_them_is_said(seed: int) -> None:
    rng = np.random.default_rng(seed)
    noise = 0.1 * rng.normal(size=(320, 4))
    vibrations = [resonance(rng, 320, 2, 1.5, period).mean(axis=1).reshape(320, 4) for period in (5.3, 11.0)]
    assert abs(fit_motion(sum(vibrations) + noise).unexplained) > 0.15
    assert fit_motion(vibrations[0] + noise).unexplained == 0
    walk = random_walk(rng, 320, 2, 0.5).mean(axis=1).reshape(320, 4)
    assert fit_motion(walk + noise).unexplained == 0
    assert fit_motion(walk).unexplained == 0, "a frame that is exposed throughout correlates neighbours only"


@pytest.mark.slow
@pytest.mark.parametrize(("period", "lasts", "walks"), [(3.7, 10, 0.0), (5.3, 50, 0.4), (12, 20, 0.4), (30, 10, 0.0)])
def test_a_vibration_is_found_with_its_uncertainty(period: float, lasts: float, walks: float) -> None:
    """Alone, and of an object that walks at random as well; 30 places of 480 are not seen."""
    rng = np.random.default_rng(round(period))
    places = resonance(rng, 480, 3, 1.5, period, lasts).mean(axis=1).reshape(480, 6)
    places += walks * random_walk(rng, 480, 3, 1.0).mean(axis=1).reshape(480, 6) + 0.05 * rng.normal(size=(480, 6))
    places[rng.choice(480, 30, replace=False)] = np.nan
    found = fit_motion(places)
    assert found.kind == "vibration"
    assert found.turn == pytest.approx(2 * np.pi / period, rel=0.02)
    assert abs(found.turn - 2 * np.pi / period) < 3 * found.turn_sd
    assert abs(found.a - np.exp(-1 / (lasts * period))) < 3 * found.a_sd < 0.02
    assert found.r == pytest.approx(0.05**2, abs=0.0025)
    assert found.drift == 0
    assert (found.walk > 0) == (walks > 0)
    assert abs(found.walk - walks**2) <= 5 * found.walk_sd


@pytest.mark.parametrize(("period", "lasts"), [(3.7, 10), (3.7, 1), (12, 2), (2.3, 30)])
def test_a_vibration_is_fitted_as_its_means_over_frames(period: float, lasts: float) -> None:
    """The covariances of the fitted process, by integrals over two frames."""
    turn, rate = 2 * np.pi / period, 1 / (lasts * period)
    a = np.exp(-rate)
    cross, less = vibration_mean(a, turn)
    moments = (np.arange(1000) + 0.5) / 1000
    apart = moments[:, None] - moments
    same, *later = (np.mean(np.exp(-rate * abs(k + apart)) * np.cos(turn * (k + apart))) for k in range(4))
    variance = same / (1 - less)
    found = [variance * a**k * (np.cos(turn * k) - cross * np.sin(turn * k)) for k in range(1, 4)]
    assert found == pytest.approx(later, rel=1e-5, abs=1e-6)


@pytest.mark.slow
def test_a_drift_is_found_beside_a_walk_and_a_bound_motion() -> None:
    rng = np.random.default_rng(8)
    walk = random_walk(rng, 400, 3, 0.3).mean(axis=1).reshape(400, 6)
    velocities = np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert fit_motion(walk).drift == 0
    found = fit_motion(walk + np.arange(400)[:, None] * velocities)
    assert found.kind == "random walk"
    assert found.walk == pytest.approx(0.09, abs=5 * found.walk_sd)
    assert found.drift == pytest.approx(np.mean(velocities**2), rel=0.1)
    bound = rng.normal(size=(400, 6))
    for k in range(1, 400):
        bound[k] += 0.8 * bound[k - 1]
    found = fit_motion(bound + np.arange(400)[:, None] * velocities)
    assert found.kind == "Ornstein-Uhlenbeck process"
    assert found.drift == pytest.approx(np.mean(velocities**2), rel=0.1)


@pytest.mark.parametrize(("asked", "what"), [(9, "shows . objects, 9 are asked for"), (1, None)])
def test_as_many_objects_as_asked_for(walkers: SpotFilm, asked: int, what: str | None) -> None:
    film = array_film(walkers.frames[:10], "walkers")
    if what is None:
        assert len(find_objects(film, FilmSettings(track=asked)).places) == asked
    else:
        with pytest.raises(ImportingError, match=what):
            find_objects(film, FilmSettings(track=asked))


def test_a_film_without_light_has_no_objects() -> None:
    with pytest.raises(ImportingError, match="no objects can be found"):
        find_objects(array_film(np.zeros((5, 64, 64), np.uint8), "dark"), FilmSettings(track=1))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_walk_and_a_bound_motion_are_told_apart_and_fitted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    noise = 0.1
    walk = np.cumsum(rng.normal(size=(400, 6)) * 0.4, axis=0) + noise * rng.normal(size=(400, 6))
    found = fit_motion(walk)
    assert found.a == 1
    assert abs(found.walk - 0.16) < 5 * found.walk_sd
    bound = np.zeros((400, 6))
    for k in range(1, 400):
        bound[k] = 0.9 * bound[k - 1] + 0.4 * rng.normal(size=6)
    found = fit_motion(bound + noise * rng.normal(size=(400, 6)))
    assert abs(found.a - 0.9) < 5 * found.a_sd < 0.1
    assert abs(found.q - 0.16) < 5 * found.q_sd


@pytest.mark.parametrize("forgets", [5.0, 50.0, np.inf])
def test_the_path_in_an_exposure_has_the_covariances_of_means_over_frames(forgets: float) -> None:
    """Those of a process that forgets in so many frames, and of the steps of a walk, by integrals over two frames."""
    rate = 1 / forgets
    a = np.exp(-rate)
    rest = dict.fromkeys(("a_sd", "turn", "turn_sd", "q_sd", "walk_sd", "drift", "drift_sd", "r", "unexplained"), 0.0)
    if rate == 0:
        _, step = Motion(a=1.0, q=0.0, walk=1.0, **rest).frame_mean
        # A step of the output is the plant's own, less a share of it, with that share of the step before.
        assert ((1 - step) ** 2 + step**2, step * (1 - step)) == pytest.approx((2 / 3, 1 / 6), rel=1e-12)
        return
    process, step = Motion(a=a, q=1 - a**2, walk=0.0, **rest).frame_mean
    same = process**2 - 2 * process * step * (1 - a**2) + step**2 * (1 - a**2)
    next_ = a * (process**2 - process * step * (1 - a**2))
    assert same == pytest.approx(2 * (rate - 1 + a) / rate**2, abs=0.02)
    assert next_ == pytest.approx(((1 - a) / rate) ** 2, abs=0.02)


@pytest.mark.rare
def test_a_lost_frame_is_no_step_of_the_motion() -> None:
    """Every fifth frame of a vibration is lost: the other frames are fitted with their own times."""
    rng = np.random.default_rng(14)
    film = spot_film(rng, resonance(rng, 320, 2, 1.0, 7.0), MIDDLES, light=60_000.0)
    kept = np.flatnonzero(np.arange(320) % 5 > 0)
    source = array_film(film.frames[kept], "film", times_ns=10_000_000 * kept)
    (said,) = re.findall(r"vibration of ([0-9.]+) \+- ([0-9.]+) frames", first_rig(source, SETTINGS, "film").text)
    assert abs(float(said[0]) - 7.0) < 4 * float(said[1]) < 0.2


def imported_film(film: SpotFilm, path: Path) -> tuple[Rig, Recording]:
    source = array_film(film.frames, "film")
    rig = parse_rig(first_rig(source, SETTINGS, "film").text)
    import_film(source, rig, SETTINGS, path)
    return rig, Recording(path)


def short_memory(rng: np.random.Generator) -> np.ndarray:
    """An Ornstein-Uhlenbeck process that forgets in two frames, as `random_walk`."""
    moments = rng.normal(size=(160 * 8, 2, 2))
    for k in range(1, len(moments)):
        moments[k] = np.exp(-1 / 16) * moments[k - 1] + np.sqrt(1 - np.exp(-1 / 8)) * moments[k]
    return 0.8 * moments.reshape(160, 8, 2, 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    "motion", [lambda rng: random_walk(rng, 160, 2, 0.45), short_memory, lambda rng: resonance(rng, 160, 2, 1.5, 3.7)]
)
def test_the_error_of_the_truth_is_as_large_as_said(motion: Callable[[np.random.Generator], np.ndarray]) -> None:
    """Whatever the motion: it is that of finding an object in its noise, and larger of one that is fainter."""
    rng = np.random.default_rng(21)
    moved = motion(rng)
    film = spot_film(rng, moved[:, :, :1], MIDDLES[:1])
    film.frames[:] += spot_film(rng, moved[:, :, 1:], MIDDLES[1:], light=60_000.0, noise=0.0, ground=0.0).frames
    places = film.places, (MIDDLES[1:] + moved[:, :, 1:].mean(axis=1))
    source = array_film(film.frames, "film")
    known = survey(source, SETTINGS, find_objects(source, SETTINGS))
    error = known.places - np.concatenate(places, axis=1)
    rms = np.sqrt(np.nanmean(error**2, axis=(0, 2)))
    assert known.place_sd / rms == pytest.approx(1, abs=0.2)
    assert known.place_sd[0] > known.place_sd[1]


@pytest.mark.rare
def test_the_path_of_walkers_is_found_and_its_intervals_hold(walkers: SpotFilm, tmp_path: Path) -> None:
    rig, recording = imported_film(walkers, tmp_path / "walkers.mcap")
    exposures = list(recording.exposures())
    assert len(exposures) == len(walkers.frames) // K
    assert any(each.inputs.any() for each in exposures), "the walkers leave the middles of their windows"
    # The recorded truth is the true motion: a place in a window, which the inputs move.
    moved = np.cumsum([each.inputs.sum(axis=0) for each in exposures], axis=0)
    moved = np.vstack([np.zeros(4), moved[:-1]])
    unit = 1 / rig.sensor.pixel_width
    seen = np.array([truth_of(each).path - shift[:, None] for each, shift in zip(exposures, moved, strict=True)]) * unit
    true = walkers.places.reshape(-1, K, 4).swapaxes(1, 2)
    error = (seen - seen[:1, :, :1]) - (true - true[:1, :, :1])
    assert np.sqrt(np.mean(error**2)) < 0.2
    (estimates,) = run(rig, exposures, ["profile"]).values()
    errors = np.array([e.path - truth_of(x).path for e, x in zip(estimates, exposures, strict=True)])[1:] * unit
    held = np.array([truth_of(x).path - truth_of(x).path.mean(axis=1, keepdims=True) for x in exposures])[1:] * unit
    assert np.mean(errors**2) < np.mean(held**2), "nearer than the best constant, the path's own mean"
    smoothed = smooth(rig.plant, exposures, estimates)
    after = np.array([e.path - truth_of(x).path for e, x in zip(smoothed, exposures, strict=True)])[1:] * unit
    assert np.mean(after**2) < np.mean(errors**2)
    spread = np.hypot([e.path_sd for e in estimates[1:]], truth_of(exposures[0]).path_sd) * unit
    assert 0.9 < np.mean(np.abs(errors) < 1.96 * spread) < 0.98


@pytest.mark.rare
def test_a_resonance_inside_the_exposure_is_found(tmp_path: Path) -> None:
    """The first rig file has the resonance: half of what the path's own mean leaves, or less."""
    rng = np.random.default_rng(11)
    film = spot_film(rng, resonance(rng, 320, 2, 1.5, 5.3), MIDDLES, light=60_000.0)
    source = array_film(film.frames, "film")
    rig = parse_rig(first_rig(source, SETTINGS, "film").text)
    import_film(source, rig, SETTINGS, tmp_path / "a.mcap")
    exposures = list(Recording(tmp_path / "a.mcap").exposures())
    (estimates,) = run(rig, exposures, ["profile"]).values()
    scored = slice(8, None)
    pairs = list(zip(estimates, exposures, strict=True))[scored]
    errors = np.array([e.path - truth_of(x).path for e, x in pairs])
    held = np.array([truth_of(x).path - truth_of(x).path.mean(axis=1, keepdims=True) for _, x in pairs])
    assert np.sqrt(np.mean(errors**2)) < 0.5 * np.sqrt(np.mean(held**2))
    spread = np.hypot([e.path_sd for e, _ in pairs], truth_of(exposures[0]).path_sd)
    assert 0.88 < np.mean(np.abs(errors) < 1.96 * spread) < 0.99


@pytest.mark.rare
def test_a_rig_whose_inputs_do_not_shift_its_spots_keeps_its_windows(walkers: SpotFilm, tmp_path: Path) -> None:
    """And a scale is said not to be used."""
    text = first_rig(array_film(walkers.frames, "film"), SETTINGS, "film").text.replace("\nB = [[1.0]", "\nB = [[0.0]")
    rig = parse_rig(text)
    settings = replace(SETTINGS, scale=2.0)
    account = import_film(array_film(walkers.frames, "film"), rig, settings, tmp_path / "a.mcap")
    assert "--film scale is not used" in account.notes[-1]
    assert not any(each.inputs.any() for each in Recording(tmp_path / "a.mcap").exposures())


@pytest.mark.rare
@pytest.mark.parametrize(("length", "turns", "said"), [(1.0, 0.0, 0), (1.5, 0.05, 2)])
def test_an_object_that_is_longer_than_wide_is_said(length: float, turns: float, said: int) -> None:
    """Gaussians 1.5 times as long as wide, as sums of round ones along a line; some of them turn."""
    rng = np.random.default_rng(9)
    along = np.array([-1.5, -0.8, -0.4, 0.0, 0.4, 0.8, 1.5])
    along *= 1.8 * np.sqrt(length**2 - 1) / along.std()
    angle = rng.uniform(0, np.pi, 2) + np.cumsum(turns * rng.normal(size=(160, 2)), axis=0)
    offsets = along[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
    motion = random_walk(rng, 160, 2, 0.3)[:, ::4, None] + offsets[:, None]
    film = array_film(spot_film(rng, motion.reshape(160, -1, 2, 2), MIDDLES).frames, "film")
    known = survey(film, SETTINGS, find_objects(film, SETTINGS))
    assert known.length == pytest.approx([length, length], abs=0.06)
    assert sum("times as long as it is wide" in note for note in known.notes()) == said
