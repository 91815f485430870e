"""The light of a film's objects that fades: found, said and undone."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

import aolink
from aolink.estimation import run
from aolink.films.film import array_film
from aolink.importing.brightness import brightness_of
from aolink.importing.first_rig import first_rig
from aolink.importing.frames import FilmSettings
from aolink.importing.recording import import_film
from aolink.importing.survey import survey
from aolink.importing.tracker import find_objects
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig, parse_rig
from aolink.series import Series
from tests.kinds import truth_of

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from paper_report.spot_films import random_walk, spot_film

MIDDLES = ((24.0, 32.0), (70.0, 30.0))
K, FRAMES = 8, 96


def quiet(name: str) -> Rig:
    """A rig whose camera has a tenth of the noise."""
    rig = load_rig(name)
    number = f"noise_density = {rig.sensor.noise_density / 100!r}"
    text, found = re.subn(r"^noise_density = \S+", number, rig.toml, flags=re.MULTILINE)
    assert found == 1
    return parse_rig(text)


def rate(rig: Rig) -> float:
    return 1 / (rig.timing.frame_period_steps * rig.timing.fast_step_s)


def starts(exposures: Series) -> list[int]:
    return [each.first_step for each in exposures]


@pytest.mark.parametrize("lost", [0.7, 0.0, -0.4])
@pytest.mark.parametrize("seed", range(3))
def test_light_that_fades_or_grows_is_found_whatever_single_objects_do(lost: float, seed: int) -> None:
    """Five objects, of which one doubles its light half-way and one is not seen then; in 5 % of noise."""
    rng = np.random.default_rng(seed)
    true = (1 - lost) ** (np.arange(400) / 399)
    light = true[:, None] * rng.uniform(1, 9, 5) * np.exp(0.05 * rng.normal(size=(400, 5)))
    light[200:, 0] *= 2
    light[200:, 1] = 0
    light[37] = 0
    np.testing.assert_allclose(brightness_of(light), true / true.mean(), atol=0.05 if lost else 0)


def test_objects_that_change_each_in_its_own_way_have_no_common_light() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        ends = rng.normal(size=6) * 0.2
        light = np.exp(np.linspace(0, 1, 300)[:, None] * ends + 0.06 * rng.normal(size=(300, 6)))
        assert (brightness_of(light) == 1).all()
    assert (brightness_of(np.exp(0.1 * rng.normal(size=(10, 1)))) == 1).all(), "too short to tell"


def spots(rig: Rig, change: float, seed: int = 3) -> tuple[Series, np.ndarray]:
    """Exposures of the simulated camera, and their frames as if the spots' light had changed by such a share."""
    simulated = aolink.simulate(rig, 120, seed=seed)
    frames = np.array([each.pixels for each in simulated], dtype=np.float64)
    light = (1 + change) ** (np.arange(len(frames)) / (len(frames) - 1))
    black = rig.sensor.black_level
    return simulated, np.rint(black + (frames - black) * light[:, None, None]).astype(np.uint16)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "estimator"), [("sh-4x4", "moments"), ("section-vi-lively", "o1")])
@pytest.mark.parametrize(("change", "said"), [(-0.4, "fades by (3[6-9]|4[0-4])%"), (0.5, "grows by (4[2-9]|5[0-8])%")])
def test_a_film_of_the_rigs_own_camera_that_fades_is_scaled_to_its_light(
    tmp_path: Path, name: str, estimator: str, change: float, said: str
) -> None:
    """Estimates are as near to the path as those of the film that does not change."""
    rig = quiet(name)
    simulated, frames = spots(rig, change)
    inputs = np.concatenate([part for each in simulated for part in (each.lead_inputs, each.inputs)])
    film = array_film(frames, "film", inputs=inputs)
    account = import_film(film, rig, FilmSettings(rate_hz=rate(rig), start_ns=0), tmp_path / "a.mcap")
    assert any(re.search(said, note) for note in account.notes)
    found = aolink.estimate(Recording(tmp_path / "a.mcap"), estimator).estimates(estimator)
    as_they_came = aolink.estimate(aolink.exposures(frames, rig, inputs, starts(simulated)), estimator).estimates(
        estimator
    )
    true = np.array([truth_of(each).path for each in simulated])
    errors = [
        np.sqrt(np.mean((np.array([each.path for each in some]) - true)[5:] ** 2))
        for some in (aolink.estimate(simulated, estimator).estimates(estimator), found, as_they_came)
    ]
    assert errors[1] < 1.1 * errors[0]
    assert errors[2] > 1.1 * errors[1]


@pytest.mark.rare
@pytest.mark.parametrize("name", ["sh-4x4", "section-vi-lively", "single-lenslet", "jitter"])
@pytest.mark.parametrize("seed", range(3))
def test_a_film_whose_light_is_constant_is_left_as_it_is(tmp_path: Path, name: str, seed: int) -> None:
    """Noise, motion, and another light than the rig file's are no change."""
    rig = load_rig(name)
    _, frames = spots(rig, 0.0, seed)
    half = np.rint(rig.sensor.black_level + (frames - rig.sensor.black_level) / 2).astype(np.uint16)
    for some in (frames, half):
        account = import_film(
            array_film(some, "film"),
            rig,
            FilmSettings(rate_hz=rate(rig), start_ns=0),
            tmp_path / "a.mcap",
            overwrite=True,
        )
        assert account.notes == ()
        for each, frame in zip(Recording(tmp_path / "a.mcap").exposures(), some, strict=True):
            assert (each.pixels == frame)[each.mask].all()


@pytest.mark.rare
@pytest.mark.parametrize("slope", [0.0, 3.0])
def test_the_ground_does_not_hide_that_light_fades(slope: float) -> None:
    """A ground of the same light under the tracker's weight as an object's, or one that is brighter to one side."""
    rng = np.random.default_rng(3)
    still = spot_film(rng, random_walk(rng, FRAMES, 2, 0.45), np.array(MIDDLES), noise=0.0).frames - 1000.0
    left = 0.5 ** (np.arange(FRAMES) / (FRAMES - 1))
    ground = 400 + slope * np.arange(still.shape[2]) + 10 * rng.normal(size=still.shape)
    film = array_film(np.rint(still * left[:, None, None] + ground).astype(np.uint16), "film")
    settings = FilmSettings(rate_hz=100.0, track=2, frames_per_exposure=K, places=MIDDLES)
    known = survey(film, settings, find_objects(film, settings))
    assert known.brightness == pytest.approx(left / left.mean(), rel=0.02)
    assert known.light == pytest.approx(np.full(2, 20_000 * left.mean()), rel=0.02)
    assert (known.beside < 1 / 3).all()


@pytest.mark.rare
@pytest.mark.parametrize("background", [True, False])
def test_exposures_of_a_film_that_fades_are_scaled_to_the_same_light(background: bool, tmp_path: Path) -> None:
    """By 30 %: exposures have the light and the errors of those of the same film that does not fade."""
    rng = np.random.default_rng(3)
    still = spot_film(rng, random_walk(rng, FRAMES, 2, 0.45), np.array(MIDDLES), noise=0.0)
    noise = 20 * rng.normal(size=still.frames.shape)
    settings = FilmSettings(rate_hz=100.0, subtract_median=background, track=2, frames_per_exposure=K, places=MIDDLES)
    found = {}
    for lost in (0.0, 0.3):
        left = (1 - lost) ** (np.arange(FRAMES) / (FRAMES - 1))
        frames = np.rint(1000 + (still.frames - 1000.0) * left[:, None, None] + noise).astype(np.uint16)
        film = array_film(frames, "film")
        made = first_rig(film, settings, "film")
        rig = parse_rig(made.text)
        notes = import_film(film, rig, settings, tmp_path / f"{lost}.mcap").notes
        assert [bool(re.search(r"fades by (29|30|31)%", " ".join(some))) for some in (notes, made.notes)] == [
            lost > 0
        ] * 2
        exposures = list(Recording(tmp_path / f"{lost}.mcap").exposures())
        counts = np.array([each.pixels - float(rig.sensor.black_level) for each in exposures])
        light = counts.sum(axis=(1, 2)) / rig.sensor.counts_per_density
        assert light == pytest.approx(np.full(len(light), light.mean()), rel=0.05)
        (estimates,) = run(rig, exposures, ["profile"]).values()
        errors = np.array([e.path - truth_of(x).path for e, x in zip(estimates, exposures, strict=True)])[1:]
        found[lost] = np.sqrt(np.mean(errors**2)) / rig.sensor.pixel_width
        sds = np.hypot([e.path_sd for e in estimates[1:]], truth_of(exposures[0]).path_sd)
        assert np.mean(np.abs(errors) < 1.96 * sds) > 0.9
    assert found[0.3] < 1.1 * found[0.0]
