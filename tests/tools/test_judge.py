"""`tools/judge`: its scenes and films are what they say, and every judgement makes its table. `tools/paper`."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from aolink.estimation.assumptions import broken_assumptions

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from judging import films
from judging.accuracy import table
from judging.rows import ratio
from judging.scenes import (
    DAMPING,
    EXACT_SWINGS,
    KERNEL_PIXELS,
    PATH_WIDTHS,
    PEAK_SNR,
    SEEDS,
    STEPS,
    SWINGS,
    draw,
    exposures_of,
    rig_of,
)

TOOLS = Path(__file__).parents[2] / "tools"


def run(*arguments: str | Path) -> str:
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, cwd=TOOLS.parent)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_random_scenes_fill_the_ranges_and_are_unlike() -> None:
    assert not set(SEEDS["building"]) & set(SEEDS["judging"])
    scenes = [draw(seed) for seed in SEEDS["building"][:400]]
    assert {scene.geometry for scene in scenes} == {"line", "plane", "plane, one plant"}
    assert {len(scene.modes) for scene in scenes} == {1, 2, 3}
    assert {mode.kind for scene in scenes for mode in scene.modes} == {
        "resonance", "Ornstein-Uhlenbeck", "random walk"
    }  # fmt: skip
    assert {scene.command for scene in scenes} == {"none", "sine", "steps"}
    resonances = [mode for scene in scenes for mode in scene.modes if mode.kind == "resonance"]
    for ends, values in (
        (SWINGS, [mode.swings for mode in resonances]), (DAMPING, [mode.damping for mode in resonances]),
        (PATH_WIDTHS, [scene.path_widths for scene in scenes]), (PEAK_SNR, [scene.peak_snr for scene in scenes]),
        (STEPS, [scene.steps for scene in scenes]), (KERNEL_PIXELS, [scene.kernel_pixels for scene in scenes]),
    ):  # fmt: skip
        assert ends[0] <= min(values) < 1.2 * ends[0]
        assert 0.8 * ends[1] < max(values) <= ends[1]


def test_exact_scenes_have_every_ratio_and_what_may_stand_beside_it() -> None:
    scenes = [draw(seed, "exact") for seed in SEEDS["building"][:80]]
    firsts = [scene.modes[0].swings for scene in scenes]
    assert set(firsts) == set(EXACT_SWINGS)
    hz = {(swings, round(swings / (s.steps * s.fast_step_s), 9)) for swings, s in zip(firsts, scenes, strict=True)}
    assert hz == {(swings, mains) for swings in EXACT_SWINGS for mains in (50.0, 100.0)}
    assert all(rig_of(scene, 1).timing.fast_step_ns % 1 == 0 for scene in scenes)
    modes = [mode for scene in scenes for mode in scene.modes]
    assert {mode.kind for mode in modes} == {"resonance", "constant"}
    assert {sum(mode.kind == "resonance" for mode in scene.modes) for scene in scenes} == {1, 2, 3}
    assert {mode.quadrature for mode in modes} == {False, True}
    assert {scene.exposures for scene in scenes} == {16, 100}
    amplitudes = [scene.amplitude for scene in scenes]
    assert 0.5 <= min(amplitudes) < 0.6
    assert 2.1 < max(amplitudes) <= 2.5


def test_a_seed_gives_one_scene() -> None:
    (one, a), (_, b) = exposures_of(draw(4), 2), exposures_of(draw(4), 2)
    assert all(x.pixels.tobytes() == y.pixels.tobytes() for x, y in zip(a, b, strict=True))
    assert one.sensor.shape == a[0].pixels.shape


@pytest.mark.parametrize("seed", [0, 4, 9])  # a line, a spot on a plane, one moved by one plant
def test_the_path_has_the_sd_and_the_peak_the_snr_that_were_drawn(seed: int) -> None:
    scene = draw(seed)
    rig = rig_of(scene, 3)
    plant, sensor = rig.plant, rig.sensor
    still = np.trace(plant.C @ plant.initial_covariance @ plant.C.T)
    walk = sum(mode.sd**2 for mode in scene.modes if mode.kind == "random walk")
    free = sum(mode.sd**2 for mode in scene.modes) - walk
    assert still == pytest.approx(free + walk / 10)
    assert free + walk == pytest.approx((scene.path_widths * 0.05) ** 2)
    assert sensor.peak_density / np.sqrt(sensor.noise_density / sensor.pixel_size) == pytest.approx(scene.peak_snr)
    assert sensor.kernel.sigma / sensor.pixel_width == pytest.approx(scene.kernel_pixels)


def test_a_vibration_on_a_circle_is_a_quarter_of_a_swing_apart_along_x_and_y() -> None:
    scene = next(
        each for each in (draw(seed, "exact") for seed in range(1, 400, 2))
        if [mode.quadrature for mode in each.modes] == [True] and each.modes[0].swings == 2
    )  # fmt: skip
    _, exposures = exposures_of(scene, 1)
    path = np.concatenate([each.truth.path for each in exposures if each.truth is not None], axis=1)
    quarter = scene.steps // 8
    late = np.corrcoef(path[0, quarter:], path[1, :-quarter])[0, 1]
    assert abs(late) > 0.9
    assert abs(np.corrcoef(path)[0, 1]) < 0.2


def test_scenes_are_what_the_check_of_a_rig_file_says_nothing_of() -> None:
    for seed in SEEDS["building"][:40]:
        for kind in ("random", "exact"):
            assert list(broken_assumptions(rig_of(draw(seed, kind), 1))) == []


@pytest.mark.slow
@pytest.mark.parametrize("motion", films.MOTIONS)
def test_a_films_motion_has_the_size_and_the_lines_that_it_says(motion: str) -> None:
    drawn = films.draw(3, frames=40, motion=motion)
    moved = drawn.path - drawn.path.mean(axis=(0, 1))
    assert bool(drawn.hz) == (motion not in ("still", "random walk"))
    if motion in ("sinusoid", "ellipse", "two lines", "square wave", "growing"):
        assert math.sqrt((moved**2).sum(axis=2).mean()) == pytest.approx(drawn.size, rel=0.5)
    frames = np.stack(list(drawn.film.frames()))
    assert frames.shape == (40, 120, 160)
    assert float(frames.std()) > 1


def test_a_ratio_is_over_pairs_of_scenes() -> None:
    common = np.random.default_rng(1).gamma(1.0, size=(30, 20))
    assert ratio([((0.81 * each).tolist(), each.tolist()) for each in common]) == "0.90 [0.90, 0.90]"
    rows = [
        {"seed": seed, "what": name, "path": (scale * each).tolist(), "inside": [0.95] * 20, "nees": [1.0, 1.1] * 10,
         "seconds": 0.01}
        for seed, each in enumerate(common) for name, scale in (("o1", 1.0), ("moments", 0.81))
    ]  # fmt: skip
    heads, lines = table(rows)
    found = {line[0]: dict(zip(heads, line, strict=True)) for line in lines}
    assert found["moments"]["over o1"] == "0.90 [0.90, 0.90]"
    assert found["moments"]["in 0.90 to 0.99"] == "100%"


@pytest.mark.rare
@pytest.mark.parametrize("what", ["family", "shake", "rolling", "skew", "verdict", "look", "identify"])
def test_each_judgement_makes_a_table_and_goes_on_where_it_was(what: str, tmp_path: Path) -> None:
    command = ("--scenes", "1", "--runs", "1", "--json", tmp_path / "rows.jsonl")
    made = run(TOOLS / "judge", what, *command)
    kept = (tmp_path / "rows.jsonl").read_text()
    (tmp_path / "rows.jsonl").write_text(kept + kept[:20])  # stopped while it wrote
    assert run(TOOLS / "judge", what, *command) == made
    assert (tmp_path / "rows.jsonl").read_text() == kept


@pytest.mark.slow
def test_the_papers_numbers_are_found() -> None:
    said = run(TOOLS / "paper", "--quick")
    for words in ("0.0667", "misprint, 16.8 times", "2 of 2 states", "0 of 2 states", "6.092", "-0.0038"):
        assert words in said
