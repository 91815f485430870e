"""The family of scenes, and the judgement of estimators over it."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from aolink.estimation import make_estimator
from aolink.estimation.assumptions import broken_assumptions

if TYPE_CHECKING:
    from paper_report.judge import Row

TOOLS = Path(__file__).parents[2] / "tools"
CHEAP_SCENES = (160003, 160005)
"""Reporting scenes of which the repository keeps rows."""


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


@pytest.mark.rare
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


@pytest.mark.slow
def test_rows_that_the_repository_keeps_are_those_of_todays_code() -> None:
    """The rows of two scenes, a line and a spot on a plane, agree to one part in a thousand; other machines and another
    order of sums change them by less."""
    from paper_report.family import SEEDS, draw
    from paper_report.judge import RECORDED, Size, judge, read_rows

    kept = {(row.seed, row.estimator): row for row in read_rows(RECORDED)}
    assert {seed for seed, _ in kept} <= set(SEEDS["reporting"])
    assert all(row.commit and not row.commit.endswith("+") for row in kept.values())
    for seed in CHEAP_SCENES:
        for row in judge(draw(seed), ["open-loop", "o1", "moments"], Size(runs=8)):
            there = kept[seed, row.estimator]
            assert (there.states, there.scored, there.statuses) == (row.states, row.scored, row.statuses)
            np.testing.assert_allclose([row.path, row.nees], [there.path, there.nees], rtol=1e-3)
            np.testing.assert_allclose(row.inside, there.inside, atol=3e-3)  # a step more or less at an interval's end


def test_its_scenes_are_what_the_check_of_a_rig_file_says_nothing_of() -> None:
    from paper_report.family import SEEDS, draw, rig_of

    for seed in SEEDS["tuning"][:60]:
        assert list(broken_assumptions(rig_of(draw(seed), 1, 24))) == []


def rows_of(estimator: str, path: Sequence[Sequence[float]], nees: float = 2.0) -> list[Row]:
    """Rows by seed, with these squared errors of each run."""
    from paper_report.judge import Row

    return [
        Row(seed=seed, estimator=estimator, states=2, scored=100, path=list(each), inside=[0.95] * len(each),
            nees=[nees + 0.1 * (-1) ** k for k in range(len(each))], several=0.0, statuses={"OK": 5}, seconds=0.01)
        for seed, each in enumerate(path)
    ]  # fmt: skip


def test_ratios_over_the_family_are_paired_by_run() -> None:
    from paper_report.verdict import by_estimator, family_ratio, ratios

    common = np.random.default_rng(1).gamma(1.0, size=(30, 20))
    rows = by_estimator([*rows_of("moments", (0.81 * common[:, :8]).tolist()), *rows_of("o1", common.tolist())])
    assert list(ratios(rows, "moments", "o1").values()) == pytest.approx([0.9] * 30)
    bound = family_ratio(rows, "moments", "o1")
    assert bound is not None
    assert bound.low == pytest.approx(0.9)
    assert bound.high == pytest.approx(0.9)


def test_a_scene_that_is_worse_is_found_and_chance_is_not() -> None:
    """Holm: of 300 scenes without a difference hardly one in twenty families has one that is called worse."""
    from paper_report.verdict import by_estimator, significantly_worse

    rng = np.random.default_rng(2)
    reference = rng.gamma(4.0, size=(300, 24))
    same = reference * rng.lognormal(0.0, 0.1, reference.shape)
    rows = by_estimator([*rows_of("moments", same.tolist()), *rows_of("o1", reference.tolist())])
    assert significantly_worse(rows, "moments", "o1") == []
    same[17] *= 1.5
    worse = by_estimator([*rows_of("moments", same.tolist()), *rows_of("o1", reference.tolist())])
    assert significantly_worse(worse, "moments", "o1") == [17]


def test_goals_are_held_or_not() -> None:
    from paper_report.verdict import by_estimator, goals

    errors = np.random.default_rng(3).gamma(4.0, size=(40, 12))
    one, near, limit, far = ((share * errors).tolist() for share in (1.0, 0.9, 0.88, 1.3))
    rows = [*rows_of("o1", one), *rows_of("profile", near), *rows_of("sampled", limit)]
    held = goals(by_estimator(rows))
    assert held
    assert all(goal.held and goal.verdict == "held (40 scenes)" for goal in held)
    few = goals(by_estimator([row for row in rows if row.seed < 5]))
    assert {goal.verdict for goal in few} == {"too few scenes to tell (5)"}
    too_sure = [*rows_of("profile", far, nees=3.0), *rows_of("o1", one), *rows_of("sampled", limit)]
    judged = goals(by_estimator(too_sure))
    assert [goal.held for goal in judged] == [False, True, False, False]  # limit, coverage, NEES, o1


@pytest.mark.slow
def test_the_picture_is_drawn_of_the_rows_that_are_kept(tmp_path: Path) -> None:
    from paper_report.figures import figure_family
    from paper_report.judge import RECORDED, read_rows

    figure_family(tmp_path / "family.png", read_rows(RECORDED), 40)
    assert (tmp_path / "family.png").stat().st_size > 5000
