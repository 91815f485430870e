"""The interaction matrix measured on simulated rigs: against the plant that made the frames."""

import dataclasses

import numpy as np
import pytest

from aolink.calibration.interaction import measure_interaction, poke_inputs, rest_exposures, spot_slopes
from aolink.devices.limits import CommandLimits
from aolink.errors import CalibrationError
from aolink.rig import load_rig, parse_rig
from aolink.rig.disturbance import Disturbance
from aolink.simulation.model import simulate
from tests.kinds import must_be, truth_of

SH = load_rig("sh-8x8")
PLANT = SH.plant
TRUE = PLANT.C @ np.linalg.solve(np.eye(PLANT.n_states) - PLANT.A, PLANT.B)


def without_turbulence(rig):
    return dataclasses.replace(rig, disturbance=dataclasses.replace(rig.disturbance, layers=()))


def poked(rig, amplitude=8.0, **options):
    u = rig.mirror.quantise(poke_inputs(rig, amplitude, **options))
    return simulate(rig, len(u) // rig.timing.frame_period_steps, inputs=u)


def test_poking_the_rig_gives_the_plants_own_matrix():
    rig = without_turbulence(SH)
    found = measure_interaction(rig, poked(rig))
    assert found.exposures == 32
    error = found.matrix - TRUE
    # Centroids of 2000 photo-electrons, fewer at the pupil's edge, and read-out noise, over the root of two pokes.
    assert np.sqrt((error**2).mean()) < 0.06 * np.sqrt((TRUE**2).mean())
    assert found.residual_rms < 0.05
    assert found.condition == pytest.approx(np.linalg.cond(TRUE), rel=0.2)
    static = must_be(Disturbance, SH.disturbance).zernike_m[0, 1]
    assert static > 0
    assert np.sqrt((found.offset**2).mean()) > 3 * found.residual_rms / np.sqrt(32)  # the aberration is in the offset


@pytest.mark.slow
def test_pokes_go_no_faster_than_the_rig_file_allows_and_measure_the_same():
    rig = without_turbulence(SH)
    slow = dataclasses.replace(rig, mirror=dataclasses.replace(rig.mirror, slew_max_per_s=300.0))
    u = poke_inputs(slow, 8.0)
    limits, blocks = CommandLimits(slow), np.split(np.tile(u, (2, 1)), 2 * len(u) // slow.timing.frame_period_steps)
    for k, block in enumerate(blocks):
        limits.check(k * len(block), block)
    limits.check(2 * len(u), np.tile(rig.mirror.park, (10, 1)))
    ramped, jumped = measure_interaction(slow, poked(slow)), measure_interaction(rig, poked(rig))
    assert ramped.exposures == jumped.exposures == 32
    apart = np.linalg.norm(ramped.matrix - jumped.matrix) / np.linalg.norm(jumped.matrix)
    assert apart < 0.08  # each has its own noise
    with pytest.raises(
        CalibrationError, match=r"mirror\.slew_max_per_s = 0\.1 makes .* 80 s long, .* smaller amplitude"
    ):
        poke_inputs(dataclasses.replace(rig, mirror=dataclasses.replace(rig.mirror, slew_max_per_s=0.1)), 8.0)


def test_a_slow_mirror_is_measured_where_its_pokes_have_been_held_for_long_enough():
    """One that rings for sixteen frame periods: what is measured sooner is not its matrix at rest."""
    text, _ = load_rig("tip-tilt").toml.split("[disturbance]")
    for old, new in (("resonance_hz = 150.0", "resonance_hz = 6.0"), ("process_noise = 3e-4", "process_noise = 1e-8")):
        assert old in text
        text = text.replace(old, new)
    rig = parse_rig(text)
    plant = rig.plant
    at_rest = plant.C @ np.linalg.solve(np.eye(plant.n_states) - plant.A, plant.B)
    apart = {}
    for hold_s in (0.0, 0.8):
        rest = rest_exposures(rig, hold_s)
        found = measure_interaction(rig, poked(rig, 0.2, rest_exposures=rest), rest_exposures=rest)
        assert found.exposures == 4
        apart[rest] = np.linalg.norm(found.matrix - at_rest) / np.linalg.norm(at_rest)
    assert apart[1] > 0.1
    assert apart[16] < 0.02


@pytest.mark.slow
def test_turbulence_costs_accuracy_and_nothing_else():
    found = measure_interaction(SH, poked(SH))
    calm = measure_interaction(without_turbulence(SH), poked(without_turbulence(SH)))
    assert np.linalg.norm(found.matrix - TRUE) > np.linalg.norm(calm.matrix - TRUE)
    assert found.residual_rms > calm.residual_rms


def test_spots_are_in_the_rigs_order():
    rig = dataclasses.replace(without_turbulence(SH), sensor=dataclasses.replace(SH.sensor, photoelectrons=0.0))
    (exposure,) = simulate(rig, 1, inputs=np.zeros((100, 16)))
    still = spot_slopes(rig.sensor, exposure.pixels)
    np.testing.assert_allclose(still, truth_of(exposure).path.mean(axis=1), atol=0.05)


def test_what_gives_no_matrix_is_refused():
    rig = without_turbulence(SH)
    with pytest.raises(CalibrationError, match="beyond the mirror's limits"):
        poke_inputs(rig, 1e3)
    exposures = poked(rig)
    with pytest.raises(CalibrationError, match="do not determine 16 inputs"):
        measure_interaction(rig, exposures[:20])
    with pytest.raises(CalibrationError, match="hold each poke longer"):
        measure_interaction(rig, poked(rig, rest_exposures=0))
    with pytest.raises(CalibrationError, match="kind 'spots'"):
        measure_interaction(load_rig("section-vi"), [])
    dark = [dataclasses.replace(e, pixels=np.zeros_like(e.pixels)) for e in exposures]
    with pytest.raises(CalibrationError, match="48 spots are missing"):
        measure_interaction(rig, dark)
