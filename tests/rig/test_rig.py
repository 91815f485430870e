"""The rig file is validated whole: what is wrong is one message that names the key."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.errors import RigError
from aolink.rig import CalibrationTable, builtin_rigs, load_rig, parse_rig
from aolink.rig.edit import with_value

TEXT = load_rig("section-vi").toml
A = "[[1.0000, 0.0010], [-0.0197, 0.9704]]"


def changed(old: str, new: str) -> str:
    assert TEXT.count(old) == 1, old
    return TEXT.replace(old, new)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('name = "section-vi"', "", "name is missing"),
        ("[timing]", "[timing]\nspeed = 3", r"timing.speed is not a key that aolink knows; known here: exp"),
        ("[plant]", "[colour]\nx = 1\n[plant]", "colour is not a key that aolink knows"),
        (A, "[[1.0, 0.001]]", "plant.A has shape 1 x 2, expected a square matrix"),
        (A, "[[1.0, 0.001], [1.0]]", "plant.A: expected numbers in rows of equal"),
        ('kind = "line"', "", "sensor.kind is missing: use one of line, spots"),
        ("[simulation]", "[devices]\ncamera = 3\n[simulation]", "devices.camera: expected a table, found 3"),
        ("[simulation]", "[[disturbance.model]]\n[simulation]", r"model\[0\].kind is missing: use one of resonance"),
        ("[simulation]", "[disturbance]\nmodel = [1]\n[simulation]", r"disturbance.model\[0\]: expected a table"),
        (A, '[["1", 0], [0, 1]]', r"plant.A: expected numbers in rows of equal length, found \[\['1', 0"),
        ("process_noise = 0.1", 'process_noise = "0.1"', "plant.process_noise: expected numbers .* found '0.1'"),
        ("process_noise = 0.1", "process_noise = true", "plant.process_noise: expected numbers .* found True"),
        ("field = [-1.0, 1.0]", 'field = "wide"', "sensor.field: expected numbers in rows of equal length, found"),
        ("bit_depth = 16", 'bit_depth = "16"', "sensor.bit_depth: expected a whole number, found '16'"),
        ("photoelectrons = 0 ", "read_noise_counts = 1 ", "sensor has more than one of noise_density, read_noise_c"),
        (A, "[[1.0, 0.1], [0.1, 0.9]]", "plant.A is unstable: .* modulus 1.06"),
        (A, "[[1.0, 0.001], [0.0, 0.9]]", "plant.initial_covariance is missing"),
        ("B = [[0.0], [1.0]]", "B = [[1.0]]", "plant.B has shape 1 x 1, expected 2 x any"),
        ("C = [[1.0, 0.0]]", "C = [[0.0, 0.0]]", "plant.C is zero: .* nothing is observable"),
        ("C = [[1.0, 0.0]]", "C = [[1.0, nan]]", "plant.C holds a number that is not finite"),
        ("C = [[1.0, 0.0]]", "C = [[1.0, 0.0], [0.0, 1.0]]", "sensor.kind = 'line' sees one slope, but the plant"),
        ("process_noise = 0.1", "process_noise = -0.1", "plant.process_noise has the negative eigenvalue -0.1"),
        ("fast_step_s = 0.001", "fast_step_s = 0", "timing.fast_step_s = 0 must be at least"),
        ("fast_step_s = 0.001", 'fast_step_s = "fast"', "timing.fast_step_s: expected a finite number, found 'fast'"),
        ("exposure_steps = 200", "exposure_steps = 2.5", "timing.exposure_steps: expected a whole number"),
        ("exposure_steps = 200", "exposure_steps = 200\nframe_period_steps = 100", "timing.frame_period_steps = 100"),
        ('kind = "line"', 'kind = "square"', "sensor.kind = 'square' is not known: use one of line"),
        ("field = [-1.0, 1.0]", "field = [1.0, -1.0]", "the lower edge must be below the upper one"),
        ("field = [-1.0, 1.0]", "field = [1.0]", "sensor.field has shape 1, expected 2"),
        ("sigma = 0.05", "sigma = true", "sensor.kernel.sigma: expected a finite number, found True"),
        ("black_level = 20000", "black_level = 70000", "sensor.black_level = 70000 is not below the full"),
        ("block_steps = 50", "block_steps = 5000", "mirror.block_steps = 5000 does not fit into one packet"),
        ("block_steps = 50", "block_steps = 50\nqueue_steps = 60", "mirror.queue_steps = 60 must hold at least"),
        ("dac_bits = 16", "dac_bits = 16\npark = 1.0", "mirror.park is outside mirror.input_min .. mirror.input_max"),
        ("input_max = 0.05", "input_max = -0.06", "mirror.input_min must be below mirror.input_max"),
        ("amplitude = 0.0109", "amplitude = 0.06", "drive.amplitude and drive.offset reach beyond mirror.input_"),
        ("amplitude = 0.0109", "", "drive.amplitude is missing"),
        ("[simulation]", "[simulation.faults]\nbit_flip_rate = 2\n[simulation]", "simulation.faults.bit_flip_rate = 2"),
        ("photoelectrons = 0 ", "photoelectrons = -1 ", "sensor.photoelectrons = -1 must be at least 0"),
        ("[simulation]", '[simulation]\nlight = "dim"', "simulation.light: 'dim' is not known: use dark, flat"),
        ("[simulation]", '[simulation]\nlight = "dark:3"', "simulation.light: 'dark:3' is not known"),
        ("[simulation]", '[simulation]\nlight = "flat:x"', "simulation.light: the density of 'flat:x' must be a"),
        ("[simulation]", "[calibration]\nsd = 1\n[simulation]", "calibration.sd is not a key that aolink knows"),
        ("[simulation]", "[calibration]\nkernel_sigma_sd = -1\n[simulation]", "calibration.kernel_sigma_sd = -1 must"),
        ("[simulation]", "[calibration]\ndark_frames = 0.5\n[simulation]", "calibration.dark_frames: expected a whole"),
        ("[simulation]", "[calibration]\nsources = [1]\n[simulation]", r"sources\[0\]: expected text, found 1"),
        ("[simulation]", "[simulation", "not valid TOML"),
    ],
)
def test_what_is_wrong_is_named(old: str, new: str, message: str) -> None:
    with pytest.raises(RigError, match=message) as caught:
        parse_rig(changed(old, new))
    assert "\n" not in str(caught.value)


SPOTS = load_rig("sh-4x4").toml


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("axes = 32", "axes = 16", r"sensor.grid = \[4, 4\] sees 32 slopes, two a spot, but the plant has 16 "),
        ("grid = [4, 4]", "grid = [4]", r"sensor.grid: expected a list of 2, found \[4\]"),
        ("grid = [4, 4]", "grid = [4, 0]", r"sensor.grid\[1\] = 0 must be at least 1"),
        ("grid = [4, 4]", "grid = 16", "sensor.grid: expected a list of 2, found 16"),
        ("grid = [4, 4]", "grid = [4, 4.0]", r"sensor.grid\[1\]: expected a whole number, found 4.0"),
        ("grid = [4, 4] ", "", "sensor.grid is missing"),
        ("window = [24, 24]", "window = [24, 16]", r"sensor.window = \[24, 16\] is not square"),
        ("window = [24, 24]", "window = [24, 24]\npixels = 24", "sensor.pixels is not a key that aolink knows; known"),
        ("C = [[1.0, 0.0]]", "C = [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]", "sees 32 slopes, .* but the plant has 96"),
        ("field = [-1.0, 1.0]", "field = [1.0, -1.0]", "the lower edge must be below the upper one"),
        ("black_level = 500", "black_level = 4095", "sensor.black_level = 4095 is not below the full scale, 4095"),
        ('kind = "spots"', 'kind = "line"', "sensor.pixels is missing: the rig file must give it"),
    ],
)
def test_what_is_wrong_with_a_sensor_of_spots_is_named(old: str, new: str, message: str) -> None:
    assert SPOTS.count(old) == 1, old
    with pytest.raises(RigError, match=message) as caught:
        parse_rig(SPOTS.replace(old, new))
    assert "\n" not in str(caught.value)


def test_copies_of_a_plant_move_whole_spots_or_single_slopes() -> None:
    three = SPOTS.replace("grid = [4, 4]", "grid = [1, 3]").replace("C = [[1.0, 0.0]]", "C = [[1, 0], [0, 1], [1, 1]]")
    with pytest.raises(RigError, match=r"plant\.C has 3 rows: for sensor.kind = 'spots' it needs one, or two for each"):
        parse_rig(three.replace("axes = 32", "axes = 2"))
    two = three.replace("C = [[1, 0], [0, 1], [1, 1]]", "C = [[1, 0], [0, 1]]").replace("axes = 32", "axes = 3")
    assert parse_rig(two).sensor.shape == (24, 72)


@pytest.mark.slow
@given(st.text())
def test_any_text_is_a_rig_or_one_error(text: str) -> None:
    with pytest.raises(RigError):
        parse_rig(text)


@pytest.mark.parametrize("name", builtin_rigs())
def test_the_rigs_that_come_along_are_good(name: str) -> None:
    rig = load_rig(name)
    assert rig.name == name
    assert len(rig.summary) > 80
    assert rig.digest == load_rig(f"{name}.toml").digest


def test_a_file_goes_before_a_name_and_is_named_in_errors(tmp_path: Path) -> None:
    path = tmp_path / "section-vi.toml"
    path.write_text(changed("seed = 1", "seed = 77"))
    assert load_rig(path).simulation.seed == 77
    path.write_text(changed("seed = 1", "seed = -1"))
    with pytest.raises(RigError, match=rf"{re.escape(str(path))}: simulation.seed"):
        load_rig(path)
    with pytest.raises(RigError, match=r"cannot read the rig file .*no.toml: No such file .* or one of: .*section-vi"):
        load_rig(tmp_path / "no.toml")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RigError, match="is not a rig file: it is not text"):
        load_rig(path)


def test_lights_and_calibration_are_read() -> None:
    text = changed(
        "[simulation]", '[calibration]\nblack_level_sd = 2\nsources = ["a"]\n[simulation]\nlight = "dark, flat:4"'
    )
    rig = parse_rig(text)
    assert [(light.kind, light.level) for light in rig.simulation.light] == [("dark", None), ("flat", 4.0)]
    assert rig.calibration == CalibrationTable(black_level_sd=2.0, sources=("a",))
    assert parse_rig(TEXT).calibration is None


def test_the_stationary_covariance_is_stationary() -> None:
    plant = load_rig("section-vi-lively").plant
    P = plant.initial_covariance
    W = plant.B_w @ plant.process_noise @ plant.B_w.T
    np.testing.assert_allclose(plant.A @ P @ plant.A.T + W, P, rtol=1e-9)


def test_the_converter_rounds_to_its_steps_and_keeps_the_limits() -> None:
    mirror = load_rig("section-vi").mirror
    u = np.linspace(mirror.input_min[0], mirror.input_max[0], 1001)[:, None]
    rounded = mirror.quantise(u)
    step = 0.1 / 65535
    assert np.abs(rounded - u).max() <= step / 2 * (1 + 1e-9)
    np.testing.assert_allclose((rounded + 0.05) / step, np.round((rounded + 0.05) / step), atol=1e-6)
    assert rounded[0, 0] == -0.05
    assert rounded[-1, 0] == pytest.approx(0.05, abs=1e-15)


@pytest.mark.slow
def test_check_says_what_is_wrong_and_what_is_lost(
    aolink: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    assert "the rig file is good" in aolink("rig", "section-vi", "--check").stdout
    (tmp_path / "far.toml").write_text(changed("field = [-1.0, 1.0]", "field = [-0.2, 0.2]"))
    result = aolink("rig", "far.toml", "--check")
    assert result.returncode == 2
    assert re.search(r"error +(drive.amplitude|sensor.field)", result.stdout), result.stdout
    refused = aolink("sim", "far.toml")
    assert refused.returncode == 2
    assert re.fullmatch(r"aolink: far.toml: (drive.amplitude|sensor.field): .*\n", refused.stderr), refused.stderr
    # An undamped mode at 10 Hz averages to nothing in 200 ms: the centroid loses it, the blur may not.
    omega = 2 * np.pi * 10 * 1e-3
    c, s = float(np.cos(omega)), float(np.sin(omega))
    lost = changed(A, f"[[{c}, {s}], [{-s}, {c}]]")
    lost = lost.replace("process_noise = 0.1 ", "initial_covariance = [[0.01, 0], [0, 0.01]]\nprocess_noise = 0.1 ")
    lost = lost.replace("amplitude = 0.0109", "amplitude = 0.0")
    (tmp_path / "lost.toml").write_text(lost)
    result = aolink("rig", "lost.toml", "--check")
    assert result.returncode == 0, result.stdout + result.stderr
    assert re.search(r"warning .*10(\.0+)? Hz", result.stdout), result.stdout
    assert "warning: timing.exposure_steps: the centroid" in aolink("sim", "lost.toml", "--listen", "nonsense").stderr


@pytest.mark.parametrize(
    ("name", "sigma", "message"),
    [
        ("single-lenslet", "[[0.1, 0.02], [0.02, 0.1]]", "each copy of the plant moves a spot along one direction"),
        ("section-vi", "[[0.1, 0.02], [0.02, 0.1]]", "a line sensor sees one direction: give a number"),
        ("single-lenslet", "[[0.1, 0.02], [0.03, 0.1]]", "must be symmetric and positive definite"),
        ("single-lenslet", "[[0.1, 0.2], [0.2, 0.1]]", "must be symmetric and positive definite"),
        ("single-lenslet", "[0.1, 0.02]", r"sensor.kernel.sigma has shape 2, expected 2 x 2"),
    ],
)
def test_a_kernel_that_cannot_be_is_refused(name, sigma, message):
    text = re.sub(r"\nsigma = [0-9.]+", f"\nsigma = {sigma}", load_rig(name).toml)
    with pytest.raises(RigError, match=message):
        parse_rig(text)


def test_a_kernel_on_a_plane_is_that_of_equation_4():
    text = load_rig("single-lenslet").toml
    for old, new in (
        ("axes = 2", "axes = 1"), ("C = [[1.0, 0.0]]", "C = [[1.0, 0.0], [0.5, 0.1]]"),
        ("amplitude = [0.0087, 0.0044]", "amplitude = 0.0087"), ("sigma = 0.1", "sigma = [[0.12, 0.03], [0.03, 0.08]]"),
    ):  # fmt: skip
        assert old in text
        text = text.replace(old, new)
    kernel = parse_rig(text).sensor.kernel
    width = np.array([[0.12, 0.03], [0.03, 0.08]])
    np.testing.assert_allclose(kernel.covariance, width @ width / 2)
    assert kernel.variance == pytest.approx(np.trace(kernel.covariance) / 2)


def test_a_row_of_inputs_and_their_limits_must_fit_into_a_message() -> None:
    text = load_rig("sh-4x4").toml.replace("axes = 32", "axes = 6272").replace("grid = [4, 4]", "grid = [56, 56]")
    text = text.replace("block_steps = 10 ", "")
    assert parse_rig(text).mirror.block_steps == 1
    text = text.replace("B = [[0.0], [1.0]]", "B = [[0.0, 0.0], [1.0, 1.0]]")
    with pytest.raises(RigError, match="the mirror has 12544 inputs"):
        parse_rig(text)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("section-vi", "[sensor.kernel]", "[sensor.kernal]", r"sensor.kernel is missing: you wrote kernal"),
        ("section-vi", "sigma =", "sigam =", r"sensor.kernel.sigam is not a key .* did you mean sigma\?"),
        ("section-vi", "field =", "feild =", r"sensor.field is missing: you wrote feild; did you mean field\?"),
        ("section-vi", "fast_step_s", "fast-step-s", "timing.fast_step_s is missing: you wrote fast-step-s; did you"),
        ("section-vi", "black_level", "blacklevel", r"blacklevel is not a key .*: you wrote .* mean black_level\?"),
        ("section-vi", "input_min", "input_mn", "mirror.input_min is missing: you wrote input_mn; did you mean input"),
        ("section-vi", "[sensor]", "[Sensor]", r"Sensor is not a key that aolink knows: .* did you mean sensor\?"),
        ("section-vi", "[drive]", "[drvie]", r"drvie is not a key .*: you wrote drvie; did you mean drive\?"),
        ("section-vi", "seed =", "sede =", r"simulation.sede is not a key .* did you mean seed\?"),
        ("sh-8x8", "[lenslets]", "[lenslet]", r"lenslet is not a key that aolink knows: .* did you mean lenslets\?"),
        ("sh-8x8", "pupil_m = 2.4e-3      # d", "pupl_m = 2.4e-3      # d", r"lenslets.pupl_m .* mean pupil_m\?"),
        ("sh-8x8", "wind_m_s", "wind_ms", r"disturbance.turbulence.layers\[0\].wind_m_s is missing: you wrote wind_ms"),
        ("sh-8x8", "tension_n_per_m", "tension_n_m", "plant.tension_n_per_m is missing: you wrote tension_n_m; did"),
        ("sh-8x8", "bias_v", "bias_V2", r"mirror.voltage.bias_v is missing: you wrote bias_V2; did you mean bias_v\?"),
        ("moving-scene", "pixel_scale", "pixel_scal", r"scene.pixel_scale is missing: .* did you mean pixel_scale\?"),
        ("tip-tilt", "frequency_hz", "frequncy_hz", r"vibration\[0\].frequency_hz is missing: you wrote frequncy_hz"),
    ],
)
def test_a_misspelt_key_is_named_with_the_one_that_was_meant(name: str, old: str, new: str, message: str) -> None:
    text = load_rig(name).toml
    assert old in text
    with pytest.raises(RigError, match=message):
        parse_rig(text.replace(old, new, 1))


def test_a_key_that_is_missing_is_not_taken_for_one_that_is_there() -> None:
    """input_max is like input_min, but no misspelling of it."""
    with pytest.raises(RigError, match=r"mirror.input_min is missing: the rig file must give it$"):
        parse_rig(changed("input_min = -0.05", ""))


@pytest.mark.parametrize("value", ["1" * 400, "1" * 5000, "[" * 5000])
def test_numbers_and_nesting_beyond_what_can_be_read_are_refused(value: str) -> None:
    for key in ("sigma = 0.05", "process_noise = 0.1 "):
        with pytest.raises(RigError):
            parse_rig(changed(key, f"{key.split()[0]} = {value} "))


MODELS = {
    "resonance": 'kind = "resonance"\nfrequency_hz = 12.0\ndamping = 0.05\nsd = 0.2',
    "ornstein-uhlenbeck": 'kind = "ornstein-uhlenbeck"\ncorrelation_s = 0.1\nsd = 0.2',
    "ar": 'kind = "ar"\ncoefficients = [1.2, -0.5, 0.1]\nsd = 0.2',
    "matrices": 'kind = "matrices"\nA = [[0.6]]\nB_w = [[1.0]]\nC = [[2.0]]\nprocess_noise = 0.0064',
}


@pytest.mark.parametrize("kind", MODELS)
def test_a_disturbance_model_adds_states_whose_outputs_have_the_sd_that_it_says(kind: str) -> None:
    rig = parse_rig(f"{TEXT}\n[[disturbance.model]]\n{MODELS[kind]}\n")
    alone, plant = load_rig("section-vi").plant, rig.plant
    n = plant.disturbance_states
    assert plant.n_states == alone.n_states + n
    assert not plant.B[-n:].any()
    assert np.array_equal(plant.A[:-n, :-n], alone.A)
    assert not plant.A[:-n, -n:].any()
    # Through Lyapunov's equation: A P A' + Q = P.
    A, C, P = plant.A[-n:, -n:], plant.C[:, -n:], plant.initial_covariance[-n:, -n:]
    Q = (plant.B_w @ plant.process_noise @ plant.B_w.T)[-n:, -n:]
    assert np.allclose(A @ P @ A.T + Q, P)
    assert np.isclose(np.sqrt(C @ P @ C.T), 0.2)


def test_parts_of_a_disturbance_model_add_up_and_modes_share_the_outputs_between_them() -> None:
    """One resonance that shakes x and y together, and a wandering of each on its own."""
    text = f"""{load_rig("tip-tilt").toml}
[[disturbance.model]]
kind = "resonance"
frequency_hz = 43.0
damping = 0.01
modes = [[0.6], [0.8]]
sd = 0.1
[[disturbance.model]]
kind = "random-walk"
step_sd = [0.001, 0.002]
"""
    plant = parse_rig(text).plant
    C, P = plant.C[:, -4:], plant.initial_covariance[-4:, -4:]
    assert plant.disturbance_states == 4
    assert np.allclose(C[:, :2] @ P[:2, :2] @ C[:, :2].T, 0.01 * np.outer([0.6, 0.8], [0.6, 0.8]))
    assert np.allclose(np.diag(plant.process_noise)[-2:], [1e-6, 4e-6])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('kind = "pink"', r"disturbance.model\[0\].kind = 'pink' is not known: use one of resonance, ornstein"),
        ('kind = "resonance"\nfrequency_hz = 600.0\ndamping = 0.1\nsd = 0.1', "frequency_hz = 600 is beyond"),
        ('kind = "resonance"\nfrequency_hz = 6.0\nsd = 0.1', r"model\[0\].damping is missing"),
        ('kind = "ar"\ncoefficients = [1.0]\nsd = 0.1', "does not decay .* modulus 1, .* use kind = 'random-walk'"),
        ('kind = "ar"\ncoefficients = [1, 1, 1, 1, 1]\nsd = 0.1', r"has shape 5, expected 1 to 4 numbers"),
        ('kind = "matrices"\nA = [[0.5]]\nB_w = [[1.0]]\nC = [[1.0], [1.0]]\nprocess_noise = 1.0', "shape 2 x 1"),
        ('kind = "ornstein-uhlenbeck"\ncorrelation_s = 1.0\nsd = [0.1, 0.1]', "sd has shape 2, expected 1 "),
    ],
)
def test_a_disturbance_model_that_cannot_work_is_refused(text: str, message: str) -> None:
    with pytest.raises(RigError, match=message):
        parse_rig(f"{TEXT}\n[[disturbance.model]]\n{text}\n")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("delay_s = 0.2", r"control.delay_s = 0.2 is not below the 0.2 s from one exposure to the next"),
        ("gain = 0", "control.gain = 0 must be above 0"),
        ('when_lost = "stop"', "control.when_lost = 'stop' is not known: use one of hold, park"),
        ("leak = 2", "control.leak = 2 must be at most 1"),
    ],
)
def test_a_control_table_that_cannot_work_is_refused(text: str, message: str) -> None:
    with pytest.raises(RigError, match=message):
        parse_rig(f"{TEXT}\n[control]\n{text}\n")


def test_a_film_needs_no_mirror_in_its_rig_file():
    text = load_rig("single-lenslet").toml
    rig = parse_rig(text[: text.index("[mirror]")] + text[text.index("[simulation]") :])
    assert rig.drive.kind == "none"
    np.testing.assert_allclose(rig.mirror.input_max - rig.mirror.input_min, 0, atol=1e-8)
    assert (rig.mirror.park == 0).all()


@pytest.mark.parametrize("width", [{"sd": 0.05}, {"fwhm": 0.05 * 2.354820045}, {"sigma": 0.05 * 2**0.5}])
def test_a_kernels_width_may_be_given_in_three_ways(width: dict[str, float]) -> None:
    ((name, value),) = width.items()
    text = load_rig("section-vi").toml.replace("sigma = 0.05 ", f"{name} = {value:.12g} ", 1)
    assert parse_rig(text).sensor.kernel.variance == pytest.approx(0.0025)
    wider = parse_rig(with_value(text, "sensor.kernel.sigma", 0.1))
    assert wider.sensor.kernel.sigma == pytest.approx(0.1)
    assert f"\n{name} = " in wider.toml
    with pytest.raises(RigError, match="both say how wide"):
        parse_rig(text.replace(f"\n{name} = ", f"\n{'sd' if name == 'sigma' else 'sigma'} = 0.1\n{name} = ", 1))


def test_read_noise_may_be_given_in_counts_or_electrons_of_a_pixel() -> None:
    rig = load_rig("single-lenslet")
    sensor = rig.sensor
    counts = float(np.sqrt(sensor.noise_density / sensor.pixel_size)) * sensor.counts_per_density
    text = re.sub(r"\nphotoelectrons = \S+", "", rig.toml)
    line = re.search(r"\nnoise_density = .*", text)
    assert line is not None
    in_counts = text.replace(line[0], f"\nread_noise_counts = {counts!r}  # read", 1)
    assert parse_rig(in_counts).sensor.noise_density == pytest.approx(sensor.noise_density)
    electrons = f"\nphotoelectrons = 1000\nread_noise_electrons = {counts / 4!r}"
    of_electrons = re.sub(r"\ncounts_per_density = \S+", f"\ncounts_per_density = {4000 * sensor.pixel_size!r}", text)
    found = parse_rig(of_electrons.replace(line[0], electrons, 1)).sensor  # four counts an electron
    bright = 4000 * sensor.pixel_size
    assert np.sqrt(found.noise_density / found.pixel_size) * bright == pytest.approx(counts)
    with pytest.raises(RigError, match="read_noise_electrons needs sensor"):
        parse_rig(text.replace(line[0], "\nread_noise_electrons = 2", 1))
    # What is measured takes its place: a calibration measures the density.
    again = with_value(in_counts, "sensor.noise_density", 0.5, may_be_new=True)
    assert "read_noise" not in again
    assert parse_rig(again).sensor.noise_density == 0.5


def test_a_misspelt_rig_is_guessed() -> None:
    with pytest.raises(RigError, match=r"did you mean section-vi\? "):
        load_rig("sektion-vi")


def test_the_rigs_that_come_along_are_listed(aolink: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    lines = " ".join(aolink("rig", "--list").stdout.split())
    assert all(f"{name} " in lines for name in builtin_rigs())
    assert "The paper's example" in lines


def test_a_byte_order_mark_is_none_of_a_rig_file(tmp_path):
    (tmp_path / "a.toml").write_text(load_rig("single-lenslet").toml, encoding="utf-8-sig")
    assert load_rig(tmp_path / "a.toml").digest == load_rig("single-lenslet").digest
