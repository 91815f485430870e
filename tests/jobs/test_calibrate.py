"""Calibration: the truth of simulated cameras within its own standard deviations; frames that are refused."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import tomllib
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from aolink.calibration import Calibration, Frames, Kind, Measured, calibrate, calibrated_text
from aolink.calibration.measure import pixel_statistics
from aolink.errors import CalibrationError
from aolink.optics.sensor import Kernel
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig, parse_light, parse_rig
from aolink.session import record
from aolink.simulation.model import RigPhysics
from tests.calibration.test_row_time import PERIOD_S, blinking
from tests.commands import simulated_rig

Run = Callable[..., subprocess.CompletedProcess[str]]
LIVELY = load_rig("section-vi-lively")
SEEDS = 60


def camera(photoelectrons: float, noise_density: float = 0.01, **sensor: Any) -> Rig:
    """A rig whose exposures take one fast step, which is quick to simulate and the same to a camera at rest."""
    timing = dataclasses.replace(LIVELY.timing, exposure_steps=1, frame_period_steps=1)
    noise: dict[str, Any] = {"photoelectrons": photoelectrons, "noise_density": noise_density}
    return dataclasses.replace(LIVELY, timing=timing, sensor=dataclasses.replace(LIVELY.sensor, **noise, **sensor))


def shoot(rig: Rig, seed: int, lights: str, frames: int = 100) -> tuple[list[Frames], float]:
    """Frames under one light after the other, and where the spot was under the last one."""
    row = parse_light(lights, "lights")
    rig = dataclasses.replace(rig, simulation=dataclasses.replace(rig.simulation, light=row))
    model, shot = RigPhysics(rig, seed), []
    for light in row:
        model.start_camera(model.step, frames)
        taken = model.advance(np.zeros((frames * rig.timing.frame_period_steps, 1)))
        kind: Kind = "still" if light.kind == "moving" else light.kind
        shot.append(Frames(kind=kind, counts=np.array([f.pixels[0] for f in taken]), source=f"{kind}.mcap"))
    return shot, float(taken[0].truth.path[0, 0])


def pulls(rig: Rig, seed: int, lights: str) -> list[float]:
    """Error over standard deviation: black level, V, gain, counts per density, sigma, position."""
    shot, position = shoot(rig, seed, lights)
    found, sensor = calibrate(rig, shot), rig.sensor
    gain = sensor.counts_per_density / (sensor.photoelectrons * sensor.pixel_width) if sensor.photoelectrons else 0.0
    assert found.gain is not None
    assert found.counts_per_density is not None
    assert found.kernel_sigma is not None
    assert found.spot is not None
    pairs = [
        (found.black_level, sensor.black_level),
        (found.noise_density, sensor.noise_density),
        (found.gain, gain),
        (found.counts_per_density, sensor.counts_per_density),
        (found.kernel_sigma, sensor.kernel.sigma),
        (Measured(found.spot.positions[0], found.spot.position_sds[0]), position),
    ]
    return [(measured.value - true) / measured.sd for measured, true in pairs]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("photoelectrons", "noise_density", "lights"),
    [
        (0, 0.01, "dark,still"),
        (0, 0.1, "dark,flat:4,still"),
        (1000, 0.01, "dark,still"),
        (300, 0.001, "dark,flat:4,flat:8,still"),
        (20_000, 0.0001, "dark,flat:4,still"),
    ],
)
def test_the_truth_is_found_and_the_standard_deviations_are_right(
    photoelectrons: float, noise_density: float, lights: str
) -> None:
    rig = camera(photoelectrons, noise_density)
    table = np.array([pulls(rig, seed, lights) for seed in range(SEEDS)])
    assert np.abs(table).max() < 4.5
    assert np.abs(table.mean(axis=0)).max() < 4 / np.sqrt(SEEDS)
    # Sums of squares of 60 unit normals: outside of these bounds with probability 1e-4.
    squares = (table**2).sum(axis=0)
    assert squares.min() > 25
    assert squares.max() < 112


@pytest.mark.slow
def test_the_chi_square_of_a_gaussian_spot_is_that_of_its_freedom() -> None:
    fits = [calibrate(camera(1000), shoot(camera(1000), seed, "dark,flat:8,still")[0]).spot for seed in range(SEEDS)]
    total, freedom = sum(f.chi_square for f in fits if f), sum(f.freedom for f in fits if f)
    assert abs(total - freedom) < 5 * np.sqrt(2 * freedom)
    assert all(f and f.gaussian for f in fits)


def test_photoelectrons_are_those_of_the_whole_spot() -> None:
    for seed in range(10):
        found = calibrate(camera(1000), shoot(camera(1000), seed, "dark,flat:4,flat:10,still")[0]).photoelectrons
        assert found is not None
        assert abs(found.value - 1000) < 4 * found.sd < 400


def test_several_still_spots_are_fitted_together() -> None:
    rig, shot = camera(0), [shoot(camera(0), seed, "dark,still")[0] for seed in range(4)]
    one = calibrate(rig, shot[0])
    four = calibrate(rig, [shot[0][0], *(each[1] for each in shot)])
    assert one.kernel_sigma is not None
    assert four.kernel_sigma is not None
    assert four.spot is not None
    assert len(four.spot.positions) == 4
    assert abs(four.kernel_sigma.value - 0.05) < 4 * four.kernel_sigma.sd
    assert four.kernel_sigma.sd < 0.8 * one.kernel_sigma.sd


def test_successive_differences_give_the_variance_and_how_well() -> None:
    rng = np.random.default_rng(3)
    pattern, drift = rng.normal(0, 500, 4000), np.linspace(0, 60, 25)[:, None]
    counts = np.rint(20_000 + pattern + drift + rng.normal(0, 40, (25, 4000))).astype(np.uint16)
    for steady in (True, False):
        found = pixel_statistics([counts], steady=steady)
        assert found.variance.mean() == pytest.approx(1600, rel=0.02)
        assert (found.variance / 1600).var() == pytest.approx(found.spread, rel=0.1)


def changed(shot: list[Frames], change: Callable[[Kind, NDArray[np.float64]], NDArray[np.float64]]) -> list[Frames]:
    return [
        dataclasses.replace(
            f, counts=np.clip(np.rint(change(f.kind, f.counts.astype(np.float64))), 0, 65535).astype(np.uint16)
        )
        for f in shot
    ]


ALL = "dark,flat:4,flat:8,still"


def assert_true(found: Calibration, rig: Rig, *, skip: str = "") -> None:
    truth = {"noise_density": 0.001, "counts_per_density": 2000, "photoelectrons": 1000, "kernel.sigma": 0.05}
    for name, true in truth.items():
        if name != skip:
            value = found.values[f"sensor.{name}"]
            assert abs(value.value - true) < 4 * value.sd, name


def test_hot_pixels_are_left_out_and_named() -> None:
    def heat(kind: Kind, counts: NDArray[np.float64]) -> NDArray[np.float64]:
        counts[:, 7] += 9000
        counts[:, 30] = 65535
        return counts

    rig = camera(1000, 0.001)
    found = calibrate(rig, changed(shoot(rig, 1, ALL)[0], heat))
    assert found.hot_pixels == (7, 30)
    text = calibrated_text(LIVELY.toml, LIVELY, found, ["dark a sha256:1"])
    assert parse_rig(text).sensor.defects == ((0, 7), (0, 30))
    assert calibrated_text(text, parse_rig(text), found, ["dark a sha256:1"]) == text
    assert_true(found, rig)


def test_a_fixed_pattern_does_not_become_noise() -> None:
    rig, pattern = camera(1000, 0.001), np.random.default_rng(5).normal(0, 300, 40)
    found = calibrate(rig, changed(shoot(rig, 1, ALL)[0], lambda kind, counts: counts + pattern))
    assert any("fixed pattern" in note for note in found.notes)
    assert_true(found, rig)
    assert found.spot is not None
    assert found.spot.gaussian


def test_a_flat_that_flickers_does_not_become_shot_noise() -> None:
    rig, flicker = camera(1000, 0.001), np.random.default_rng(6).normal(1, 0.1, (100, 1))
    shot = changed(shoot(rig, 1, ALL)[0], lambda k, c: c if k != "flat" else 20_000 + (c - 20_000) * flicker)
    assert_true(calibrate(rig, shot), rig)


def test_a_spot_that_flickers_is_said_so() -> None:
    rig, flicker = camera(1000, 0.001), np.random.default_rng(6).normal(1, 0.15, (100, 1))
    shot = changed(shoot(rig, 1, ALL)[0], lambda k, c: c if k != "still" else 20_000 + (c - 20_000) * flicker)
    assert any("the light of the spot flickers by 1" in note for note in calibrate(rig, shot).notes)


def test_a_kernel_that_is_not_gaussian_is_said_so_and_its_total_is_right() -> None:
    rig = camera(1000, 0.001)
    ghost = changed(shoot(rig, 1, ALL)[0], lambda k, c: c if k != "still" else c + 0.3 * np.roll(c - 20_000, 3, axis=1))
    found = calibrate(rig, ghost)
    assert found.spot is not None
    assert not found.spot.gaussian
    assert any("the spot is not a Gaussian: chi-square" in note for note in found.notes)
    assert found.counts_per_density is not None
    assert abs(found.counts_per_density.value - 2600) < 4 * found.counts_per_density.sd < 400


def test_a_spot_within_a_pixel_keeps_the_width_of_the_file() -> None:
    rig = camera(0, 0.01, kernel=Kernel(shape="gaussian", sigma=0.005))
    shots = (shoot(rig, seed, "dark,still") for seed in range(99))
    shot = next(frames for frames, position in shots if abs((position / 0.05) % 1 - 0.5) < 0.2)
    found = calibrate(rig, shot)
    assert found.kernel_sigma is None
    assert any("too narrow for the pixels to show its width" in note for note in found.notes)


def test_a_camera_without_noise_is_said_to_hide_it() -> None:
    rig = camera(0, 1e-10)
    found = calibrate(rig, shoot(rig, 1, "dark,flat:4,still")[0])
    assert found.noise_density.value < 1e-6
    assert any("the read noise is under half a count" in note for note in found.notes)
    assert found.counts_per_density is not None
    assert found.counts_per_density.value == pytest.approx(2000, rel=1e-3)


def test_what_was_not_shown_is_not_known_and_said_so() -> None:
    rig = camera(1000)
    dark, flat, still = shoot(rig, 2, "dark,flat:8,still")[0]
    assert set(calibrate(rig, [dark]).values) == {"sensor.black_level", "sensor.noise_density"}
    assert "without a still spot, counts_per_density and kernel.sigma stay" in calibrate(rig, [dark]).notes[0]
    assert "without flat or still frames, photoelectrons stays" in calibrate(rig, [dark]).notes[1]
    assert set(calibrate(rig, [dark, flat]).values) == {
        "sensor.black_level", "sensor.noise_density", "sensor.photoelectrons",
    }  # fmt: skip
    alone = calibrate(rig, [dark, still])
    assert len(alone.values) == 5
    assert "photoelectrons comes from the still spot's own pixels" in alone.notes[0]


def test_shot_noise_that_is_not_seen_takes_only_an_impossible_value_out() -> None:
    shot = shoot(camera(0), 1, "dark,flat:8,still")[0]
    for photoelectrons, expected in ((0.0, None), (1e9, None), (10.0, 0.0)):
        found = calibrate(camera(photoelectrons), shot).photoelectrons
        assert (found and found.value) == expected


def relabelled(lights: str, *kinds: Kind) -> list[Frames]:
    shot = shoot(camera(1000), 4, lights, 40)[0]
    return [dataclasses.replace(f, kind=kind, source=f"{kind}.mcap") for f, kind in zip(shot, kinds, strict=True)]


@pytest.mark.parametrize(
    ("lights", "kinds", "message"),
    [
        ("flat:4,still", ("flat", "still"), "no dark frames"),
        ("still", ("dark",), "light on pixels"),
        ("dark,still", ("dark", "flat"), "differ"),
        ("dark,dark", ("dark", "flat"), "no brighter"),
        ("flat:4,dark", ("dark", "flat"), "no brighter"),
        ("dark,flat:4", ("dark", "still"), "everywhere"),
        ("dark,dark", ("dark", "still"), "there is none"),
        ("dark,flat:40", ("dark", "flat"), "saturated"),
    ],
)
def test_frames_that_are_not_what_they_are_said_to_be(lights: str, kinds: tuple[Kind, ...], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        calibrate(camera(1000), relabelled(lights, *kinds))


@pytest.mark.slow
def test_a_spot_that_moves_is_refused() -> None:
    for name, seed in product(("section-vi", "section-vi-lively"), range(3)):
        rig = load_rig(name)
        rig = dataclasses.replace(rig, sensor=dataclasses.replace(rig.sensor, noise_density=0.01))
        with pytest.raises(CalibrationError, match="moves"):
            calibrate(rig, shoot(rig, seed, "dark,moving", 40)[0])


def test_too_few_frames_and_a_low_black_level() -> None:
    with pytest.raises(CalibrationError, match="at least 10"):
        calibrate(camera(0), shoot(camera(0), 1, "dark", 9)[0])
    low = camera(0, black_level=500)
    with pytest.raises(CalibrationError, match="at zero"):
        calibrate(low, shoot(low, 1, "dark")[0])


def test_a_spot_beside_the_sensor_is_refused() -> None:
    rig = camera(0)
    _, position = shoot(rig, 1, "still", 10)
    for shift in (0.0, 0.04):
        rig = camera(0, field=(position - shift, position - shift + 2))
        with pytest.raises(CalibrationError, match="edge"):
            calibrate(rig, shoot(rig, 1, "dark,still")[0])


def test_a_dark_level_that_has_moved_is_refused() -> None:
    shot = shoot(camera(0), 1, "dark,still")[0]
    brighter = changed(shot, lambda kind, counts: counts + 1000 * (kind == "dark"))
    darker = changed(shot, lambda kind, counts: counts - 1000 * (kind == "dark"))
    for moved, what in ((brighter, "less than the dark"), (darker, "light everywhere")):
        with pytest.raises(CalibrationError, match=what):
            calibrate(camera(0), moved)


# The text of the rig file.


@cache
def found() -> Calibration:
    return calibrate(camera(1000), shoot(camera(1000), 1, ALL)[0])


@pytest.mark.parametrize(
    "text",
    [
        LIVELY.toml,
        LIVELY.toml.replace("\n", "\r\n"),
        LIVELY.toml.replace("[sensor]", "# black_level = 3\n[sensor] # sigma = 0.05").replace("sigma =", '"sigma"='),
    ],
    ids=["as it is", "line ends", "quotes and comments"],
)
def test_only_the_values_change(text: str) -> None:
    new = calibrated_text(text, parse_rig(text), found(), ["dark dark.mcap sha256:00"])
    before, after = tomllib.loads(text), tomllib.loads(new)
    assert after.pop("calibration")["sources"] == ["dark dark.mcap sha256:00"]
    for key, value in found().values.items():
        *path, name = key.removeprefix("sensor.").split(".")
        for side in (before, after):
            section = side["sensor"][path[0]] if path else side["sensor"]
            written = section.pop(name, None)
        assert abs(written - value.value) <= 0.02 * value.sd
    assert after == before
    kept = [line for line in text.splitlines() if "=" not in line.partition("#")[0]]
    assert [each for each in new.splitlines() if each in kept][: len(kept)] == kept
    assert new.count("\r\n") in (0, new.count("\n"))
    assert calibrated_text(new, parse_rig(new), found(), ["dark dark.mcap sha256:00"]) == new


def test_the_calibration_is_in_the_rig_and_what_was_not_measured_again_stays() -> None:
    text = calibrated_text(LIVELY.toml, LIVELY, found(), ["dark a sha256:1", "flat b sha256:2", "still c sha256:3"])
    rig = parse_rig(text + "\n# the end\n")
    assert rig.calibration is not None
    assert (rig.calibration.dark_frames, rig.calibration.flat_frames, rig.calibration.still_frames) == (100, 200, 100)
    sigma = found().kernel_sigma
    assert sigma is not None
    assert rig.calibration.kernel_sigma_sd == pytest.approx(sigma.sd, rel=0.01)
    dark = calibrate(rig, shoot(camera(1000), 2, "dark")[0])
    again = calibrated_text(rig.toml, rig, dark, ["dark d sha256:4"])
    table = parse_rig(again).calibration
    assert table is not None
    assert table.kernel_sigma_sd == rig.calibration.kernel_sigma_sd
    assert table.black_level_sd != rig.calibration.black_level_sd
    assert table.sources == ("flat b sha256:2", "still c sha256:3", "dark d sha256:4")
    assert again.endswith("\n\n# the end\n")


def test_a_calibration_in_one_line_stays_in_one_line() -> None:
    text = f"calibration = {{ dark_frames = 3 }}  # mine\n{LIVELY.toml}"
    new = calibrated_text(text, parse_rig(text), found(), ["dark dark.mcap sha256:00"])
    first, rest = new.split("\n", 1)
    assert first.startswith("calibration = { dark_frames = 100")
    assert first.endswith("}  # mine")
    assert rest == calibrated_text(LIVELY.toml, LIVELY, found(), []).split("\n[calibration]")[0]


# The command line, over real pseudo terminals.

TRUE = LIVELY.toml.replace("photoelectrons = 0 ", "photoelectrons = 500 ").replace(
    "exposure_steps = 200", "exposure_steps = 20"
)
WRONG = (
    TRUE.replace("black_level = 20000", "black_level = 15000").replace("noise_density = 0.01", "noise_density = 0.5")
    .replace("counts_per_density = 2000", "counts_per_density = 700").replace("sigma = 0.05", "sigma = 0.2")
)  # fmt: skip


def assert_calibrated(path: Path) -> None:
    rig, truth = load_rig(path), parse_rig(TRUE).sensor
    table = rig.calibration
    assert table is not None
    for value, true, sd in (
        (rig.sensor.black_level, truth.black_level, table.black_level_sd),
        (rig.sensor.noise_density, truth.noise_density, table.noise_density_sd),
        (rig.sensor.counts_per_density, truth.counts_per_density, table.counts_per_density_sd),
        (rig.sensor.photoelectrons, truth.photoelectrons, table.photoelectrons_sd),
        (rig.sensor.kernel.sigma, truth.kernel.sigma, table.kernel_sigma_sd),
    ):
        assert sd is not None
        assert abs(value - true) < 4.1 * sd


@pytest.mark.slow
def test_the_device_form_asks_records_and_writes_the_rig_file(aolink: Run, tmp_path: Path) -> None:
    (tmp_path / "true.toml").write_text(TRUE)
    (tmp_path / "my.toml").write_text(WRONG)
    arguments = ["--rig", "my.toml", "-o", "out.toml", "--measure", "frames:count=60"]
    with simulated_rig(tmp_path / "true.toml", "--light", "dark,flat:4,flat:8,still") as (camera_port, mirror_port):
        devices = ["--camera", camera_port, "--mirror", mirror_port]
        result = aolink("calibrate", *devices, *arguments, input="\n\n\n\n")
    assert result.returncode == 0, result.stderr
    assert "dark: cover the camera, then press Enter: flat: " in result.stderr
    assert "Calibration from frames: 60 dark, 120 flat, 60 still" in result.stdout
    assert_calibrated(tmp_path / "out.toml")
    assert (tmp_path / "my.toml").read_text() == WRONG

    files = [tmp_path / "out-frames" / f"{name}.mcap" for name in ("dark", "flat-1", "flat-2", "still")]
    assert [Recording(path).metadata["calibration"] for path in files] == ["dark", "flat", "flat", "still"]
    inputs = np.concatenate([exposure.inputs for exposure in Recording(files[3]).exposures()])
    assert np.ptp(inputs) == 0

    again = aolink("calibrate", *files, "--rig", "my.toml", "-o", "again.toml", "--json")
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "again.toml").read_text() == (tmp_path / "out.toml").read_text()
    assert '"sensor.black_level": {"file": 15000.0' in again.stdout
    refused = aolink("calibrate", *files, "--rig", "my.toml", "-o", "again.toml")
    assert (refused.returncode, "again.toml exists and is not overwritten" in refused.stderr) == (1, True)
    assert aolink("calibrate", *files, "--rig", "my.toml", "-o", "again.toml", "--overwrite").returncode == 0
    aside = aolink("calibrate", *files, "--rig", "section-vi", "-o", "c.toml")
    assert aside.returncode == 8
    assert "dark.mcap is of another rig: its timing.exposure_steps is 20, the rig file has 200" in aside.stderr


@pytest.mark.slow
def test_kinds_can_be_skipped_and_nobody_there_is_an_error(aolink: Run, tmp_path: Path) -> None:
    (tmp_path / "true.toml").write_text(TRUE)
    common = ["--rig", "true.toml", "--measure", "frames:count=40"]
    with simulated_rig(tmp_path / "true.toml", "--light", "dark,still,dark") as (camera_port, mirror_port):
        devices = ["--camera", camera_port, "--mirror", mirror_port]
        result = aolink("calibrate", *devices, *common, "-o", "out.toml", input="\ns\n\n")
        assert result.returncode == 0, result.stderr
        assert "40 dark, 0 flat, 40 still" in result.stdout
        alone = aolink("calibrate", *devices, *common, "-o", "b.toml", input="\n")
        assert (alone.returncode, "nobody answers" in alone.stderr) == (8, True)
        few = aolink("calibrate", *devices, *common[:2], "-o", "b.toml", "--measure", "frames:count=3", input="\n\n")
        assert (few.returncode, "too few" in few.stderr) == (8, True)
        unlit = aolink("calibrate", *devices, *common, "-o", "b.toml", input="\n\n\n\n")
        assert (unlit.returncode, "b-frames/dark.mcap exists" in unlit.stderr) == (1, True)
        common += ["--overwrite"]
        unlit = aolink("calibrate", *devices, *common, "-o", "b.toml", input="\n\n\n\n")
        assert unlit.returncode == 8
        refused, _, kept = unlit.stderr.rpartition("; `aolink calibrate` takes what was recorded: ")
        assert "no brighter" in refused
        # Whoever covered and lit the camera need not do it again.
        assert [Path(each).stem for each in kept.split()] == ["dark", "flat-1", "flat-2", "still"]
        again = aolink("calibrate", kept.split()[0], *common[:2], "-o", "dark.toml")
        assert again.returncode == 0, again.stderr
    nowhere = aolink("calibrate", "--camera", "x", "--mirror", "x", *common, "-o", "no/b.toml")
    assert (nowhere.returncode, "no folder" in nowhere.stderr) == (1, True)
    assert not (tmp_path / "b.toml").exists()
    assert aolink("calibrate", *common[:2], "-o", "b.toml").returncode == 2


@pytest.mark.slow
def test_nobody_is_asked_for_anything_before_the_ports_are_tried(aolink: Run, tmp_path: Path) -> None:
    arguments = ["--rig", "section-vi", "-o", "out.toml"]
    with simulated_rig("section-vi") as (camera, mirror):
        for ports, message in (
            ((camera, "/dev/nowhere"), "there is no port /dev/nowhere"),
            ((mirror, camera), "the device on the camera port is a mirror"),
        ):
            result = aolink("calibrate", "--camera", ports[0], "--mirror", ports[1], *arguments, input="\n")
            assert result.returncode in (3, 4)
            assert result.stderr.startswith(f"aolink: {message}"), result.stderr
    assert not [*tmp_path.glob("*/*")]


@pytest.mark.slow
def test_frames_are_recorded_apart_and_marked(aolink: Run, tmp_path: Path) -> None:
    rig = load_rig("section-vi-lively")
    with simulated_rig("section-vi-lively", "--light", "dark") as ports:
        result = aolink(
            "record", "--camera", ports[0], "--mirror", ports[1], "--rig", "section-vi-lively", "--calibration", "dark",
            "--exposures", "12", "-o", "dark.mcap",
        )  # fmt: skip
        record(rig, *ports, tmp_path / "plain.mcap", exposures=2)
    assert result.returncode == 0, result.stderr
    assert Recording(tmp_path / "dark.mcap").metadata["calibration"] == "dark"
    assert "calibration" not in Recording(tmp_path / "plain.mcap").metadata
    assert aolink("calibrate", "dark.mcap", "--rig", "section-vi-lively", "-o", "out.toml").returncode == 0
    plain = aolink("calibrate", "plain.mcap", "--rig", "section-vi-lively", "-o", "b.toml")
    assert plain.returncode == 8
    assert "not marked" in plain.stderr


@pytest.mark.slow
def test_a_mirror_is_poked_no_faster_than_its_rig_file_allows(aolink: Run, tmp_path: Path) -> None:
    toml = load_rig("tip-tilt").toml
    for old, new in (
        ("dac_bits = 16", "dac_bits = 16\nslew_max_per_s = 20.0"),
        ("amplitude = [0.20, 0.12]", "amplitude = [0.01, 0.01]"),  # of a vibration that the pokes' rhythm would alias
    ):
        assert old in toml
        toml = toml.replace(old, new)
    (tmp_path / "slow.toml").write_text(toml)
    how = "interaction:poke=0.25,repeats=2,hold_s=0.1"
    arguments = ("calibrate", "--measure", how, "--rig", "slow.toml", "-o", "matrix.npz", "--json")
    with simulated_rig(tmp_path / "slow.toml") as (camera, mirror):
        done = aolink(*arguments, "--camera", camera, "--mirror", mirror)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["exposures"] == 8  # of two that each of eight pokes has rested for, the second
    assert facts["difference_from_plant"] < 0.08
    rig = load_rig(tmp_path / "slow.toml")
    held = np.concatenate([each.inputs for each in Recording(tmp_path / "matrix-frames" / "pokes.mcap").exposures()])
    step = (rig.mirror.input_max - rig.mirror.input_min) / 65535
    assert (np.abs(np.diff(held, axis=0)) <= 20.0 * rig.timing.fast_step_s + step).all()
    assert held.max() == pytest.approx(0.5, abs=1e-4)


@pytest.mark.slow
def test_a_mirror_is_poked_for_its_interaction_matrix(aolink: Run, tmp_path: Path) -> None:
    """Recorded over the wire, and compared with the plant of the rig file, which is that of the simulated rig."""
    arguments = ("calibrate", "--measure", "interaction:poke=0.25,repeats=6", "--rig", "tip-tilt")
    with simulated_rig("tip-tilt") as (camera, mirror):
        done = aolink(*arguments, "--camera", camera, "--mirror", mirror, "-o", "matrix.npz", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    rig = load_rig("tip-tilt")
    assert (facts["outputs"], facts["inputs"]) == (rig.n_outputs, rig.n_inputs)
    assert facts["difference_from_plant"] < 2 * facts["noise"] < 0.5
    with np.load(tmp_path / "matrix.npz") as found:
        assert found["matrix"].shape == (rig.n_outputs, rig.n_inputs)
        apart = np.linalg.norm(found["matrix"] - found["plant_matrix"]) / np.linalg.norm(found["matrix"])
    assert apart == pytest.approx(facts["difference_from_plant"])
    again = aolink(*arguments, "matrix-frames/pokes.mcap", "-o", "again.npz")
    assert again.returncode == 0, again.stderr
    assert "written: again.npz" in again.stdout
    for wrong, what in (
        (("--rig", "section-vi", "matrix-frames/pokes.mcap", "-o", "b.npz"), "needs a sensor of kind 'spots'"),
        (("--rig", "tip-tilt", "matrix-frames/pokes.mcap", "-o", "b.toml"), ".npz"),
    ):
        refused = aolink("calibrate", "--measure", "interaction", *wrong)
        assert refused.returncode == 8
        assert what in refused.stderr


def test_a_film_of_blinking_light_gives_the_row_time(aolink: Run, tmp_path: Path) -> None:
    """Its value and its standard deviation are written into the rig file, comments and all else stay."""
    film = np.maximum(blinking(-1.7e-4, 197.0, 5), 0)[:, :, None].repeat(40, axis=2)
    np.savez(tmp_path / "film.npz", frames=film.astype(np.uint16), rate_hz=1 / PERIOD_S)
    made = aolink("calibrate", "film.npz", "--measure", "row-time:blink_hz=197", "--rig", "sh-4x4", "-o", "out.toml")
    assert (made.returncode, made.stderr) == (0, "")
    text = (tmp_path / "out.toml").read_text()
    assert parse_rig(text).sensor.row_time_s == pytest.approx(-1.7e-4, rel=5e-3)
    (line,) = (each for each in text.splitlines() if each.startswith("row_time_s"))
    assert "# +- " in line
    assert "30 frames of film.npz" in line
    assert [each for each in text.splitlines() if each != line] == load_rig("sh-4x4").toml.splitlines()
    again = aolink("calibrate", "film.npz", "--measure", "row-time:blink_hz=210", "--rig", "sh-4x4", "-o", "b.toml")
    assert again.returncode != 0
    assert "in step" in again.stderr
    assert not (tmp_path / "b.toml").exists()


@pytest.mark.parametrize(
    ("measure", "says"),
    [
        ("light", "--measure light is none of frames, interaction, row-time"),
        ("frames:poke=1", "--measure frames has no option poke: it has count"),
        ("frames:count=2.5", "--measure frames: give count a whole number from 1 to 1e+06"),
        ("interaction:poke=x", "--measure interaction: poke=x is no number"),
        ("row-time", "--measure row-time: give blink_hz a number from 0.001 to 1e+06"),
    ],
)
def test_what_cannot_be_measured_is_said(aolink: Run, measure: str, says: str) -> None:
    refused = aolink("calibrate", "film.npz", "--measure", measure, "--rig", "sh-4x4", "-o", "out.toml")
    assert refused.returncode == 2
    assert says in " ".join(refused.stderr.replace("│", " ").split())
