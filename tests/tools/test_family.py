"""The family of scenes, and the judgement of estimators over it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from aolink.estimation import make_estimator

TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture(autouse=True)
def tools(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(TOOLS))


def test_scenes_are_within_the_family_and_unlike() -> None:
    from paper_report.family import DAMPING, KERNEL_PIXELS, PATH_WIDTHS, PEAK_SNR, SEEDS, STEPS, SWINGS, draw

    assert not set(SEEDS["tuning"]) & set(SEEDS["reporting"])
    scenes = [draw(seed) for seed in SEEDS["tuning"][:400]]
    assert {scene.geometry for scene in scenes} == {"line", "plane", "plane, one plant"}
    assert {len(scene.modes) for scene in scenes} == {1, 2, 3}
    assert {mode.kind for scene in scenes for mode in scene.modes} == {
        "resonance", "Ornstein-Uhlenbeck", "random walk"
    }  # fmt: skip
    assert {scene.command for scene in scenes} == {"none", "sine", "steps"}
    resonances = [mode for scene in scenes for mode in scene.modes if mode.kind == "resonance"]
    for ends, values in (
        (SWINGS, [mode.swings for mode in resonances]),
        (DAMPING, [mode.damping for mode in resonances]),
        (PATH_WIDTHS, [scene.path_widths for scene in scenes]),
        (PEAK_SNR, [scene.peak_snr for scene in scenes]),
        (STEPS, [scene.steps for scene in scenes]),
        (KERNEL_PIXELS, [scene.kernel_pixels for scene in scenes]),
    ):
        assert ends[0] <= min(values) < 1.2 * ends[0]
        assert 0.8 * ends[1] < max(values) <= ends[1]
    half_turns = [2 * m.swings * s.period / s.steps for s in scenes for m in s.modes if m.kind == "resonance"]
    assert 0.1 < np.mean([abs(k - round(k)) < 1e-9 for k in half_turns]) < 0.4


def test_a_seed_gives_one_scene() -> None:
    from paper_report.family import draw, exposures_of

    (one, a), (_, b) = exposures_of(draw(4), 2, 3), exposures_of(draw(4), 2, 3)
    assert all(x.pixels.tobytes() == y.pixels.tobytes() for x, y in zip(a, b, strict=True))
    assert one.sensor.shape == a[0].pixels.shape


@pytest.mark.parametrize("seed", [0, 4, 9])  # a line, a spot on a plane, one moved by one plant
def test_the_path_has_the_sd_and_the_peak_the_snr_that_were_drawn(seed: int) -> None:
    from paper_report.family import draw, rig_of

    scene = draw(seed)
    rig = rig_of(scene, 3, 20)
    plant, sensor = rig.plant, rig.sensor
    free = [mode for mode in scene.modes if mode.kind != "random walk"]
    still = np.trace(plant.C @ plant.initial_covariance @ plant.C.T)
    walk = sum(mode.sd**2 for mode in scene.modes if mode.kind == "random walk")
    assert still == pytest.approx(sum(mode.sd**2 for mode in free) + walk / 10)
    assert sum(mode.sd**2 for mode in scene.modes) == pytest.approx((scene.path_widths * 0.05) ** 2)
    assert sensor.peak_density / np.sqrt(sensor.noise_density / sensor.pixel_size) == pytest.approx(scene.peak_snr)
    assert sensor.kernel.sigma / sensor.pixel_width == pytest.approx(scene.kernel_pixels)


@pytest.mark.parametrize("seed", [0, 3, 9])
def test_the_first_runs_of_a_scene_are_those_of_all(seed: int) -> None:
    from paper_report.family import draw, exposures_of
    from paper_report.judge import first_runs

    rig, exposures = exposures_of(draw(seed), 3, 4)
    fewer, some = first_runs(rig, exposures, 2)
    both = [make_estimator(each, "moments") for each in (rig, fewer)]
    for whole, part in zip(exposures, some, strict=True):
        all_of_them, first = both[0].step(whole), both[1].step(part)
        outputs = fewer.n_outputs
        np.testing.assert_allclose(first.path, all_of_them.path[:outputs], rtol=1e-9, atol=1e-12)
        assert part.truth is not None
        assert part.truth.path.shape == first.path.shape


def test_it_is_stopped_and_continued(tmp_path: Path) -> None:
    rows = tmp_path / "rows.jsonl"
    command = [TOOLS / "family", "--rows", rows, "--runs", "2", "--exposures", "6"]
    command += ["--estimator", "open-loop", "--estimator", "moments"]

    def judged(scenes: int) -> list[str]:
        done = subprocess.run(
            [sys.executable, *map(str, command), "--scenes", str(scenes)], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return rows.read_text().splitlines()

    both = judged(2)
    assert len(both) == 4
    rows.write_text("\n".join([*both[:2], both[2][:40]]))  # stopped while it wrote
    again = judged(2)
    assert again[:2] == both[:2]
    assert [line.partition('"seconds"')[0] for line in again] == [line.partition('"seconds"')[0] for line in both]
