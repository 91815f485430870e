"""The rig moving-scene: its pictures restored with the path that each estimator found, and with the true one."""

from __future__ import annotations

import numpy as np

import aolink
from aolink.estimation import ESTIMATOR_NAMES
from aolink.optics.scene import framed
from aolink.restoration import Psf, motion_psf, restore
from aolink.restoration.deblur import blurred_psnr, psnr, scene_psf
from aolink.rig.scene_table import read_scene_picture
from bench_rows.row import Effort, Row

EXPOSURES = 100
# Least gain in PSNR with the estimated path over the blurred picture, dB.
_GOALS = {"moments": 1.5, "profile": 1.5}


def moving_scene(effort: Effort) -> list[Row]:
    """Mean PSNR over a session, by tv; the peer is the picture as it came, with its shift removed."""
    exposures = aolink.simulate("moving-scene", effort.of(EXPOSURES))
    rig, sensor = exposures.rig, exposures.rig.scene
    assert sensor is not None
    scene = framed(sensor, read_scene_picture(sensor, rig.folder))
    truths = [exposure.truth for exposure in exposures if exposure.truth is not None]
    pictures = [exposure.scene.pixels for exposure in exposures if exposure.scene is not None]
    shifts = [np.rint(truth.path.mean(axis=1) / sensor.pixel_scale).astype(np.intp) for truth in truths]
    blurred = np.mean([blurred_psnr(sensor, e, s, scene) for e, s in zip(exposures, shifts, strict=True)])

    def found(psfs: list[Psf]) -> np.ndarray:
        restored = [
            restore(sensor.to_intensity(counts), psf, mask=~sensor.is_saturated(counts)).image
            for counts, psf in zip(pictures, psfs, strict=True)
        ]
        return np.array([psnr(np.clip(each, 0, 1), scene) for each in restored])

    true = found([motion_psf(truth.path, None, sensor.kernel, sensor.pixel_scale) for truth in truths])
    rows = []
    for name in ("o1", "o3", "moments", "profile"):
        if name not in ESTIMATOR_NAMES:
            continue
        estimates = aolink.estimate(exposures, name).estimates(name)
        each = found([scene_psf(rig, *both) for both in zip(exposures, estimates, strict=True)])
        rows.append(Row(f"moving-scene, tv, path of {name}: mean (least) PSNR",
            f"{each.mean():.1f} ({each.min():.1f}) dB", f"blurred {blurred:.1f}; true path {true.mean():.1f}",
            each.mean() / blurred, _GOALS.get(name, 0)))  # fmt: skip
    return rows
