"""`restore` as a whole: any picture, any method, aligned with the scene; what is no picture."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from aolink.errors import RestorationError
from aolink.numerics.arrays import FloatArray
from aolink.optics.sensor import Kernel
from aolink.restoration import METHODS, Psf, first_order, from_correlation, measured_correlation, motion_psf, restore
from aolink.restoration.deblur import psnr
from tests.restoration.scenes import DECAYING, UNIFORM, blocks, blurred

NOISE = 0.005
QUICK = tuple(m for m in METHODS if m not in ("inverse", "pnp"))
PNP = pytest.param("pnp", marks=pytest.mark.slow)
SMALL = Kernel(shape="gaussian", sigma=0.3)


def picture(
    values: FloatArray, origin: tuple[int, ...], shape: tuple[int, int] = (48, 80)
) -> tuple[FloatArray, FloatArray]:
    """A noisy picture of a scene that goes on beyond it, and the scene in its frame."""
    taps = np.atleast_2d(values).shape
    image, inside = blurred(blocks(shape[0] + taps[0] - 1, shape[1] + taps[1] - 1, seed=3), values, origin)
    return image + NOISE * np.random.default_rng(1).standard_normal(image.shape), inside


@pytest.mark.parametrize("method", [*QUICK, PNP])
@pytest.mark.parametrize("origin", [0, 3])
def test_it_lies_where_the_scene_lies(method: str, origin: int) -> None:
    psf = Psf(values=np.full(9, 1 / 9), origin=(origin,))
    image, inside = picture(psf.values, (origin,))
    found = restore(image, psf, method=method, noise_sd=NOISE).image
    assert found.shape == image.shape

    def at(shift: int) -> float:
        return float(np.mean((np.roll(found, shift, axis=1) - inside)[:, 12:-12] ** 2))

    # The predictor sees nothing of a step before it has happened.
    lag = range(-3, 4) if method != "predictor" else range(-3, 1)
    assert min(lag, key=at) in ((0,) if method != "predictor" else (-1, 0))


@pytest.mark.parametrize(
    ("method", "gain"),
    [("lag", 2), ("smoother", 3), ("gauss_markov", 3), ("tv", 7), pytest.param("pnp", 7, marks=pytest.mark.slow)],
)
def test_it_is_sharper_than_it_was(method: str, gain: float) -> None:
    image, inside = picture(UNIFORM, (3,))
    found = restore(image, UNIFORM, method=method)
    assert psnr(found.image, inside) > psnr(image, inside) + gain
    assert found.noise_sd == pytest.approx(NOISE, rel=0.35)


@pytest.mark.parametrize("method", QUICK)
def test_units_do_not_matter(method: str) -> None:
    image, _ = picture(DECAYING, (5,))
    psf = Psf(values=DECAYING, origin=(5,))
    one, other = restore(image, psf, method=method), restore(3e4 + 2e4 * image, psf, method=method)
    assert other.noise_sd == pytest.approx(2e4 * one.noise_sd, rel=1e-6)
    assert (other.image - 3e4) / 2e4 == pytest.approx(one.image, abs=2e-3)


@pytest.mark.parametrize("method", ["smoother", "gauss_markov"])
def test_a_mirrored_picture_gives_a_mirrored_scene(method: str) -> None:
    image, _ = picture(DECAYING, (5,))
    there = restore(image, Psf(values=DECAYING, origin=(5,)), method=method).image
    back = restore(image[:, ::-1], Psf(values=DECAYING[::-1], origin=(6,)), method=method).image
    assert abs(back[:, ::-1] - there).max() < 1e-4


@pytest.mark.parametrize("method", ["smoother", "gauss_markov", "tv"])
def test_a_motion_down_the_columns(method: str) -> None:
    image, _ = picture(DECAYING, (5,))
    there = restore(image, Psf(values=DECAYING, origin=(5,)), method=method).image
    down = restore(image.T, Psf(values=DECAYING[:, None], origin=(5, 0)), method=method).image
    assert abs(down.T - there).max() < 1e-10


def test_backwards_the_filter_runs_the_other_way() -> None:
    image, _ = picture(DECAYING, (5,))
    backward = restore(image, Psf(values=DECAYING, origin=(5,)), method="filter", direction="backward")
    turned = restore(image[:, ::-1], Psf(values=DECAYING[::-1], origin=(6,)), method="filter")
    assert backward.direction == "backward"
    assert backward.image == pytest.approx(turned.image[:, ::-1], abs=1e-9)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.int16, np.float32, np.float64])
def test_the_type_of_the_numbers_stays(dtype: type) -> None:
    image, _ = picture(UNIFORM, (3,))
    scale = 200 if np.dtype(dtype).itemsize == 1 else 2000
    given: np.ndarray = (scale * np.clip(image, 0, 1.2)).astype(dtype)
    found = restore(given, UNIFORM).image
    assert found.dtype == dtype
    exact = restore(given.astype(np.float64), UNIFORM).image
    if np.dtype(dtype).kind in "ui":
        limits = np.iinfo(dtype)
        exact = np.rint(np.clip(exact, limits.min, limits.max))
    assert abs(found - exact).max() < 1e-2 * (scale if dtype is np.float32 else 1e-5)


@pytest.mark.parametrize("method", ["smoother", "gauss_markov", "tv"])
def test_colours_are_restored_each(method: str) -> None:
    image, _ = picture(UNIFORM, (3,))
    colours = np.stack([image, 0.5 * image, image[:, ::-1]], axis=2)
    found = restore(colours, UNIFORM, method=method, noise_sd=NOISE)
    assert found.image.shape == colours.shape
    grey = restore(image, UNIFORM, method=method, noise_sd=NOISE)
    assert psnr(found.image[:, :, 0], grey.image) > 30


@pytest.mark.parametrize("method", ["filter", "smoother", "gauss_markov", "tv", PNP])
def test_dead_and_saturated_pixels_are_filled(method: str) -> None:
    image, inside = picture(UNIFORM, (3,))
    mask = np.random.default_rng(2).random(image.shape) > 0.05
    mask[10:14, 30:36] = False
    spoilt = np.where(mask, image, np.nan)
    found = restore(spoilt, UNIFORM, method=method, mask=mask)
    whole = restore(image, UNIFORM, method=method)
    assert np.isfinite(found.image).all()
    assert psnr(found.image, inside) > psnr(whole.image, inside) - 3
    # What the pixels hold that are left out does not matter.
    other = restore(np.where(mask, image, 7.0), UNIFORM, method=method, mask=mask)
    assert (other.image == found.image).all()


@pytest.mark.parametrize("method", ["lag", "smoother", "gauss_markov", "tv"])
def test_a_psf_for_each_pixel_of_a_line(method: str) -> None:
    columns, scene = 90, blocks(40, 90 + 12, seed=4)
    share = np.linspace(0, 1, columns)[:, None]
    fast, slow = np.full(13, 1 / 13), np.r_[np.zeros(4), np.full(5, 1 / 5), np.zeros(4)]
    values = share * fast + (1 - share) * slow
    windows = np.lib.stride_tricks.sliding_window_view(scene, 13, axis=1)[:, :, ::-1]
    image = np.einsum("rkj,kj->rk", windows, values) + NOISE * np.random.default_rng(3).standard_normal((40, columns))
    inside = scene[:, 6 : 6 + columns]
    own = restore(image, Psf(values=values, origin=(6,)), method=method, noise_sd=NOISE).image
    same = restore(image, Psf(values=values.mean(axis=0), origin=(6,)), method=method, noise_sd=NOISE).image
    assert psnr(own, inside) > psnr(image, inside) + 2
    assert psnr(own, inside) > psnr(same, inside) + 1


def oblique() -> tuple[Psf, FloatArray, FloatArray]:
    angle = math.radians(25)
    path = np.linspace(-5, 5, 200) * np.array([[math.cos(angle)], [math.sin(angle)]])
    psf = motion_psf(path, None, SMALL, 1.0)
    image, inside = picture(psf.values, psf.origin, (70, 90))
    return psf, image, inside


def test_an_oblique_motion_on_lines_and_on_the_plane() -> None:
    psf, image, inside = oblique()
    middle = (slice(8, -8), slice(8, -8))
    found = {
        m: psnr(restore(image, psf, method=m, noise_sd=NOISE).image[middle], inside[middle])
        for m in ("smoother", "gauss_markov", "tv")
    }
    assert found["smoother"] > psnr(image[middle], inside[middle]) + 2
    assert found["gauss_markov"] > found["smoother"]
    assert found["tv"] > found["gauss_markov"]


def test_an_oblique_motion_with_pixels_missing() -> None:
    psf, image, inside = oblique()
    mask = np.random.default_rng(2).random(image.shape) > 0.01
    for method in ("smoother", "gauss_markov"):
        found = restore(np.where(mask, image, np.nan), psf, method=method, mask=mask)
        assert psnr(found.image, inside) > psnr(image, inside) + 1


def test_a_bent_motion_is_undone_on_the_plane_and_refused_on_lines() -> None:
    turn = np.linspace(0, math.pi, 200)
    psf = motion_psf(np.stack([5 * np.cos(turn), 5 * np.sin(turn)]), None, SMALL, 1.0)
    image, inside = picture(psf.values, psf.origin)
    assert psnr(restore(image, psf, method="tv").image, inside) > psnr(image, inside) + 3
    with pytest.raises(RestorationError, match=r"strays from one by .* pixels rms.*gauss_markov, tv or pnp"):
        restore(image, psf, method="smoother")


@pytest.mark.parametrize("method", ["gauss_markov", "tv"])
@pytest.mark.parametrize("noise_sd", [1e-2, 1e-3, 1e-5])
def test_less_noise_is_no_worse(method: str, noise_sd: float) -> None:
    """On the plane and with pixels missing, where the solvers iterate."""
    turn = np.linspace(0, math.pi, 200)
    psf = motion_psf(np.stack([4 * np.cos(turn), 4 * np.sin(turn)]), None, SMALL, 1.0)
    scene = blocks(60 + psf.values.shape[0] - 1, 70 + psf.values.shape[1] - 1, seed=3)
    image, inside = blurred(scene, psf.values, psf.origin)
    image = image + noise_sd * np.random.default_rng(1).standard_normal(image.shape)
    mask = np.random.default_rng(2).random(image.shape) > 0.02
    gain = {1e-2: 3, 1e-3: 5, 1e-5: 5}[noise_sd]
    for seen in (None, mask):
        found = restore(image, psf, method=method, mask=seen, noise_sd=noise_sd)
        assert psnr(found.image, inside) > psnr(image, inside) + gain


def test_almost_no_noise_is_more_than_conjugate_gradients_can_bear() -> None:
    """They are given more noise: with what there is they would end far from the scene."""
    turn = np.linspace(0, math.pi, 200)
    psf = motion_psf(np.stack([8 * np.cos(turn), 8 * np.sin(turn)]), None, SMALL, 1.0)
    image, inside = picture(psf.values, psf.origin, (128, 128))
    image = image - NOISE * (1 - 1e-3) * np.random.default_rng(1).standard_normal(image.shape)
    assert psnr(restore(image, psf, method="tv", noise_sd=1e-3 * NOISE).image, inside) > 40


def test_the_scanner_may_be_any() -> None:
    image, inside = picture(UNIFORM, (3,))
    fitted = restore(image, UNIFORM, method="smoother", noise_sd=NOISE)
    assert fitted.scanner is not None
    sharp = blocks(48, 200, seed=9)
    measured = from_correlation(measured_correlation(sharp, 3))
    third = restore(image, UNIFORM, method="smoother", noise_sd=NOISE, scanner=measured)
    assert psnr(third.image, inside) > psnr(image, inside) + 4
    # A scanner that is just a delay knows nothing of neighbours.
    delay = restore(image, UNIFORM, method="smoother", noise_sd=NOISE, scanner=first_order(0.0, 0.1))
    assert psnr(delay.image, inside) < psnr(fitted.image, inside)


@pytest.mark.parametrize("method", ["filter", "lag", "smoother"])
def test_a_known_background_before_the_line_helps(method: str) -> None:
    scene = np.full((30, 70), -1.0)
    scene[8:22, 2:30] = 2.0  # where the background ends is all that the picture cannot tell
    image, inside = blurred(np.pad(scene, ((0, 0), (3, 3)), constant_values=-1.0), UNIFORM, (3,))
    image = image + 0.05 * np.random.default_rng(1).standard_normal(image.shape)
    psf = Psf(values=UNIFORM, origin=(3,))
    known, unknown = (restore(image, psf, method=method, noise_sd=0.05, boundary=b).image for b in (-1.0, None))
    assert np.mean((known - inside)[8:22, :6] ** 2) < np.mean((unknown - inside)[8:22, :6] ** 2)


@pytest.mark.parametrize("method", [*QUICK, PNP])
def test_a_picture_of_one_row(method: str) -> None:
    image, inside = picture(UNIFORM, (3,), (1, 120))
    found = restore(image, UNIFORM, method=method, noise_sd=NOISE).image
    assert found.shape == (1, 120)
    assert np.isfinite(found).all()
    if method not in ("predictor", "filter"):
        assert psnr(found, inside) > psnr(image, inside) + 1


@pytest.mark.parametrize("method", QUICK)
@pytest.mark.parametrize("shape", [(1, 1), (5, 1), (1, 5), (2, 2), (8, 1), (1, 6), (6, 5)])
def test_small_pictures_are_restored_or_refused(method: str, shape: tuple[int, int]) -> None:
    """In less than six pixels nothing tells the noise from the scene, nor how rough it is."""
    image = np.random.default_rng(1).random(shape)
    on_line = method in ("predictor", "filter", "lag", "smoother")
    if (shape[1] if on_line else max(shape)) < 6:
        with pytest.raises(RestorationError, match=f"{shape[0]} x {shape[1]} pixels are too few"):
            restore(image, np.ones(1), method=method)
        return
    found = restore(image, np.ones(1), method=method, noise_sd=1e-6)
    assert np.isfinite(found.image).all()
    if method != "predictor":
        assert abs(found.image - image).max() < 1e-2


@pytest.mark.parametrize("method", QUICK)
def test_an_even_picture_stays_as_it_is(method: str) -> None:
    mask = np.random.default_rng(1).random((12, 30)) > 0.4
    for seen in (None, mask):
        found = restore(np.full((12, 30), 7.0), UNIFORM, method=method, mask=seen)
        assert abs(found.image - 7).max() < 1e-3


@pytest.mark.parametrize(
    ("image", "psf", "options", "says"),
    [
        (np.zeros((4, 5)), np.ones(6), {}, "6 taps, the picture 4 x 5"),
        (np.zeros((4, 9)), np.ones((5, 2)), {}, "5 x 2 taps"),
        (np.zeros((0, 5)), np.ones(2), {}, r"shape \(0, 5\)"),
        (np.zeros(5), np.ones(2), {}, r"shape \(5,\)"),
        (np.zeros((5, 5, 2)), np.ones(2), {}, "3 or 4 colours"),
        (np.zeros((5, 5), bool), np.ones(2), {}, "type bool"),
        (np.zeros((5, 5), complex), np.ones(2), {}, "type complex128"),
        (np.full((5, 5), np.nan), np.ones(2), {}, "25 of the picture's 25 pixels are not finite.*mask=np.isfinite"),
        (
            np.dstack([np.zeros((6, 8)), np.diag([np.inf] + [0.0] * 7)[:6], np.zeros((6, 8))]),
            UNIFORM,
            {},
            "1 of the .* 48",
        ),
        (np.zeros((5, 5)), np.ones(2), {"method": "magic"}, "use one of tv, pnp"),
        (np.zeros((5, 5)), np.ones(2), {"method": "lag", "direction": "up"}, "expected one of forward, backward"),
        (np.zeros((5, 5)), np.eye(3), {"method": "inverse"}, "along the picture's rows or columns"),
        (np.zeros((5, 5)), np.ones(2), {"noise_sd": 0.0}, "above zero, or method='inverse'"),
        (np.zeros((5, 5)), np.ones(2), {"mask": np.ones((5, 4), bool)}, r"mask has shape \(5, 4\)"),
        (np.zeros((5, 5)), np.ones(2), {"mask": np.zeros((5, 5), bool)}, "at least one"),
        (np.zeros((5, 5)), Psf(values=np.ones((4, 2)) / 2, origin=(0,)), {}, "PSFs for 4 pixels"),
    ],
)
def test_what_cannot_be_restored_is_refused_with_what_was_expected(
    image: FloatArray, psf: FloatArray, options: dict[str, Any], says: str
) -> None:
    with pytest.raises(RestorationError, match=says):
        restore(image, psf, **options)
