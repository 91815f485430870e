"""A Shack-Hartmann frame that another library propagates: its slopes are those of the wavefront."""

from typing import Any

import numpy as np
import pytest

from aolink.optics.lattice import find_lattice, match
from aolink.optics.lenslets import Lenslets
from aolink.optics.wavefront import SpotReconstructor, lenslet_zernike_slopes, modal_reconstructor, wavefront_rms
from aolink.optics.zernike import zernike, zernike_gradient
from tests.needs import needed
from tests.spot_frames import square_lattice

hcipy = needed("hcipy")
DIAMETER, N, PIXELS, WAVELENGTH, F_NUMBER = 5e-3, 12, 384, 700e-9, 40
PITCH = DIAMETER / N
LENSLETS = Lenslets(grid=(13, 13), pitch_m=PITCH, focal_length_m=F_NUMBER * PITCH, pupil_diameter_m=DIAMETER)
PIXEL = DIAMETER * 1.1 / PIXELS
COEFFICIENTS = {4: 120e-9, 6: -80e-9, 7: 60e-9, 11: 30e-9}


@pytest.fixture(scope="module")
def frames() -> tuple[np.ndarray, np.ndarray]:
    """Images behind the lenslets without aberration and with it, in counts."""
    grid = hcipy.make_pupil_grid(PIXELS, DIAMETER * 1.1)
    aperture = hcipy.make_circular_aperture(DIAMETER)(grid)
    optics = hcipy.SquareShackHartmannWavefrontSensorOptics(grid, F_NUMBER, N, DIAMETER)
    points = np.stack([grid.x, grid.y], axis=1) / (DIAMETER / 2)
    path = sum(c * zernike(i, points) for i, c in COEFFICIENTS.items())
    images = []
    for phase in (np.zeros(len(points)), 2 * np.pi / WAVELENGTH * path):
        light = hcipy.Wavefront(aperture * np.exp(1j * phase), WAVELENGTH)
        images.append(np.asarray(optics.forward(light).power).reshape(PIXELS, PIXELS))
    return tuple(1000 + 20_000 * image / images[0].max() for image in images)


@pytest.fixture(scope="module")
def measured(frames: Any) -> tuple[np.ndarray, np.ndarray]:
    """Displacements of the spots, pixels, and the lenslet of each."""
    reference, frame = (find_lattice(f) for f in frames)
    moved = match(frame, reference)
    rest = {tuple(node): spot for node, spot in zip(reference.nodes.tolist(), reference.spots, strict=True)}
    at_rest = np.array([rest[tuple(node)] for node in moved.nodes.tolist()])
    assert len(moved.spots) == len(reference.spots)
    node = np.rint((at_rest - (PIXELS - 1) / 2) * PIXEL / PITCH).astype(int) + 6
    return moved.spots - at_rest, node[:, 1] * 13 + node[:, 0]


def expected_slopes() -> np.ndarray:
    """Slopes of the known wavefront, radians, (spots, 2)."""
    r = DIAMETER / 2
    return LENSLETS.mean_slopes(
        lambda p: np.sum([c * zernike_gradient(i, p / r) / r for i, c in COEFFICIENTS.items()], axis=0)
    )


def whole(lenslet: np.ndarray) -> np.ndarray:
    return np.asarray(LENSLETS.light[lenslet] > 0.999)


def test_the_lattice_is_that_of_the_lenslets(frames):
    lattice = find_lattice(frames[0])
    assert lattice.pitch * PIXEL == pytest.approx(PITCH, rel=1e-3)
    assert abs(lattice.turn_deg) < 0.05


def test_slopes_are_the_wavefronts_within_a_twentieth_of_a_pixel(measured):
    shifts, lenslet = measured
    per_pixel = PIXEL / LENSLETS.focal_length_m
    expected = expected_slopes()[lenslet] / per_pixel
    error = (shifts - expected)[whole(lenslet)]
    assert np.abs(expected).max() > 1.0  # they move by more than a pixel
    assert whole(lenslet).sum() > 70
    assert np.abs(error).max() < 0.05


def test_the_wavefront_comes_back(measured):
    shifts, lenslet = measured
    use = whole(lenslet)
    slopes = np.full((169, 2), np.nan)
    slopes[lenslet[use]] = shifts[use] * PIXEL / LENSLETS.focal_length_m
    weights = np.where(np.isfinite(slopes[:, 0]), LENSLETS.light, 0.0)
    found = modal_reconstructor(lenslet_zernike_slopes(LENSLETS, 15), weights) @ np.nan_to_num(slopes).ravel()
    true = np.array([COEFFICIENTS.get(i, 0.0) for i in range(2, 16)])
    np.testing.assert_allclose(found, true, atol=3e-9)  # a two-hundredth of a wave
    # And zone by zone.
    lit = np.isfinite(slopes[:, 0]).reshape(13, 13)
    values = np.full(lit.shape, np.nan)
    values[lit] = SpotReconstructor(*square_lattice(lit, PITCH))(slopes.reshape(13, 13, 2)[lit])
    points = LENSLETS.centres_m / (DIAMETER / 2)
    path = np.sum([c * zernike(i, points) for i, c in COEFFICIENTS.items()], axis=0).reshape(13, 13)
    assert wavefront_rms(values - path) < 0.1 * wavefront_rms(np.where(lit, path, np.nan))
    assert wavefront_rms(values - path) < WAVELENGTH / 60  # of light without it, 99 % is in the image's peak
