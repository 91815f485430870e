"""What disturbs a simulated rig: spectra, spread and slopes against the laws they come from."""

import dataclasses

import numpy as np
import pytest

from aolink import limits
from aolink.errors import RigError
from aolink.optics.turbulence import Layer
from aolink.rig import load_rig, parse_rig
from aolink.rig.disturbance import Disturbance
from aolink.rig.optical_plant import Optics
from aolink.simulation.disturbance import DisturbancePlayer
from aolink.simulation.model import RigPhysics, simulate
from tests.conftest import without_pupil
from tests.kinds import must_be, truth_of
from tests.structure_function import structure_function

SH, TILT = without_pupil(load_rig("sh-8x8")), load_rig("tip-tilt")


def disturbed(rig, **changes):
    """The rig with only this disturbance, and a plant at rest."""
    nothing = dataclasses.replace(
        rig.disturbance, plant_noise=False, layers=(), vibrations=(), zernike_m=np.zeros((0, 2)), recorded=""
    )
    return dataclasses.replace(rig, disturbance=dataclasses.replace(nothing, **changes))


def slopes(rig, n_steps, seed=1):
    return DisturbancePlayer(rig, np.random.default_rng(seed)).slopes(0, n_steps)


def test_vibrations_are_lines_of_their_frequency_and_height():
    rig = disturbed(TILT, vibrations=must_be(Disturbance, TILT.disturbance).vibrations)
    n = 4000  # 2 s: both lines on whole bins
    spectrum = np.abs(np.fft.rfft(slopes(rig, n), axis=0)) * 2 / n
    frequency = np.fft.rfftfreq(n, rig.timing.fast_step_s)
    expected = np.zeros_like(spectrum)
    for line in rig.disturbance.vibrations:
        expected[np.argmin(np.abs(frequency - line.frequency_hz))] = line.amplitude
    np.testing.assert_allclose(spectrum, expected, atol=1e-9)


@pytest.mark.rare
def test_turbulence_has_the_slopes_of_its_structure_function():
    layer = Layer(r0_m=1e-3, wind_m_s=(0.01, 0.0), outer_scale_m=0.02, wavelength_m=633e-9)
    rig = disturbed(SH, layers=(layer,), pupil_m=2.4e-3)
    first = np.array([slopes(rig, 1, seed)[0] for seed in range(300)]).reshape(300, 8, 8, 2)
    # Along one row, slope times pitch is the difference of W's means over two sides; its variance by the structure
    # function D of W is the mean of D between points of different sides less that within sides.
    d, metres = 0.3e-3, layer.wavelength_m / (2 * np.pi)
    s = (np.arange(400) + 0.5) / 400 * d
    between = np.abs(s[:, None] - s)
    variance = (structure_function(layer, np.hypot(between, d)) - structure_function(layer, between)).mean()
    expected = variance * metres**2 / d**2 / rig.optics.slope_unit_rad**2
    assert (first**2).mean() == pytest.approx(expected, rel=0.07)


def test_turbulence_is_blown_by_the_wind():
    layer = Layer(r0_m=1e-3, wind_m_s=(0.3, 0.0), outer_scale_m=0.02)
    rig = disturbed(SH, layers=(layer,), pupil_m=2.4e-3)
    path = slopes(rig, 3).reshape(3, 8, 8, 2)
    # In two steps of 0.5 ms the wind goes 0.3 mm: one lenslet.
    np.testing.assert_allclose(path[2, :, 1:], path[0, :, :-1], atol=1e-9)


def test_a_static_aberration_stays():
    rig = disturbed(SH, zernike_m=np.array([[4, 20e-9]]))
    path = slopes(rig, 100)
    assert np.ptp(path, axis=0).max() == 0
    # Noll 4 is sqrt(3) (2 r^2 / R^2 - 1), R half the grid's diagonal: slopes 4 sqrt(3) r / R^2.
    radius = 8 * 0.3e-3 / np.sqrt(2)
    expected = 20e-9 * 4 * np.sqrt(3) * must_be(Optics, SH.optics).lenslets.centres_m / radius**2 / 1e-3
    np.testing.assert_allclose(path[0].reshape(-1, 2), expected, rtol=1e-9)


@pytest.mark.parametrize("suffix", ["npy", "npz", "csv"])
def test_a_recorded_disturbance_is_played_round_and_round(tmp_path, suffix):
    recorded = np.random.default_rng(3).standard_normal((70, 2))
    path = tmp_path / f"wind.{suffix}"
    if suffix == "csv":
        np.savetxt(path, recorded, delimiter=",")
    elif suffix == "npy":
        np.save(path, recorded)
    else:
        np.savez(path, recorded)
    text = TILT.toml.split("[disturbance]")[0] + f'[disturbance]\nrecorded = "wind.{suffix}"\n'
    (tmp_path / "mine.toml").write_text(text)
    from_file = load_rig(tmp_path / "mine.toml")  # the file's path is relative to the rig file
    np.testing.assert_allclose(slopes(from_file, 200), recorded[np.arange(200) % 70])


@pytest.mark.parametrize(
    ("content", "says"),
    [(np.zeros((5, 3)), "expected finite numbers"), (np.full((5, 2), np.nan), "expected finite"), (None, "cannot read"),
     (b"what", "holds no numbers")],
)  # fmt: skip
def test_recorded_disturbances_that_do_not_fit_are_refused(tmp_path, content, says):
    if isinstance(content, bytes):
        (tmp_path / "wind.npy").write_bytes(content)
    elif content is not None:
        np.save(tmp_path / "wind.npy", content)
    rig = parse_rig(TILT.toml.split("[disturbance]")[0] + '[disturbance]\nrecorded = "wind.npy"\n', tmp_path)
    with pytest.raises(RigError, match=says):
        RigPhysics(rig)


def test_a_table_that_is_above_the_limit_is_refused(tmp_path, monkeypatch):
    np.savetxt(tmp_path / "wind.csv", np.zeros((100, 2)), delimiter=",")
    rig = parse_rig(TILT.toml.split("[disturbance]")[0] + '[disturbance]\nrecorded = "wind.csv"\n', tmp_path)
    RigPhysics(rig)
    monkeypatch.setattr(limits, "_UNPACKED_BYTES", 1000)
    with pytest.raises(RigError, match=r"wind\.csv has \d+ bytes, which is above the limit of 1000"):
        RigPhysics(rig)


def test_steps_do_not_depend_on_how_they_are_asked_for():
    one, other = (DisturbancePlayer(SH, np.random.default_rng(5)) for _ in range(2))
    whole = one.slopes(0, 500)
    pieces = [other.slopes(a, b - a) for a, b in ((0, 1), (1, 130), (130, 131), (131, 500))]
    np.testing.assert_array_equal(np.concatenate(pieces), whole)


def test_the_path_is_the_plants_output_and_the_disturbance():
    exposures = simulate(TILT, 3)
    quiet = simulate(disturbed(TILT), 3)
    # The camera's model spawns its random streams in order; the disturbance's is the fifth.
    stream = np.random.default_rng(np.random.SeedSequence(TILT.simulation.seed).spawn(5)[4])
    added = DisturbancePlayer(TILT, stream).slopes(0, 300).T
    for k, (exposure, without) in enumerate(zip(exposures, quiet, strict=True)):
        np.testing.assert_allclose(truth_of(exposure).path, truth_of(without).path + added[:, k * 100 : (k + 1) * 100])
        np.testing.assert_array_equal(truth_of(exposure).start_state, truth_of(without).start_state)


def test_plant_noise_goes_on_beside_a_disturbance_where_the_file_says_so():
    disturbance = dataclasses.replace(must_be(Disturbance, TILT.disturbance), plant_noise=True)
    noisy = dataclasses.replace(TILT, disturbance=disturbance)
    free = dataclasses.replace(TILT, disturbance=None)
    for a, b in zip(simulate(noisy, 2), simulate(free, 2), strict=True):
        np.testing.assert_array_equal(truth_of(a).start_state, truth_of(b).start_state)
        assert np.abs(truth_of(a).path - truth_of(b).path).max() > 0.1
