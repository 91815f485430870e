"""The light of a film's objects that fades: found, said and undone."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import aolink
from aolink.films.film import array_film
from aolink.importing.brightness import brightness_of
from aolink.importing.frames import FilmSettings
from aolink.importing.recording import import_film
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig, parse_rig
from aolink.series import Series
from tests.kinds import truth_of


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
        settings = FilmSettings(rate_hz=rate(rig), start_ns=0, row_time_s=0.0)
        account = import_film(array_film(some, "film"), rig, settings, tmp_path / "a.mcap", overwrite=True)
        assert account.notes == ()
        for each, frame in zip(Recording(tmp_path / "a.mcap").exposures(), some, strict=True):
            assert (each.pixels == frame)[each.mask].all()
