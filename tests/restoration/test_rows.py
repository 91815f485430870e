"""Pictures of a camera that exposes its rows one after the other: the PSF changes with the row."""

from dataclasses import replace

import numpy as np
import pytest

from aolink.estimation import run
from aolink.optics.scene import framed
from aolink.restoration.deblur import deblur, estimated_psfs, psnr, scene_psf
from aolink.restoration.psf import motion_psf
from aolink.rig import Rig, load_rig, parse_rig
from aolink.rig.scene_table import read_scene_picture
from aolink.simulation.model import simulate
from tests.kinds import truth_of
from tests.simulation.rolling import COUPLED


def rolled(share: float) -> Rig:
    """The rig moving-scene, its picture read out in this share of the exposure."""
    rig = load_rig("moving-scene")
    assert rig.scene is not None
    row_time = share * rig.timing.exposure_steps * rig.timing.fast_step_s / rig.scene.shape[0]
    return parse_rig(rig.toml.replace("[scene]", f"[scene]\nrow_time_s = {row_time!r}", 1), rig.folder)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, -0.5])
def test_a_scene_is_restored_with_a_psf_that_changes_with_the_row(share: float) -> None:
    rig = rolled(share)
    assert rig.scene is not None
    at_once = replace(rig, scene=replace(rig.scene, row_time_s=0.0))
    exposures = simulate(rig, 6, 3)
    estimates = run(rig, exposures, ["moments"])["moments"]
    scene = framed(rig.scene, read_scene_picture(rig.scene, rig.folder))
    gains = []
    for exposure, estimate in list(zip(exposures, estimates, strict=True))[4:]:
        one, other = (deblur(each, exposure, estimate).scene for each in (rig, at_once))
        assert one is not None
        assert other is not None
        gains.append(psnr(one.astype(np.float64), scene) - psnr(other.astype(np.float64), scene))
    assert min(gains) > 3  # dB


@pytest.mark.slow
def test_the_middle_row_has_the_psf_of_its_own_interval() -> None:
    rig = rolled(0.4)
    assert rig.scene is not None
    exposures = simulate(rig, 3, 3)
    (first, second) = run(rig, exposures, ["moments"])["moments"][1:]
    late = round(rig.scene.row_starts_s[rig.scene.shape[0] // 2] / rig.timing.fast_step_s)
    n = rig.timing.exposure_steps
    # The next exposure follows without a gap: its estimate is better than the prediction from the one before.
    path = np.concatenate([first.path, second.path], axis=1)[0, late : late + n]
    expected = motion_psf(path, None, rig.scene.kernel, rig.scene.pixel_scale)
    psf = scene_psf(rig, exposures[1], first)
    ours, theirs = (each.values @ (np.arange(len(each.values)) - each.origin[0]) for each in (psf, expected))
    assert ours == pytest.approx(theirs, abs=0.5)  # pixels


def test_spots_of_one_plant_have_the_psfs_of_their_own_intervals() -> None:
    rig = parse_rig(COUPLED)
    exposure = simulate(rig, 2, 3)[1]
    estimate = run(rig, simulate(rig, 2, 3), ["moments"])["moments"][1]
    mixes = np.eye(rig.n_outputs).reshape(-1, 2, rig.n_outputs)
    psfs = list(estimated_psfs(exposure, estimate, mixes, rig.sensor.kernel, rig.sensor.pixel_width))
    n = rig.timing.exposure_steps
    for spot, psf in enumerate(psfs):
        late = rig.plant.delays[2 * spot]
        path = estimate.path[2 * spot : 2 * spot + 2, late : late + n]
        known = motion_psf(path, None, rig.sensor.kernel, rig.sensor.pixel_width)
        place = [
            np.array([(p.values * (np.indices(p.values.shape)[k] - p.origin[k])).sum() for k in (0, 1)])
            for p in (psf, known)
        ]
        assert place[0] == pytest.approx(place[1], abs=0.02)
    assert truth_of(exposure).path.shape == estimate.path.shape
