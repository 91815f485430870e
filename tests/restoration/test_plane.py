"""Gauss-Markov and total variation on the plane, against dense least squares and duality."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import fft, linalg

from aolink.numerics.arrays import FloatArray
from aolink.restoration import Psf, block_matching, non_local_means
from aolink.restoration.deblur import psnr
from aolink.restoration.markov import (
    DenseSolver,
    IterativeSolver,
    LineSolver,
    PeriodicPlane,
    Solver,
    dense_solver,
    differences_transposed,
    line_solver,
    make_solver,
    masked_line_solver,
    plane_solver,
    roughness,
)
from aolink.restoration.tv import (
    ITERATIONS,
    WEIGHT,
    plane_total_variation,
    plane_weight,
    total_variation,
)
from tests.restoration.scenes import LOPSIDED, UNIFORM, blocks, blur_matrix, blurred, roughness_matrix

SHAPE = (11, 14)
CORNER = np.array([[0.0, 0.1, 0.2], [0.1, 0.3, 0.0], [0.25, 0.0, 0.05]])


def dense(psf: Psf, images: FloatArray, kappa: float, seen: NDArray[np.bool_] | None = None) -> FloatArray:
    H = blur_matrix(SHAPE, psf.values)
    taps = np.atleast_2d(psf.values).shape
    wide = (SHAPE[0] + taps[0] - 1, SHAPE[1] + taps[1] - 1)
    W = np.ones(H.shape[0]) if seen is None else seen.ravel().astype(float)
    A = H.T @ (W[:, None] * H) + kappa * roughness_matrix(wide)
    return np.array([np.linalg.solve(A, H.T @ (W * y.ravel())).reshape(wide) for y in images])


@pytest.mark.parametrize("values", [UNIFORM, LOPSIDED, np.ones(1)], ids=len)
@pytest.mark.parametrize("kappa", [1e-4, 0.3])
def test_along_lines_it_is_dense_least_squares(values: FloatArray, kappa: float) -> None:
    psf = Psf(values=values, origin=(0,))
    images = np.random.default_rng(1).standard_normal((2, *SHAPE))
    solver = line_solver(psf, SHAPE, kappa)
    assert abs(solver.solve(solver.project(images)) - dense(psf, images, kappa)).max() < 1e-10


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("line", [False, True])
@pytest.mark.parametrize("iterative", [False, True])
def test_on_the_plane_and_masked_it_is_dense_least_squares(line: bool, masked: bool, iterative: bool) -> None:
    """Solved directly where the frame is as small as here, and by conjugate gradients."""
    rng = np.random.default_rng(2)
    psf = Psf(values=LOPSIDED, origin=(3,)) if line else Psf(values=CORNER, origin=(1, 1))
    images = rng.standard_normal((2, *SHAPE))
    seen = rng.random(SHAPE) > 0.15 if masked else None
    solver: Solver = dense_solver(psf, SHAPE, 0.01, seen)
    if iterative and line and seen is not None:
        solver = masked_line_solver(psf, seen, 0.01)
    elif iterative:
        solver = plane_solver(psf, SHAPE, 0.01, seen)
    found = solver.solve(solver.project(images), solver.guess(images), 1e-12)
    assert abs(found - dense(psf, images, 0.01, seen)).max() < 1e-8
    expected = (slice(1, 12), slice(1, 15)) if not line else (slice(0, 11), slice(1, 15))
    places = np.indices(found.shape[1:])
    assert (places[:, *solver.frame] == places[:, *expected]).all()


def test_small_frames_are_solved_directly_and_large_ones_are_not() -> None:
    mask = np.ones((40, 40), bool)
    mask[3, 4] = False
    plane, line = Psf(values=CORNER, origin=(1, 1)), Psf(values=UNIFORM, origin=(3,))
    kinds = [
        type(make_solver(psf, shape, 0.01, None if seen is None else seen[: shape[0], : shape[1]]))
        for psf, shape, seen in (
            (plane, (20, 20), None), (plane, (40, 40), None), (line, (20, 20), mask), (line, (40, 40), mask),
            (line, (20, 20), None),
        )
    ]  # fmt: skip
    assert kinds == [DenseSolver, IterativeSolver, DenseSolver, IterativeSolver, LineSolver]


def test_white_pixels_in_the_place_of_white_differences() -> None:
    images = np.random.default_rng(3).standard_normal((1, *SHAPE))
    H = blur_matrix(SHAPE, CORNER)
    expected = np.linalg.solve(H.T @ H + 0.05 * np.eye(H.shape[1]), H.T @ images.ravel())
    solver = plane_solver(Psf(values=CORNER, origin=(1, 1)), SHAPE, 0.05, white=True)
    found = solver.solve(solver.project(images), None, 1e-12)
    assert abs(found.ravel() - expected).max() < 1e-8


def test_differences_and_their_transpose_are_adjoint() -> None:
    rng = np.random.default_rng(4)
    x, along, down = rng.standard_normal((5, 6)), rng.standard_normal((5, 5)), rng.standard_normal((4, 6))
    one = (np.diff(x, axis=1) * along).sum() + (np.diff(x, axis=0) * down).sum()
    assert one == pytest.approx((x * differences_transposed(along, down)).sum())
    assert roughness(x).ravel() == pytest.approx(roughness_matrix((5, 6)) @ x.ravel())


def corners(across: FloatArray, upright: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Views of the four gradients of each pixel, of differences with nothing beyond the edges."""
    return [(a, d) for a in (across[:, :-1], across[:, 1:]) for d in (upright[:-1], upright[1:])]


def variation(x: FloatArray) -> float:
    """The mean of the four total variations."""
    gradients = corners(np.pad(np.diff(x, axis=1), ((0, 0), (1, 1))), np.pad(np.diff(x, axis=0), ((1, 1), (0, 0))))
    return float(np.mean([np.hypot(*each).sum() for each in gradients]))


@pytest.mark.slow
def test_total_variation_meets_its_dual() -> None:
    """Without blur the dual problem is plain: a gradient field p, |p| <= w, whose divergence makes the picture."""
    rng = np.random.default_rng(5)
    scene = blocks(24, 30)
    noisy = scene + 0.05 * rng.standard_normal(scene.shape)
    point, s2, weight = Psf(values=np.ones(1), origin=(0,)), 0.05**2, 40.0
    x, _ = total_variation(lambda kappa: make_solver(point, scene.shape, kappa), noisy[None], s2, weight, 400)
    w = WEIGHT * np.sqrt(weight)
    primal = ((noisy - x[0]) ** 2).sum() / (2 * s2) + w * variation(x[0])
    # The dual by projected gradients, a different way altogether: a field for each of a pixel's four gradients.
    fields = np.zeros((4, 2, *scene.shape))

    def flow() -> NDArray[np.floating[Any]]:
        across, upright = np.zeros((24, 31)), np.zeros((25, 30))
        for views, field in zip(corners(across, upright), fields, strict=True):
            for view, part in zip(views, field, strict=True):
                view += part
        return differences_transposed(across[:, 1:-1], upright[1:-1])

    for _ in range(3000):
        residual = noisy - s2 * flow()
        along, down = np.diff(residual, axis=1), np.diff(residual, axis=0)
        fields += np.array(corners(np.pad(along, ((0, 0), (1, 1))), np.pad(down, ((1, 1), (0, 0))))) / (32 * s2)
        fields /= np.maximum(np.hypot(fields[:, :1], fields[:, 1:]) / (w / 4), 1)
    bound = (noisy * flow()).sum() - s2 / 2 * (flow() ** 2).sum()
    # What is minimised is the proximal average of the four, which is nearly their mean.
    assert bound <= primal <= bound * 1.002


@pytest.mark.parametrize("values", [UNIFORM, CORNER], ids=["line", "plane"])
def test_few_iterations_are_enough(values: FloatArray) -> None:
    origin = tuple(n // 2 for n in values.shape)
    image, inside = blurred(blocks(60, 90), values, origin)
    image = image + 0.01 * np.random.default_rng(6).standard_normal(image.shape)
    psf = Psf(values=values, origin=origin)
    found = []
    for iterations in (ITERATIONS, 200):
        x, solver = total_variation(
            lambda kappa: make_solver(psf, image.shape, kappa), image[None], 1e-4, 60.0, iterations
        )
        found.append(x[0][solver.frame])
    assert abs(psnr(found[0], inside) - psnr(found[1], inside)) < 0.35
    assert psnr(found[0], inside) > psnr(image, inside) + 4


@pytest.mark.slow
@pytest.mark.parametrize("masked", [False, True])
def test_on_the_plane_total_variation_is_what_exact_steps_find(masked: bool) -> None:
    rng = np.random.default_rng(7)
    image, inside = blurred(blocks(26, 30), CORNER, (1, 1))
    image = image + 0.02 * rng.standard_normal(image.shape)
    seen = rng.random(image.shape) > 0.1 if masked else None
    psf, s2, weight = Psf(values=CORNER, origin=(1, 1)), 0.02**2, 50.0
    plane, w = PeriodicPlane.of(psf, (image.shape[0], image.shape[1])), plane_weight(s2, weight)
    W = np.ones(image.shape) if seen is None else seen
    H = blur_matrix(image.shape, CORNER)

    def objective(x: FloatArray) -> float:
        return float((W.ravel() * (image.ravel() - H @ x.ravel()) ** 2).sum() / (2 * s2) + w * variation(x))

    exact, solver = total_variation(
        lambda kappa: dense_solver(psf, image.shape, kappa, seen), image[None], s2, (w / WEIGHT) ** 2, 1000
    )
    found, few = (plane_total_variation(plane, image[None], s2, weight, seen, *n) for n in ((2000,), ()))
    assert found.shape == few.shape == exact.shape
    assert plane.frame == solver.frame
    least = objective(exact[0])
    assert least * 0.999 < objective(found[0]) < least * 1.001  # their penalties differ, so their averages do
    assert abs(psnr(few[0][plane.frame], inside) - psnr(exact[0][plane.frame], inside)) < 0.2


def test_the_weight_on_the_plane_does_not_depend_on_the_unit_of_light() -> None:
    image, _ = blurred(blocks(40, 50), CORNER, (1, 1))
    image = image + 0.01 * np.random.default_rng(8).standard_normal(image.shape)
    plane = PeriodicPlane.of(Psf(values=CORNER, origin=(1, 1)), (image.shape[0], image.shape[1]))
    one = plane_total_variation(plane, image[None], 1e-4, 60.0)
    thousand = plane_total_variation(plane, 1000 * image[None], 1e2, 60e-6)
    np.testing.assert_allclose(thousand, 1000 * one, atol=0.05)  # in single precision


def in_precision(single: bool, psf: Psf, image: np.ndarray, noise_variance: float) -> np.ndarray:
    """The picture restored by total variation, in single precision or in double."""
    return total_variation(
        lambda kappa: make_solver(psf, image.shape, kappa, single=single), image[None], noise_variance, 60.0
    )[0]


def test_single_precision_is_enough_for_total_variation() -> None:
    image, _ = blurred(blocks(40, 80), UNIFORM, (3,))
    psf = Psf(values=UNIFORM, origin=(3,))
    one, two = (in_precision(single, psf, image, 1e-4) for single in (True, False))
    assert one.dtype == np.float32
    assert abs(one - two).max() < 1e-3


@pytest.mark.parametrize("noise_sd", [1e-2, 1e-3, 1e-4, 1e-5])
def test_single_precision_is_wrong_by_less_than_the_noise(noise_sd: float) -> None:
    """Its error grows with one over kappa: where the noise is small, it is not used."""
    image, _ = blurred(blocks(40, 80), LOPSIDED, (3,))
    image = image + noise_sd * np.random.default_rng(1).standard_normal(image.shape)
    psf = Psf(values=LOPSIDED, origin=(3,))
    one, two = (in_precision(single, psf, image, noise_sd**2) for single in (True, False))
    assert np.std(one - two) < 0.1 * noise_sd


def test_one_plane_solver_is_the_other() -> None:
    images = np.random.default_rng(7).standard_normal((1, *SHAPE))
    line, plane = Psf(values=LOPSIDED, origin=(1,)), Psf(values=LOPSIDED[None], origin=(0, 1))
    exact, iterative = line_solver(line, SHAPE, 0.02), plane_solver(plane, SHAPE, 0.02)
    a, b = exact.solve(exact.project(images)), iterative.solve(iterative.project(images), None, 1e-12)
    assert abs(a - b).max() < 1e-8
    assert exact.frame[1] == iterative.frame[1]


def test_non_local_means_as_its_definition() -> None:
    rng = np.random.default_rng(8)
    image = blocks(20, 22) + 0.05 * rng.standard_normal((20, 22))
    found = non_local_means(image, 0.05)
    wide = np.pad(image, 7, mode="reflect")
    y, x, total, weights = 10, 9, 0.0, 0.0
    own = wide[y + 5 : y + 10, x + 5 : x + 10]
    for dy in range(-7, 8):
        for dx in range(-7, 8):
            other = wide[y + dy + 5 : y + dy + 10, x + dx + 5 : x + dx + 10]
            distance = ((own - other) ** 2).mean()
            weight = np.exp(-max(distance - 2 * 0.05**2, 0) / (0.8 * 0.05) ** 2)
            total, weights = total + weight * wide[y + dy + 7, x + dx + 7], weights + weight
    assert found[y, x] == pytest.approx(total / weights, rel=1e-6)
    scene = blocks(90, 90)
    noisy = scene + 0.05 * rng.standard_normal(scene.shape)
    assert psnr(non_local_means(noisy, 0.05), scene) > psnr(noisy, scene) + 4


def one_group(guide: FloatArray, noisy: FloatArray, y: int, x: int, noise_sd: float, wiener: bool) -> tuple[Any, ...]:
    """Places, patches and weight of the group of a patch, from the definition."""
    found = []
    for v in range(max(y - 8, 0), min(y + 8, guide.shape[0] - 8) + 1):
        for u in range(max(x - 8, 0), min(x + 8, guide.shape[1] - 8) + 1):
            away = ((guide[v : v + 8, u : u + 8] - guide[y : y + 8, x : x + 8]) ** 2).sum()
            found.append((-1.0 if (v, u) == (y, x) else away, v, u))
    places = [(v, u) for _, v, u in sorted(found)[:16]]
    H = linalg.hadamard(16) / 4

    def spectrum(image: FloatArray) -> FloatArray:
        patches = np.array([fft.dctn(image[v : v + 8, u : u + 8], norm="ortho") for v, u in places])
        return np.asarray(np.tensordot(H, patches, 1))

    shrink = spectrum(guide) ** 2 / (spectrum(guide) ** 2 + noise_sd**2)
    if not wiener:
        shrink = (abs(spectrum(noisy)) > 2.7 * noise_sd).astype(float)
        shrink[0, 0, 0] = 1
    patches = np.tensordot(H, shrink * spectrum(noisy), 1)
    return places, fft.idctn(patches, axes=(1, 2), norm="ortho"), 1 / (shrink**2).sum()


def test_block_matching_as_its_definition() -> None:
    rng = np.random.default_rng(9)
    scene = blocks(27, 31)
    noisy = scene + 0.05 * rng.standard_normal(scene.shape)
    level, window = noisy.mean(), np.outer(np.kaiser(8, 2.0), np.kaiser(8, 2.0))
    guide = image = noisy - level
    for wiener in (False, True):
        total, weight = np.zeros(scene.shape), np.zeros(scene.shape)
        for y in sorted({*range(0, 20, 3), 19}):
            for x in sorted({*range(0, 24, 3), 23}):
                places, patches, trust = one_group(guide, image, y, x, 0.05, wiener)
                for (v, u), patch in zip(places, patches, strict=True):
                    total[v : v + 8, u : u + 8] += trust * window * patch
                    weight[v : v + 8, u : u + 8] += trust * window
        guide = total / weight
    found = block_matching(noisy, 0.05)
    np.testing.assert_allclose(found, guide + level, atol=1e-5)


@pytest.mark.parametrize("shape", [(1, 60), (1, 3), (5, 9), (8, 8), (60, 12)])
def test_block_matching_of_small_pictures_makes_their_noise_less(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(10).standard_normal(shape)
    found = block_matching(5 + noise, 1.0)
    assert found.shape == shape
    assert abs(found.mean() - 5 - noise.mean()) < 0.2
    assert found.std() < 0.5 * noise.std()


def test_block_matching_of_a_tall_picture_in_bands_is_that_of_a_broad_one_at_once() -> None:
    scene = blocks(40, 300)
    noisy = scene + 0.05 * np.random.default_rng(11).standard_normal(scene.shape)
    whole, bands = block_matching(noisy, 0.05), block_matching(noisy.T, 0.05).T
    assert abs(whole - bands).max() < 1e-3  # sums in another order move a coefficient across the threshold now and then
    assert psnr(whole, scene) > psnr(non_local_means(noisy, 0.05), scene)
