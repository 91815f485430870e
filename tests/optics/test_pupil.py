"""Rigs behind a pupil: dark windows have no spots, partly lit ones less light; estimators know it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from aolink.errors import EstimatorError, RigError
from aolink.estimation import BlurFilter, Estimator, Measurement, make_estimator, run
from aolink.estimation.exposure_scan import exposure_scan
from aolink.estimation.frames.centroid_noise import centroid_covariance
from aolink.estimation.frames.measure import measure
from aolink.estimation.kalman.path_moments import PathMoments
from aolink.estimation.score import score
from aolink.optics.camera import to_density
from aolink.optics.frame import frame_density, spot_windows
from aolink.optics.lenslets import Lenslets
from aolink.optics.sensor import SpotSensor
from aolink.optics.turbulence import FrozenFlow, Layer
from aolink.rig import Rig, load_rig, parse_rig
from aolink.rig.optical_plant import Optics
from aolink.simulation.model import simulate
from tests.kinds import must_be, truth_of

SH = load_rig("sh-8x8")
LENSLETS = """
[lenslets]
pitch_m = 0.3e-3
focal_length_m = 0.15
pupil_m = 1.0e-3
least_light = 0.3

[sensor]"""


def pupil_4x4(photoelectrons: int = 0) -> Rig:
    """Twelve of sixteen spots, each slope an axis of its own; the outer eight are lit in part."""
    text = load_rig("sh-4x4").toml
    for old, new in (
        ("axes = 32", "axes = 24"),
        ("[sensor]", LENSLETS),
        ("field = [-1.0, 1.0] ", "# "),
        ("photoelectrons = 0 ", f"photoelectrons = {photoelectrons} "),
    ):
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return parse_rig(text)


FOUR = pupil_4x4()


def sensor_of(rig: Rig) -> SpotSensor:
    assert isinstance(rig.sensor, SpotSensor)
    return rig.sensor


def light_of(sensor: SpotSensor) -> np.ndarray:
    return must_be(np.ndarray, sensor.spot_light)


def test_dark_windows_have_no_spots_and_others_their_share_of_the_light():
    sensor = sensor_of(SH)
    assert SH.optics is not None
    share = SH.optics.lenslets.light
    assert sensor.lit.tolist() == np.flatnonzero(share >= 0.4).tolist()
    assert (sensor.spots, SH.n_outputs) == (48, 96)
    frame = frame_density(sensor, np.zeros((96, 3)))
    light = frame.reshape(8, 16, 8, 16).sum(axis=(1, 3)).ravel() * sensor.pixel_size
    np.testing.assert_allclose(light, np.where(share >= 0.4, share, 0.0), rtol=1e-4)
    windows = spot_windows(sensor, frame)
    assert windows.shape == (48, 16, 16)
    np.testing.assert_allclose(windows.sum(axis=(1, 2)) * sensor.pixel_size, light_of(sensor), rtol=1e-4)


def test_the_plant_has_the_rows_of_the_lit_lenslets():
    """The rows of wholly lit lenslets are those without a pupil; a half lit one sees another part of the mirror."""
    text = SH.toml
    a, b = text.index("pupil_m = 2.4e-3      # diameter"), text.index("slope_unit_rad")
    whole = parse_rig(text[:a] + text[b:])
    assert whole.n_outputs == 128
    ours, theirs = SH.plant.C.reshape(48, 2, -1), whole.plant.C.reshape(64, 2, -1)[sensor_of(SH).lit]
    full = light_of(sensor_of(SH)) == 1
    np.testing.assert_array_equal(ours[full], theirs[full])
    assert np.abs(ours[~full] - theirs[~full]).max() > 0.01 * np.abs(theirs).max()


@pytest.mark.slow
def test_turbulence_is_averaged_over_the_lit_part():
    lenslets = Lenslets(grid=(5, 5), pitch_m=0.1, focal_length_m=1.0, pupil_diameter_m=0.41, obstruction=0.1)
    flow = FrozenFlow(Layer(r0_m=0.1, wind_m_s=(1.0, 0.0)), np.random.default_rng(3), shortest_m=0.05, waves=100)
    slopes = flow.slope_waves(lenslets).sum(axis=2).real

    def gradient(points):
        wave = (np.exp(1j * points @ flow.wave_numbers.T) * flow.amplitudes)[..., None, :]
        return (wave * 1j * flow.wave_numbers.T).sum(axis=-1).real

    expected = lenslets.mean_slopes(gradient)
    assert {0.0, 1.0} < set(lenslets.light)
    np.testing.assert_allclose(slopes, expected, atol=0.02 * float(np.nanstd(expected)))


@pytest.mark.parametrize("photoelectrons", [0, 400])
@pytest.mark.parametrize("rig", ["independent", "coupled"])
@pytest.mark.parametrize("orders", [(1,), (1, 2)])
def test_what_is_measured_is_as_sure_as_its_light_allows(rig, photoelectrons, orders):
    if rig == "independent":
        tested = pupil_4x4(photoelectrons)
    else:
        sensor = replace(
            sensor_of(SH), noise_density=2e-4, photoelectrons=photoelectrons, black_level=1100, bit_depth=14
        )
        tested = replace(SH, sensor=sensor, disturbance=None)
    exposures = simulate(tested, 40, seed=5)
    observation = PathMoments(tested.plant, orders)
    pulls = []
    for exposure in exposures:
        found = must_be(Measurement, measure(tested, exposure, observation.needs)[0])
        path = truth_of(exposure).path
        truth = np.stack([(path**p).mean(axis=1) for p in orders], axis=1)
        covariance = found.covariance.reshape(-1, *found.covariance.shape[-2:])
        sd = np.sqrt(np.einsum("kmm->km", covariance)).reshape(truth.shape)
        pulls.append((found.value.reshape(truth.shape) - truth) / sd)
    spread = np.array(pulls).reshape(len(exposures), -1, 2 * len(orders)).var(axis=(0, 2))
    light = light_of(sensor_of(tested))
    for group in (light < 0.8, light == 1):
        # Light that falls beside the window's edge takes some of the noise's part.
        assert spread[group].mean() == pytest.approx(1, abs=0.15)


def test_gains_and_noise_follow_the_light():
    light = np.repeat(light_of(sensor_of(FOUR)), 2)
    noise = centroid_covariance(FOUR)[:, 0, 0, 0]
    np.testing.assert_allclose(noise * light**2, noise[light == 1][0])
    exposures = simulate(FOUR, 30)
    optimal = Estimator(FOUR, "o1", BlurFilter(FOUR.plant, PathMoments(FOUR.plant, (1,))))
    steady, varying = ([o1.step(each) for each in exposures][-1] for o1 in (make_estimator(FOUR, "o1"), optimal))
    np.testing.assert_allclose(steady.end_covariance, varying.end_covariance, rtol=1e-3)
    assert np.ptp(steady.end_covariance[:, 0, 0]) > 1e-3 * steady.end_covariance[:, 0, 0].min()


@pytest.mark.slow
def test_every_estimator_works_and_moments_knows_how_well():
    exposures = simulate(FOUR, 25)
    names = ("open-loop", "o1", "o2", "o3", "moments")
    estimates = run(FOUR, exposures, names)
    scores = {name: score(exposures, each, skip=5) for name, each in estimates.items()}
    assert {e.status.name for name in names[1:] for e in estimates[name]} <= {"OK", "GATED", "REINITIALISED"}
    assert scores["o1"].path_rmse < 0.7 * scores["open-loop"].path_rmse
    assert scores["moments"].path_rmse < 0.5 * scores["o1"].path_rmse
    assert 1.6 < scores["moments"].start_nees.mean < 2.4
    # The mean of what is expected of each of the axes.
    (expected,) = exposure_scan(FOUR, [200])
    assert scores["o1"].path_rmse == pytest.approx(expected.path_rms, rel=0.15)


@pytest.mark.slow
def test_a_plant_of_few_lit_spots_is_seen_by_moments_too():
    text = load_rig("tip-tilt").toml
    a, b = text.index("[disturbance]"), text.index("[simulation]")
    text = (
        (text[:a] + text[b:]).replace("grid = [1, 1]", "grid = [4, 4]").replace("[lenslets]", "[lenslets]\npupil_m = 1")
    )
    pitch_m = must_be(Optics, load_rig("tip-tilt").optics).lenslets.pitch_m
    rig = parse_rig(text.replace("pupil_m = 1", f"pupil_m = {4 * pitch_m}"))
    assert rig.n_outputs == 24
    exposures = simulate(rig, 10)
    estimates = run(rig, exposures, ("o1", "moments"))
    for each in estimates.values():
        assert {e.status.name for e in each} == {"OK"}
        np.testing.assert_allclose(each[-1].path[::2], np.tile(each[-1].path[0], (12, 1)), atol=1e-9)
    assert np.mean([e.nis for e in estimates["moments"]]) == pytest.approx(8 * 12, rel=0.15)
    assert score(exposures, estimates["moments"]).path_rmse < score(exposures, estimates["o1"]).path_rmse


def test_a_window_in_the_dark_may_be_missing_or_bright():
    """What is in it is not looked at."""
    exposure = simulate(FOUR, 1)[0]
    pixels, mask = exposure.pixels.copy(), exposure.mask.copy()
    pixels[:24, :24], mask[:24, 72:] = sensor_of(FOUR).full_scale, False
    disturbed = replace(exposure, pixels=pixels, mask=mask)
    for name in ("o3", "moments"):
        (ours,), (theirs,) = (run(FOUR, [each], [name])[name] for each in (disturbed, exposure))
        assert ours.status is theirs.status
        np.testing.assert_array_equal(ours.end_state, theirs.end_state)
    assert to_density(FOUR.sensor, pixels)[:24, :24].min() > 10


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("obstruction = 0.25", "obstruction = 1.0", "lenslets.obstruction = 1 must be below 1"),
        ("least_light = 0.4", "least_light = 1.5", "lenslets.least_light = 1.5 must be at most 1"),
        ("pupil_m = 2.4e-3      # d", "pupil_m = 0.01e-3 # d", "lenslets.least_light = 0.4: no lenslet has that share"),
        ("pupil_m = 2.4e-3      # d", "# d", "lenslets.least_light needs lenslets.pupil_m"),
    ],
)  # fmt: skip
def test_a_pupil_that_cannot_be_is_refused(old, new, message):
    assert SH.toml.count(old) == 1
    with pytest.raises(RigError, match=message):
        parse_rig(SH.toml.replace(old, new))


def test_a_plant_for_all_windows_is_told_how_many_are_lit():
    with pytest.raises(RigError, match="sees 24 slopes in 12 lit windows, two a spot, but the plant has 32"):
        parse_rig(FOUR.toml.replace("axes = 24", "axes = 32"))


def test_an_estimator_of_pixels_refuses_what_it_does_not_know() -> None:
    with pytest.raises(EstimatorError, match="partly lit lenslets"):
        make_estimator(FOUR, "profile")
