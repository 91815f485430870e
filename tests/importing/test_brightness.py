"""The light of a film's objects that fades: found, said and undone."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from aolink.estimation import run
from aolink.importing.brightness import brightness_of
from aolink.importing.film import array_film
from aolink.importing.first_rig import first_rig
from aolink.importing.frames import Settings
from aolink.importing.recording import import_film
from aolink.recording.reader import Recording
from aolink.rig import parse_rig
from tests.kinds import truth_of

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))
from paper_report.spot_films import random_walk, spot_film

MIDDLES = ((24.0, 32.0), (70.0, 30.0))
K, FRAMES = 8, 96


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


@pytest.mark.long
def test_exposures_of_a_film_that_fades_are_scaled_to_the_same_light(tmp_path: Path) -> None:
    """By 30 %: exposures have the light and the errors of those of the same film that does not fade."""
    rng = np.random.default_rng(3)
    still = spot_film(rng, random_walk(rng, FRAMES, 2, 0.45), np.array(MIDDLES), noise=0.0)
    noise = 20 * rng.normal(size=still.frames.shape)
    settings = Settings(rate_hz=100.0, subtract_median=True, track=2, frames_per_exposure=K, places=MIDDLES)
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
