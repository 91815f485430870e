"""What the demo prints: its sentence has the figures of its own recording, and what to say on other rigs."""

from __future__ import annotations

import dataclasses
import re
import subprocess
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.cli.tables.sessions import demo_sentence, session
from aolink.estimation import Score, Scorer
from aolink.jobs.demo import DemoResult
from aolink.recording.account import Commands
from aolink.recording.deblur import RestoredCounts
from aolink.recording.reader import Recording
from aolink.session import Report

README = Path(__file__).parents[2] / "README.md"
EXPOSURES = 40
NUMBER = r"(-?\d+\.\d+)"
SENTENCE = re.compile(
    rf"\(o1\) gives the path to {NUMBER} slope units, the blur \(moments\) to {NUMBER}, {NUMBER} times better;"
    rf" the scene, .*, goes from {NUMBER} to {NUMBER} dB \(PSNR\)\."
)


def path_rmse(recording: Recording, name: str) -> float:
    errors = [
        estimate.path - exposure.truth.path
        for exposure, estimate in zip(recording.exposures(), recording.estimates(name), strict=True)
        if exposure.truth is not None
    ]
    assert len(errors) == EXPOSURES
    return float(np.sqrt(np.mean(np.square(errors))))


def scene_psnrs(recording: Recording) -> tuple[float, float]:
    """Of the pictures as they came, where they overlap with the true scene moved by the mean motion, in whole pixels;
    and of the restored ones. Intensities by the rig file's own numbers."""
    picture = recording.rig.scene
    assert picture is not None
    assert recording.true_scene is not None
    true = (recording.true_scene - 100.0) / 3500.0
    blurred, sharp = [], []
    series = zip(recording.exposures(), recording.estimates("moments"), recording.restored(), strict=True)
    for exposure, estimate, restored in series:
        assert exposure.scene is not None
        assert restored.scene is not None
        seen = (exposure.scene.pixels - 100.0) / 3500.0
        shift = round(estimate.path.mean() / 0.05)
        here = seen[:, max(shift, 0) : 128 + min(shift, 0)] - true[:, max(-shift, 0) : 128 + min(-shift, 0)]
        blurred.append(-10 * np.log10(np.mean(here**2)))
        sharp.append(-10 * np.log10(np.mean((restored.scene - true) ** 2)))
    return float(np.mean(blurred)), float(np.mean(sharp))


@pytest.mark.slow
def test_the_demo_ends_with_what_its_recording_says(
    aolink: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    done = aolink("demo", "-o", tmp_path)
    assert done.returncode == 0, done.stderr
    (folder,) = tmp_path.glob("demo-*")
    recording = Recording(folder / "deblurred.mcap")
    assert recording.rig.name == "moving-scene"
    assert recording.estimators == ["open-loop", "o1", "moments"]
    found = SENTENCE.search(done.stdout.splitlines()[-1])
    assert found, done.stdout
    centroid, blur = path_rmse(recording, "o1"), path_rmse(recording, "moments")
    expected = [centroid, blur, centroid / blur, *scene_psnrs(recording)]
    assert [float(each) for each in found.groups()] == pytest.approx(expected, rel=5e-3, abs=0.051)
    assert float(found[1]) == pytest.approx(centroid, rel=5e-3)
    assert float(found[2]) == pytest.approx(blur, rel=5e-3)
    # What README quotes of it is what it prints.
    assert set(SENTENCE.findall(README.read_text())) <= {found.groups()}
    _, _, rows = README.read_text().partition("\n    estimator   RMSE path")
    assert {row.strip() for row in rows.partition("\n\n")[0].splitlines()[1:]} <= {
        line.strip() for line in done.stdout.splitlines()
    }
    assert "agree bit for bit" in done.stdout
    assert {"rig.toml", "session.mcap", "session.rrd", "session.png"} <= {each.name for each in folder.iterdir()}
    for never in ("discarded", "superseded", "late", "parked", "latency"):
        assert never not in done.stdout


@pytest.mark.rare
def test_the_demo_runs_the_estimators_that_are_named(
    aolink: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    wrong = aolink("demo", "-e", "o4", "-o", tmp_path)
    assert "there is no estimator 'o4'" in wrong.stderr
    assert not list(tmp_path.iterdir())
    done = aolink(
        "demo", "--rig", "section-vi-lively", "-e", "o3", "-e", "o1", "-e", "o3", "--exposures", "4", "-o", tmp_path
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (folder,) = tmp_path.glob("demo-*")
    assert Recording(folder / "session.mcap").estimators == ["o3", "o1"]
    assert "the blur (o3) to" in done.stdout.splitlines()[-1]
    assert "scene" not in done.stdout.splitlines()[-1]


def scores(**errors: float) -> dict[str, Score]:
    """Scores that are the same but for the path's error."""
    one = Scorer().result()
    return {name.replace("_", "-"): dataclasses.replace(one, path_rmse=error) for name, error in errors.items()}


@pytest.mark.parametrize(
    ("errors", "said"),
    [
        ({"open_loop": 0.2, "o1": 0.0603, "moments": 0.0236},
         "With the rig file's plant the centroid (o1) gives the path to 0.0603 slope units, the blur"
         " (moments) to 0.0236, 2.6 times better."),
        ({"o1": 0.5, "o2": 1.0},
         "With the rig file's plant the centroid (o1) gives the path to 0.500 slope units, the blur"
         " (o2) to 1.00, 2.0 times worse."),
        ({"o1": 1.0, "o3": 1.01},
         "With the rig file's plant the centroid (o1) gives the path to 1.00 slope units, the blur"
         " (o3) to 1.01, no better."),
        ({"open_loop": 0.2, "o1": 0.1}, "The path is known to 0.100 slope units by o1."),
        ({"moments": 12.34}, "The path is known to 12.3 slope units by moments."),
        ({"o1": np.nan, "moments": np.nan}, "The truth is not known here, and so no error either."),
    ],
)  # fmt: skip
def test_the_sentence_says_what_there_is(errors: dict[str, float], said: str) -> None:
    result = DemoResult(recording=Path("a.mcap"), report=Report(), scores=scores(**errors), seconds={})
    assert demo_sentence(result) == said
    left = dataclasses.replace(result, residuals={"open": 0.2, "lqg": 0.05})
    assert demo_sentence(left).endswith("he slopes left are, rms, open 0.2, lqg 0.05.")
    # Pictures that were not restored, or a scene that nobody knows, say nothing.
    nothing = RestoredCounts(exposures=2, reasons=Counter({"no path": 2}))
    assert demo_sentence(dataclasses.replace(result, deblurred=nothing)) == demo_sentence(result)
    restored = RestoredCounts(exposures=2, scenes=2, psnr_blurred=[10.0, 20.0], psnr_restored=[30.0, 31.0])
    assert demo_sentence(dataclasses.replace(result, deblurred=restored)).endswith("from 15.0 to 30.5 dB (PSNR).")


def test_counts_are_shown_where_they_are_not_zero() -> None:
    def rows(report: Report) -> dict[str, str]:
        columns = [list(column.cells) for column in session(report).columns]
        return dict(zip(*columns, strict=True))

    good = Report(virtual_time=True, frames_received=40, commands=Commands(commanded=80, applied=80))
    assert rows(good).keys() == {"frames", "commands", "clock"}
    assert rows(good)["frames"] == "40 received"
    assert rows(good)["commands"] == "80 steps commanded, 80 applied"
    bad = dataclasses.replace(good, frames_lost=2, commands=Commands(commanded=80, applied=77, late=3), rearmed=1)
    bad.connection_faults = good.connection_faults | {"bad_crc": 5}
    assert rows(bad)["frames"] == "40 received, 2 lost whole"
    assert rows(bad)["commands"] == "80 steps commanded, 77 applied, 3 late"
    assert rows(bad)["mirror"] == "1 times re-armed after its watchdog"
    assert rows(bad)["connections"] == "5 discarded for their checksum"
