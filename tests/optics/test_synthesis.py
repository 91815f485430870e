"""Frame synthesis: against fine-grid integrals, histograms and the laws of detectors."""

import numpy as np
import pytest
from scipy import integrate

from aolink.errors import FrameError
from aolink.optics.kernel import pixel_mass
from aolink.optics.sensor import Kernel
from aolink.optics.synthesis import Detector, Psi, light_in_windows

RNG = np.random.default_rng(1)
PATHS = 5.5 + RNG.uniform(-1.5, 1.5, (20, 2, 1)) + np.cumsum(RNG.normal(0, 0.05, (20, 2, 100)), axis=2)


def test_delta_is_the_histogram_of_the_path():
    windows = light_in_windows(Psi(shape="delta"), 12, PATHS)
    edges = np.arange(13.0) - 0.5
    for window, (x, y) in zip(windows, PATHS, strict=True):
        np.testing.assert_allclose(window, np.histogram2d(y, x, (edges, edges))[0] / 100, atol=1e-12)


def test_diffraction_is_the_integral_of_sinc_squared():
    psi = Psi(shape="sinc2", zero_px=1.7)
    place = np.array([[[5.3], [4.1]]])
    (window,) = light_in_windows(psi, 12, place)
    along = [
        [integrate.quad(lambda w, c=c: np.sinc((w - c) / 1.7) ** 2 / 1.7, k - 0.5, k + 0.5)[0] for k in range(12)]
        for c in (5.3, 4.1)
    ]
    np.testing.assert_allclose(window, np.outer(along[1], along[0]), atol=1e-6)
    wide = light_in_windows(psi, 400, np.full((1, 2, 1), 199.5)).sum()
    assert wide == pytest.approx(1, abs=4 * 1.7 / np.pi**2 / 200)  # tails of 1 / (pi^2 x) to each side


def test_a_path_smears_as_the_mean_of_its_steps():
    for psi in (Psi(shape="sinc2", zero_px=1.7), Psi(shape="image", image=RNG.random((5, 7)), finer=3)):
        whole = light_in_windows(psi, 12, PATHS)
        steps = np.mean([light_in_windows(psi, 12, PATHS[..., k : k + 1]) for k in range(100)], axis=0)
        np.testing.assert_allclose(whole, steps, atol=1e-12)


def test_an_image_of_a_gaussian_is_the_gaussian_kernel():
    fine, sd = 8, 1.2
    w = (np.arange(121) - 60) / fine
    gaussian = np.exp(-(w**2) / (2 * sd**2))
    psi = Psi(shape="image", image=np.outer(gaussian, gaussian), finer=fine)
    kernel, edges = Kernel(shape="gaussian", sigma=sd * np.sqrt(2)), np.arange(13.0) - 0.5
    expected = np.stack([pixel_mass(kernel, edges, p[1]).T @ pixel_mass(kernel, edges, p[0]) / 100 for p in PATHS])
    assert np.abs(light_in_windows(psi, 12, PATHS) - expected).max() < 2e-3 * expected.max()


def test_an_image_keeps_its_moments_and_its_orientation():
    image = np.zeros((5, 9))
    image[2, 4], image[2, 8], image[0, 4] = 2.0, 1.0, 1.0  # one to the right by 4, one up by 2
    (window,) = light_in_windows(Psi(shape="image", image=image), 16, np.array([[[7.3], [6.2]]]))
    assert window.sum() == pytest.approx(1)
    y, x = np.mgrid[:16, :16]
    assert (window * x).sum() == pytest.approx(7.3 + 4 / 4)
    assert (window * y).sum() == pytest.approx(6.2 - 2 / 4)


@pytest.mark.parametrize("finer", [1, 3])
def test_an_image_lands_where_each_step_puts_it(finer):
    """Against the image laid down step by step, with paths that leave the window and spots that are never in it."""
    rng = np.random.default_rng(5)
    image, side, steps = rng.random((7, 5)), 6, 20
    paths = rng.uniform(-4, 10, (4, 2, steps))
    paths[3] += 100
    light = light_in_windows(Psi(shape="image", image=image, finer=finer), side, paths)
    n, edge = side * finer, 200
    for spot in range(4):
        fine = np.zeros((n + 2 * edge, n + 2 * edge))
        for x, y in (paths[spot].T + 0.5) * finer - 0.5:
            i, j = int(np.floor(y)), int(np.floor(x))
            for di, dj in np.ndindex(2, 2):
                weight = abs(1 - di - (y - i)) * abs(1 - dj - (x - j)) / steps / image.sum()
                if i < n + 20 and j < n + 20:
                    fine[i + di - 3 + edge : i + di + 4 + edge, j + dj - 2 + edge : j + dj + 3 + edge] += weight * image
        expected = fine[edge : edge + n, edge : edge + n].reshape(side, finer, side, finer).sum(axis=(1, 3))
        np.testing.assert_allclose(light[spot], expected, atol=1e-14)


def test_light_that_leaves_the_window_is_gone():
    for psi in (Psi(shape="delta"), Psi(shape="image", image=np.ones((3, 3)))):
        assert light_in_windows(psi, 8, np.full((1, 2, 1), 50.0)).sum() == 0


@pytest.mark.parametrize(
    "wrong",
    [{"shape": "sinc2"}, {"shape": "image"}, {"shape": "image", "image": np.ones((2, 3))},
     {"shape": "image", "image": np.zeros((3, 3))}],
)  # fmt: skip
def test_kernels_that_are_none_are_refused(wrong):
    with pytest.raises(FrameError):
        Psi(**wrong)


def test_counts_have_the_mean_and_variance_of_their_causes():
    rng = np.random.default_rng(2)
    flat, dark = rng.uniform(0.8, 1.2, (30, 40)), rng.uniform(0, 50, (30, 40))
    detector = Detector(
        bits=12, electrons_per_count=2.5, offset_counts=100, read_noise_electrons=6.0, background_electrons=30.0,
        dark_electrons=dark, flat=flat,
    )  # fmt: skip
    light = rng.uniform(0, 2000, (30, 40))
    frames = detector.expose(np.broadcast_to(light, (2000, 30, 40)), rng).astype(float)
    electrons = (light + 30) * flat + dark
    variance = (electrons + 36) / 2.5**2 + 1 / 12
    assert np.abs((frames.mean(axis=0) - 100 - electrons / 2.5) / np.sqrt(variance / 2000)).max() < 5
    np.testing.assert_allclose((frames.var(axis=0) / variance).mean(), 1, atol=0.01)


@pytest.mark.parametrize("bits", [8, 10, 16])
def test_counts_end_at_full_scale_and_dead_pixels_read_the_offset(bits):
    dead = np.zeros((4, 4), dtype=bool)
    dead[1, 2] = True
    detector = Detector(bits=bits, offset_counts=7, dead=dead)
    counts = detector.expose(np.full((4, 4), 1e6), np.random.default_rng(0))
    assert counts.dtype == np.uint16
    assert counts[1, 2] == 7
    assert (counts[~dead] == 2**bits - 1).all()


@pytest.mark.parametrize("wrong", [{"bits": 7}, {"bits": 17}, {"electrons_per_count": 0.0}])
def test_detectors_that_are_none_are_refused(wrong):
    with pytest.raises(FrameError, match="8 to 16 bits"):
        Detector(**wrong)
