"""Rig files that describe optics: against the membrane itself, superposition and what cannot be."""

import numpy as np
import pytest

from aolink.errors import RigError
from aolink.optics.mirror import Membrane, VoltageLaw, square_pads
from aolink.rig import Rig, load_rig, parse_rig
from aolink.rig.optical_plant import Optics
from tests.conftest import without_pupil
from tests.kinds import must_be

SH = load_rig("sh-8x8")
TILT = load_rig("tip-tilt")


def changed(rig: Rig, old: str, new: str) -> Rig:
    assert rig.toml.count(old) == 1, old
    return parse_rig(rig.toml.replace(old, new))


def settled(rig, u):
    plant = rig.plant
    return plant.C @ np.linalg.solve(np.eye(plant.n_states) - plant.A, plant.B @ u)


def test_a_pressure_moves_every_spot_as_the_membrane_bends():
    membrane = Membrane(radius_m=7.5e-3, tension_n_per_m=20.0, pads_m=square_pads(4, 4, 2.2e-3), pad_radius_m=1e-3)
    u = np.random.default_rng(1).uniform(-5, 5, 16)
    slopes = settled(without_pupil(SH), u).reshape(8, 8, 2)
    # Lenslets of 0.3 mm see 1 mm of the membrane each: the path, twice the deflection, is 3.3 times as steep there.
    x = (np.arange(8001) - 4000) * 1e-6
    row = 2
    y = (row - 3.5) * 1e-3 + (np.arange(50) - 24.5) * 2e-5
    path = 2 * membrane.influence(np.stack(np.meshgrid(x[::1000], y), axis=-1)) @ u  # at the lenslets' sides
    expected = np.diff(path.mean(axis=0)) / 0.3e-3 / 1e-3
    np.testing.assert_allclose(slopes[row, :, 0], expected, rtol=2e-3, atol=1e-4)


def test_the_window_is_a_lenslet_seen_from_its_focus():
    assert SH.sensor.field == pytest.approx((-0.15 / 45 * 1e3, 0.15 / 45 * 1e3))
    assert SH.sensor.pixel_width * 1e-3 == pytest.approx(
        0.3e-3 / 16 / must_be(Optics, SH.optics).lenslets.focal_length_m
    )


def test_a_drift_is_as_slow_and_as_large_as_the_file_says():
    A, n = SH.plant.A, 32
    assert A.shape == (48, 48)
    np.testing.assert_allclose(np.diag(A)[n:], np.exp(-0.0005 / 0.2))
    variance = 0.002 / (1 - np.exp(-2 * 0.0005 / 0.2))
    np.testing.assert_allclose(np.diag(SH.plant.initial_covariance)[n:], variance)
    assert not SH.plant.B_w[:n].any()


def test_tip_tilt_moves_all_spots_alike_with_its_coupling():
    np.testing.assert_allclose(settled(TILT, [1.0, 0.0]), [1.0, 0.03])
    four = changed(TILT, "grid = [1, 1]", "grid = [2, 2]")
    np.testing.assert_allclose(settled(four, [0.0, 0.5]), np.tile([0.015, 0.5], 4))


def test_voltages_are_what_the_driver_has_steps_of():
    mirror = SH.mirror
    law = must_be(VoltageLaw, mirror.voltage)
    assert mirror.input_min[0] == pytest.approx(-1.8e-3 * 140**2)
    u = np.linspace(mirror.input_min[0], mirror.input_max[0], 1001)[:, None] * np.ones(16)
    out = mirror.quantise(u)
    steps = law.volts(out) / (200 / (2**14 - 1))
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    assert np.abs(law.volts(out) - law.volts(u)).max() <= 200 / (2**14 - 1) / 2 + 1e-9
    # Half a step of volts is a larger force at high voltage.
    error = np.abs(out - u)[:, 0]
    assert error[-100:].max() > 2 * error[50:150].max()
    assert (out >= mirror.input_min - 1e-9).all()
    assert (out <= mirror.input_max + 1e-9).all()


@pytest.mark.parametrize(
    ("rig", "old", "new", "message"),
    [
        (SH, "radius_m = 7.5e-3", "radius_m = 4e-3", r"plant.radius_m: a pad reaches"),
        (SH, "footprint_m = 8e-3 ", "footprint_m = 16e-3 ", "plant.footprint_m = 0.016: the lenslets' corners"),
        (SH, "resonance_hz = 400.0", "resonance_hz = 1000.0", "plant.resonance_hz = 1000 is beyond"),
        (SH, "actuators = [4, 4]", "actuators = [4]", "plant.actuators: expected a list of 2"),
        (SH, "process_noise = 0.002", "process_noise = -1", "plant.process_noise has a variance below zero"),
        (SH, "window = [16, 16]", "window = [16, 16]\nfield = [-1, 1]", r"sensor.field follows from \[lenslets\]"),
        (SH, "bias_v = 140.0", "bias_v = 240.0", "mirror.voltage.bias_v = 240 must be below"),
        (SH, "dac_bits = 14", "dac_bits = 14\ninput_min = 0", "follow from .mirror.voltage."),
        (SH, "[[5, 10e-9]]", "[[1, 10e-9]]", "disturbance.zernike_m: each row begins"),
        (SH, "r0_m = 5e-3", "r0_m = 0", r"disturbance.turbulence.layers\[0\].r0_m = 0 must be above 0"),
        (SH, "outer_scale_m = 0.02", "inner_scale_m = 0.02", "disturbance.turbulence.inner_scale_m is not a key"),
        (SH, "plant_noise = false", "plant_noise = 0", "disturbance.plant_noise: expected true or false"),
        (TILT, "coupling = 0.03", "coupling = 1", "plant.coupling = 1 must be below 1"),
        (TILT, "frequency_hz = 43.0", "frequency = 43.0", r"disturbance.vibration\[1\].frequency_hz is missing"),
        (TILT, 'kind = "tip-tilt"', 'kind = "teetering"', "plant.kind = 'teetering' is not known"),
    ],
)  # fmt: skip
def test_what_cannot_be_built_is_refused_by_its_key(rig, old, new, message):
    with pytest.raises(RigError, match=message):
        changed(rig, old, new)


def test_optics_without_lenslets_are_refused():
    text = SH.toml
    a, b = text.index("[lenslets]"), text.index("[sensor]")
    with pytest.raises(RigError, match=r"plant.kind = 'membrane' needs \[lenslets\]"):
        parse_rig(text[:a] + text[b:])
    text = load_rig("single-lenslet").toml
    with pytest.raises(RigError, match=r"aberrations need \[lenslets\]"):
        parse_rig(text + "\n[disturbance]\nzernike_m = [[4, 1e-9]]\n")
