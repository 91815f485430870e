"""The simulated picture sensor: what a picture that moves during the exposure leaves on it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from aolink.errors import RigError
from aolink.exposure import Picture
from aolink.optics.scene import SceneSensor, framed
from aolink.optics.sensor import Kernel
from aolink.restoration import motion_psf
from aolink.rig import Rig, load_rig, parse_rig
from aolink.rig.scene_table import read_scene_picture
from aolink.simulation.model import RigPhysics, simulate
from aolink.simulation.scene import SceneCamera
from tests.kinds import must_be, truth_of

RIG = load_rig("moving-scene")
SCENE = must_be(SceneSensor, RIG.scene)
FINE = 4
PICTURE = np.random.default_rng(3).random((96, 112))


def rig_with(picture: np.ndarray, folder: Path, **changes: Any) -> tuple[Rig, SceneSensor]:
    np.save(folder / "a.npy", picture)
    sensor = replace(SCENE, picture="a.npy", noise_sd=0.0, bit_depth=16, counts_per_intensity=40_000.0, **changes)
    return replace(RIG, scene=sensor, folder=folder), sensor


@pytest.fixture
def small(tmp_path: Path) -> tuple[Rig, SceneSensor]:
    """A sensor of 16 x 20 pixels on a picture of noise, four of its pixels in one."""
    return rig_with(PICTURE, tmp_path, pixels=(16, 20), pixel_scale=0.1, picture_pixels=FINE)


def intensity(rig: Rig, path: np.ndarray, light: str = "moving") -> np.ndarray:
    sensor = must_be(SceneSensor, rig.scene)
    rig = replace(rig, plant=replace(rig.plant, C=np.ones((len(path), 2))))
    camera = SceneCamera(rig, np.random.default_rng(0))
    weights = np.full(path.shape[1], 1 / path.shape[1])
    return sensor.to_intensity(camera.frame(path, weights, light))


@pytest.mark.parametrize("directions", [1, 2])
def test_it_is_the_mean_of_the_picture_moved_step_by_step(small: tuple[Rig, SceneSensor], directions: int) -> None:
    """Against whole steps of the fine picture, rolled, blurred by a Gaussian in space, and summed over pixels."""
    rig, sensor = small
    steps = np.random.default_rng(1).integers(-9, 10, (directions, 12))
    path = steps * sensor.pixel_scale / FINE
    sigma_px = np.sqrt(sensor.kernel.variance) / sensor.pixel_scale * FINE
    moved = [np.roll(PICTURE, (s[1] if directions == 2 else 0, s[0]), axis=(0, 1)) for s in steps.T]
    smooth = ndimage.gaussian_filter(np.mean(moved, axis=0), sigma_px, mode="wrap", truncate=8)
    # The kernel is sampled there and not here: its width is more than a pixel of the fine picture.
    np.testing.assert_allclose(intensity(rig, path), framed(sensor, smooth), atol=2e-3)


SLANTED = Kernel(shape="gaussian", sigma=0.2, matrix=((0.24, 0.12), (0.12, 0.09)))


@pytest.mark.parametrize("kernel", [SCENE.kernel, SLANTED], ids=["round", "slanted"])
def test_it_is_what_restoration_takes_it_for(tmp_path: Path, kernel: Kernel) -> None:
    """The direction of a positive slope, the place of no displacement and the scale are those of `motion_psf`."""
    smooth = ndimage.gaussian_filter(PICTURE, 2.5, mode="wrap")
    rig, sensor = rig_with(smooth, tmp_path, pixels=(60, 64), pixel_scale=0.05, picture_pixels=1, kernel=kernel)
    line, plane = np.linspace(0.1, 0.4, 50)[None], np.stack([np.linspace(0, 0.3, 50), np.linspace(0.2, -0.1, 50)])
    # Along a line a kernel's width across it is no part of the PSF.
    for path in (line, plane) if kernel.matrix is None else (plane,):
        spread = path if len(path) == 1 else np.concatenate([path - 0.1, path + 0.1])  # two spots, their mean counts
        seen = intensity(rig, spread)
        psf = motion_psf(path, None, sensor.kernel, sensor.pixel_scale)
        values = np.atleast_2d(psf.values)
        row, column = psf.origin if len(psf.origin) == 2 else (0, psf.origin[0])
        middle = (values.shape[0] // 2, values.shape[1] // 2)
        centred = ndimage.convolve(smooth, values, mode="wrap")
        whole = np.roll(centred, (middle[0] - row, middle[1] - column), axis=(0, 1))
        expected = framed(sensor, whole)
        still = framed(sensor, smooth)
        assert np.abs(seen - expected).max() < 0.05 * np.abs(still - expected).max()


def test_along_x_alone_it_is_as_on_the_plane(small: tuple[Rig, SceneSensor]) -> None:
    """Motion along a line of pixels is made row by row; still along y it is the same."""
    rig, _ = small
    path = np.random.default_rng(4).normal(0, 0.1, (1, 9))
    np.testing.assert_allclose(intensity(rig, path), intensity(rig, np.concatenate([path, 0 * path])), atol=3e-5)


def test_each_light_gives_its_own_scene(small: tuple[Rig, SceneSensor]) -> None:
    rig, sensor = small
    path = np.zeros((1, 4))
    assert np.abs(intensity(rig, path, "dark")).max() < 1e-4
    assert np.ptp(intensity(rig, path, "flat")) == 0
    np.testing.assert_array_equal(intensity(rig, path, "still"), intensity(rig, path, "moving"))
    assert sensor.is_saturated(sensor.to_counts(np.array([-1.0, 0.5, 9.0]))).tolist() == [True, False, True]


def test_noise_is_as_the_rig_file_says() -> None:
    exposures = simulate(RIG, 3)
    model = replace(RIG, scene=replace(SCENE, noise_sd=0.0))
    for noisy, clean in zip(exposures, simulate(model, 3), strict=True):
        assert noisy.scene is not None
        assert clean.scene is not None
        difference = (noisy.scene.pixels.astype(float) - clean.scene.pixels) / SCENE.counts_per_intensity
        assert np.std(difference) == pytest.approx(SCENE.noise_sd, rel=0.03)
        assert abs(np.mean(difference)) < 3e-4
        np.testing.assert_array_equal(noisy.pixels, clean.pixels)


def test_bits_do_not_depend_on_how_steps_are_cut() -> None:
    u = RIG.mirror.quantise(RIG.drive.inputs(0, 400, RIG.timing.fast_step_s))
    whole, cut = RigPhysics(RIG), RigPhysics(RIG)
    for model in (whole, cut):
        model.start_camera(0)
    frames = whole.advance(u)
    again = [frame for k in range(0, 400, 50) for frame in cut.advance(u[k : k + 50])]
    assert len(frames) == len(again) == 2
    for one, two in zip(frames, again, strict=True):
        np.testing.assert_array_equal(one.scene, two.scene)


def test_the_spot_is_the_same_without_the_scene() -> None:
    for one, two in zip(simulate(RIG, 2), simulate(replace(RIG, scene=None), 2), strict=True):
        np.testing.assert_array_equal(one.pixels, two.pixels)
        assert two.scene is None


def test_an_exposure_between_steps_weighs_its_ends() -> None:
    """Half a step late, half of the first step and half of the one after the last are seen."""
    timing = replace(RIG.timing, exposure_steps=4, frame_period_steps=4, exposure_offset=0.5)
    late = replace(RIG, timing=timing, scene=replace(SCENE, noise_sd=0.0))
    (exposure,) = simulate(late, 1)
    truth = truth_of(exposure)
    path = np.concatenate([truth.path, late.plant.C @ truth.end_state.T], axis=1)
    expected = SceneCamera(late, np.random.default_rng(0)).frame(path, np.array([1, 2, 2, 2, 1]) / 8, "moving")
    np.testing.assert_array_equal(must_be(Picture, exposure.scene).pixels, expected)


def scene_text(**changes: object) -> str:
    text = RIG.toml
    for key, value in changes.items():
        lines = [line if not line.startswith(f"{key} =") else f"{key} = {value}" for line in text.splitlines()]
        text = "\n".join(lines)
    return text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixel_scale": 0}, r"scene\.pixel_scale = 0 must be above 0"),
        ({"picture_pixels": 0}, r"scene\.picture_pixels = 0 must be at least 1"),
        ({"noise_sd": -1}, r"scene\.noise_sd = -1 must be at least 0"),
        ({"counts_per_intensity": "3500\nspeed = 3"}, r"scene\.speed is not a key that aolink knows"),
        ({"picture": 3}, r"scene\.picture: expected text, found 3"),
        ({"bit_depth": 4}, r"scene\.black_level = 100 is not below the full scale, 15|black_level = 5000"),
        ({"sigma": "[[0.1, 0], [0, 0.2]]"}, r"kernel\.sigma is a matrix"),
    ],
)
def test_what_is_wrong_in_the_table_is_named(changes: dict[str, object], message: str) -> None:
    with pytest.raises(RigError, match=message):
        parse_rig(scene_text(**changes))


def test_only_the_simulator_opens_the_picture(tmp_path: Path) -> None:
    """A recording made elsewhere is read without it."""
    rig = parse_rig(scene_text(picture='"nowhere.png"'), tmp_path)
    with pytest.raises(RigError, match=r"scene\.picture: cannot read .*nowhere\.png: there is no such file"):
        simulate(rig, 1)
    with pytest.raises(RigError, match=r"scene\.picture is missing: a simulated rig needs a picture"):
        simulate(parse_rig(scene_text(picture='""')), 1)
    assert parse_rig(RIG.toml, tmp_path).scene == RIG.scene
    assert simulate(parse_rig(RIG.toml, tmp_path), 1)[0].scene is not None  # it comes with aolink


def test_pictures_of_any_kind_are_read_as_intensities(tmp_path: Path) -> None:
    """Eight and sixteen bits and colours are 0 to 1; what is beside the rig file goes before what comes with aolink."""
    sensor = replace(SCENE, pixels=(8, 8), picture_pixels=1, picture="moving-scene.png")
    for picture, expected in (
        (np.full((8, 9), 51, dtype=np.uint8), 0.2),
        (np.full((9, 8), 13107, dtype=np.uint16), 0.2),
        (np.full((8, 8, 3), (255, 0, 0), dtype=np.uint8), 0.2126),
    ):
        Image.fromarray(picture).save(tmp_path / "moving-scene.png")
        assert read_scene_picture(sensor, tmp_path) == pytest.approx(expected)
    Image.fromarray(np.zeros((7, 90), dtype=np.uint8)).save(tmp_path / "moving-scene.png")
    with pytest.raises(RigError, match=r"has shape \(7, 90\), expected at least 8 x 8 finite"):
        read_scene_picture(sensor, tmp_path)
