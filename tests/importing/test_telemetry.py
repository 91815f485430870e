"""AOT telemetry that aotpy wrote: slopes without pictures all the way to estimates, and commands by their times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import aolink
from aolink.errors import EstimatorError, ImportingError
from aolink.estimation import run
from aolink.exporting.files import export
from aolink.exposure import Exposure
from aolink.films.formats import open_film
from aolink.importing.frames import FilmAccount, FilmSettings
from aolink.importing.recording import import_film
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig
from aolink.series import Series
from tests.importing import others
from tests.importing.rigs import small_rig
from tests.kinds import must_be
from tests.needs import needed

aotpy = needed("aotpy")

RIGS = ("section-vi-lively", "single-lenslet", "sh-4x4")
COUNT = 12
START_S = 1_790_000_000.0
FRAMES = np.random.default_rng(9).integers(1000, 2000, size=(7, 8, 8), dtype=np.uint16)


def centroids(rig: Rig, exposures: Series) -> np.ndarray:
    """What another program would have measured, (frames, 2, spots): the path's mean with some noise."""
    rng = np.random.default_rng(4)
    true = np.array([each.truth.path.mean(axis=1) for each in exposures if each.truth is not None])
    seen = true + 0.01 * rng.normal(size=true.shape)
    if seen.shape[1] == 1:
        return np.stack([seen, np.full_like(seen, np.nan)], axis=1)
    return seen.reshape(len(seen), -1, 2).swapaxes(1, 2)


def imported(path: Path, rig: Rig, **settings: object) -> tuple[Recording, FilmAccount]:
    out = path.with_suffix(".mcap")
    account = import_film(open_film(path), rig, FilmSettings(**settings), out, overwrite=True)  # type: ignore[arg-type]
    return Recording(out), account


def times_of(rig: Rig, exposures: Series) -> list[float]:
    return [START_S + each.first_step * rig.timing.fast_step_s for each in exposures]


@pytest.mark.parametrize("name", RIGS)
def test_o1_takes_slopes_without_pictures_as_it_takes_centroids(name: str, tmp_path: Path) -> None:
    rig = load_rig(name)
    exposures = aolink.simulate(name, n_exposures=COUNT, seed=2)
    slopes = centroids(rig, exposures)
    inputs = np.concatenate([each.inputs for each in exposures])
    at = START_S + np.arange(len(inputs)) * rig.timing.fast_step_s
    path = others.write_aot(
        tmp_path / "a.fits", None, slopes=slopes, times_s=times_of(rig, exposures), commands=inputs,
        command_times_s=at.tolist(),
    )  # fmt: skip
    recording, account = imported(path, rig)
    assert "holds slopes of the wavefront sensor SH and no pictures: only o1 and open-loop" in account.notes[0]
    found = list(recording.exposures())
    for each, row, simulated in zip(found, slopes, exposures, strict=True):
        np.testing.assert_array_equal(each.slopes, row.T.ravel()[: rig.n_outputs])
        np.testing.assert_array_equal(each.inputs, simulated.inputs)
        assert not each.mask.any()
    made = run(rig, found, ["open-loop", "o1"])
    of_pixels = run(rig, exposures, ["o1"])["o1"]
    assert all(each.status.name == "OK" for each in made["o1"])
    true = [each.truth.path for each in exposures if each.truth is not None]
    error, alone, pixels = (
        np.mean([(e.path - t) ** 2 for e, t in zip(which, true, strict=True)])
        for which in (made["o1"], made["open-loop"], of_pixels)
    )
    assert error < alone
    assert error < 1.2 * pixels


def test_other_estimators_say_that_there_are_slopes_only(tmp_path: Path) -> None:
    recording, _ = imported(others.write_aot(tmp_path / "a.fits", None), small_rig(20, 20), rate_hz=50)
    for name in ("o2", "o3", "moments", "profile"):
        with pytest.raises(
            EstimatorError, match="exposure 1 holds slopes only, no pixels: o1 and open-loop can use it"
        ):
            run(recording.rig, recording.exposures(), [name])


def test_a_slope_that_was_not_measured_is_left_out(tmp_path: Path) -> None:
    slopes = np.zeros((7, 2, 1))
    slopes[3] = np.nan
    recording, _ = imported(others.write_aot(tmp_path / "a.fits", None, slopes=slopes), small_rig(20, 20), rate_hz=50)
    (estimates,) = run(recording.rig, recording.exposures(), ["o1"]).values()
    assert [each.status.name for each in estimates].count("INPUT_INVALID") == 1
    assert estimates[3].reason == "no slope was measured"


def test_scale_makes_slopes_of_another_unit(tmp_path: Path) -> None:
    slopes = np.arange(14.0).reshape(7, 2, 1)
    path = others.write_aot(tmp_path / "a.fits", None, slopes=slopes)
    recording, _ = imported(path, small_rig(20, 20), rate_hz=50, scale=0.01)
    for each, row in zip(recording.exposures(), slopes, strict=True):
        np.testing.assert_allclose(must_be(np.ndarray, each.slopes), 0.01 * row[:, 0])


@pytest.mark.parametrize(
    ("rig", "settings", "says"),
    [
        ("sh-4x4", {}, "has 2 slopes in each frame, the rig file sh-4x4 32"),
        ("single-lenslet", {"places": ((3.0, 3.0),)}, "--at"),
    ],
)
def test_slopes_that_are_not_the_rigs_are_refused(
    rig: str, settings: dict[str, object], says: str, tmp_path: Path
) -> None:
    path = others.write_aot(tmp_path / "a.fits", None)
    with pytest.raises(ImportingError, match=says):
        imported(path, load_rig(rig), rate_hz=5, **settings)


@pytest.mark.slow
def test_slopes_go_through_every_command_and_back_to_aot(aolink, tmp_path):
    rig = tmp_path / "my.toml"
    rig.write_text(small_rig(20, 20).toml)
    slopes = np.random.default_rng(1).normal(size=(7, 2, 1)) * 0.1
    others.write_aot(tmp_path / "a.fits", None, slopes=slopes)
    done = aolink("import", "a.fits", "-o", "a.mcap", "--rig", rig, "--rate", "50")
    assert done.returncode == 0, done.stderr
    assert "only o1 and open-loop can use them" in done.stdout.replace("\n", " ")
    assert "slopes without pictures" in aolink("info", "a.mcap").stdout.replace("\n", " ")
    refused = aolink("estimate", "a.mcap", "-e", "o3", "-o", "b.mcap")
    assert refused.returncode == EstimatorError.exit_code
    assert "holds slopes only, no pixels" in refused.stderr.replace("\n", " ")
    assert not (tmp_path / "b.mcap").exists()
    assert aolink("estimate", "a.mcap", "-e", "o1", "-o", "b.mcap").returncode == 0
    assert aolink("view", "b.mcap", "-o", "b.rrd").returncode == 0
    for suffix in ("fits", "npz", "csv"):
        done = aolink("export", "b.mcap", "-o", f"b.{suffix}")
        assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "b.npz") as arrays:
        np.testing.assert_array_equal(arrays["slopes"], slopes[:, :, 0])
    assert aolink("import", "b.fits", "-o", "c.mcap", "--rig", rig).returncode == 0
    np.testing.assert_array_equal([each.slopes for each in Recording(tmp_path / "c.mcap").exposures()], slopes[:, :, 0])


@pytest.mark.parametrize("name", ["single-lenslet", "section-vi-lively"])
def test_inputs_come_back_from_our_own_export(name: str, tmp_path: Path) -> None:
    exposures = aolink.simulate(name, n_exposures=6, seed=3)
    rig = load_rig(name)
    first = aolink.exposures(
        np.array([each.pixels for each in exposures]), rig, inputs=np.concatenate([each.inputs for each in exposures])
    )
    import_back(first, rig, tmp_path)


def import_back(exposures: Series, rig: Rig, folder: Path) -> None:
    """Through MCAP to AOT and back."""
    np.savez(
        folder / "a.npz", frames=[each.pixels for each in exposures],
        inputs=np.concatenate([np.concatenate([each.lead_inputs, each.inputs]) for each in exposures]),
        rate_hz=1 / (rig.timing.frame_period_steps * rig.timing.fast_step_s),
    )  # fmt: skip
    import_film(open_film(folder / "a.npz"), rig, FilmSettings(start_ns=int(START_S * 1e9)), folder / "a.mcap")
    export(Recording(folder / "a.mcap"), folder / "a.fits")
    recording, account = imported(folder / "a.fits", rig)
    check_inputs(list(recording.exposures()), list(exposures))
    assert not any("left out" in note for note in account.notes)


def check_inputs(found: list[Exposure], expected: list[Exposure]) -> None:
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(ours.pixels, theirs.pixels)
        np.testing.assert_array_equal(ours.inputs, theirs.inputs)
        np.testing.assert_array_equal(ours.lead_inputs, theirs.lead_inputs)


def test_inputs_of_a_session_with_dead_time_come_back(tmp_path: Path) -> None:
    rig = small_rig(10, 20)
    rng = np.random.default_rng(8)
    frames = rng.integers(1000, 2000, size=(5, 8, 8))
    inputs = rng.normal(size=(4 * 20 + 10, 2))
    import_back(aolink.exposures(frames, rig, inputs=inputs, start_steps=range(0, 100, 20)), rig, tmp_path)


def test_commands_are_held_by_their_times(tmp_path: Path) -> None:
    """Three commands, one of them before the film begins and two in the same fast step."""
    rig = small_rig(20, 20)
    commands = np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]])
    at = [START_S - 0.5, START_S + 0.0302, START_S + 0.0304, START_S + 9.0]
    path = others.write_aot(
        tmp_path / "a.fits", FRAMES, commands=commands, times_s=[START_S + k / 50 for k in range(7)], command_times_s=at
    )
    recording, account = imported(path, rig)
    inputs = np.concatenate([each.inputs for each in recording.exposures()])
    np.testing.assert_array_equal(inputs, np.repeat(commands[[0, 2]], [30, 110], axis=0))
    assert "1 command before the first exposure and 1 after the last left out" in account.notes
    assert "1 command left out: the next one came in the same fast step" in account.notes


def test_commands_by_their_loops_rate(tmp_path: Path) -> None:
    commands = np.arange(280.0).reshape(140, 2)
    path = others.write_aot(tmp_path / "a.fits", FRAMES, commands=commands, framerate=1000.0)
    recording, _ = imported(path, small_rig(20, 20))
    np.testing.assert_array_equal(np.concatenate([each.inputs for each in recording.exposures()]), commands)


def test_commands_faster_than_the_rigs_steps_are_refused(tmp_path: Path) -> None:
    path = others.write_aot(tmp_path / "a.fits", FRAMES, commands=np.ones((280, 2)), framerate=2000.0)
    with pytest.raises(
        ImportingError, match=r"has a command every 0\.0005 s, the rig file .* a fast step every 0\.001 s"
    ):
        imported(path, small_rig(20, 20))


@pytest.mark.slow
def test_commands_wait_for_their_loops_delay(tmp_path: Path) -> None:
    commands = np.arange(14.0).reshape(7, 2)
    others.write_aot(tmp_path / "b.fits", FRAMES, commands=commands)
    system = aotpy.AOSystem.read_from_file(tmp_path / "b.fits")
    system.loops[0].delay = 1.5
    system.write_to_file(str(tmp_path / "a.fits"))
    rig = small_rig(20, 20)
    recording, account = imported(tmp_path / "a.fits", rig)
    inputs = np.concatenate([each.inputs for each in recording.exposures()])
    np.testing.assert_array_equal(inputs[:30], np.tile(rig.mirror.park, (30, 1)))
    np.testing.assert_array_equal(inputs[30:], np.repeat(commands, 20, axis=0)[:110])
    assert any("from its picture on, 1.5 frames later" in note for note in account.notes)
