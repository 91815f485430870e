"""The PSF of a motion and its uncertainty; what is no PSF."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import linalg

from aolink.errors import RestorationError
from aolink.exposure import step_shares
from aolink.optics.kernel import pixel_mass
from aolink.optics.plane import pixel_mass_2d
from aolink.optics.sensor import Kernel
from aolink.restoration import Psf, motion_psf, motion_psf_by_root
from aolink.restoration.psf import along_line, as_psf

KERNEL = Kernel(shape="gaussian", sigma=0.05)
SCALE = 0.04
STEPS = np.linspace(0, 1, 60)
PATH = 0.3 * np.exp(-1.5 * STEPS) * np.sin(3 * math.pi * STEPS) + 0.02


def on_grid(psf: Psf, low: int, high: int) -> np.ndarray:
    """Values of a PSF along the rows at displacements low .. high."""
    out = np.zeros(high - low + 1)
    first = -psf.origin[0] - low
    out[first : first + len(psf.values)] = psf.values
    return out


def test_a_known_path_gives_the_sensors_own_light() -> None:
    psf = motion_psf(PATH, None, KERNEL, SCALE)
    edges = (np.arange(-30.0, 32.0) - 0.5) * SCALE
    expected = pixel_mass(KERNEL, edges, PATH).mean(axis=0)
    assert abs(on_grid(psf, -30, 30) - expected).max() < 1e-5
    assert psf.values.sum() == pytest.approx(1, abs=1e-12)
    assert psf.modes.shape == (0, *psf.values.shape)


def not_round(correlation: float) -> Kernel:
    covariance = np.array([[0.05**2, correlation * 0.05 * 0.03], [correlation * 0.05 * 0.03, 0.03**2]])
    (a, b), (c, d) = linalg.sqrtm(2 * covariance).real
    return Kernel(shape="gaussian", sigma=0.06, matrix=((a, b), (c, d)))


@pytest.mark.parametrize("kernel", [KERNEL, *map(not_round, (-0.95, -0.5, 0.02, 0.5, 0.9))])
def test_a_path_on_the_plane_gives_the_sensors_own_light(kernel: Kernel) -> None:
    """Against quadrature over each pixel."""
    path = np.stack([PATH, 0.1 * np.cos(4 * STEPS)])
    psf = motion_psf(path, None, kernel, SCALE)
    edges = (np.arange(-30.0, 32.0) - 0.5) * SCALE
    expected = pixel_mass_2d(kernel.covariance, edges, edges, path.T).mean(axis=0)
    (row, column), (rows, columns) = psf.origin, psf.values.shape
    inside = expected[30 - row : 30 - row + rows, 30 - column : 30 - column + columns]
    assert abs(psf.values - inside).max() < (1e-5 if kernel is KERNEL else 2e-5)
    assert inside.sum() > 0.9999
    # Along a line it is as wide as it is in that direction.
    along = Kernel(shape="gaussian", sigma=math.sqrt(2 * kernel.covariance[0, 0]))
    line, narrow = (motion_psf(PATH, None, k, SCALE) for k in (kernel, along))
    assert line.values == pytest.approx(narrow.values, abs=1e-12)


@pytest.mark.parametrize("plane", [False, True])
@pytest.mark.parametrize("offset", [3 / 16, 0.5, 15 / 16])
def test_steps_that_are_seen_in_part_are_those_of_sixteen_times_finer_ones(offset: float, plane: bool) -> None:
    """An exposure of 12 steps that starts late in its first, and what its path's error makes of it."""
    n, late = 12, round(16 * offset)
    path = 0.3 * np.sin(np.arange(n + 1)) + 0.1
    if plane:
        path = np.stack([path, 0.2 * np.cos(np.arange(n + 1))])
    root = 0.02 * np.random.default_rng(1).standard_normal((path.size, 3))
    fine = np.repeat(path, 16, axis=-1)[..., late : late + 16 * n]
    fine_root = np.repeat(root.reshape(-1, n + 1, 3), 16, axis=1)[:, late : late + 16 * n].reshape(-1, 3)
    ours = motion_psf_by_root(path, root, KERNEL, SCALE, step_shares(n, offset))
    expected = motion_psf_by_root(fine, fine_root, KERNEL, SCALE)
    assert ours.origin == expected.origin
    assert abs(ours.values - expected.values).max() < 1e-12
    assert ours.sd == pytest.approx(expected.sd, abs=1e-12)
    whole = motion_psf_by_root(path, root, KERNEL, SCALE)
    assert whole.values.shape != ours.values.shape or abs(whole.values - ours.values).max() > 1e-3


@pytest.mark.parametrize("plane", [False, True])
def test_a_covariance_is_as_good_as_its_root(plane: bool) -> None:
    path = np.stack([PATH, PATH[::-1]]) if plane else PATH
    root = 0.03 * np.random.default_rng(1).standard_normal((path.size, 4))
    one, two = motion_psf_by_root(path, root, KERNEL, SCALE), motion_psf(path, root @ root.T, KERNEL, SCALE)
    assert two.values == pytest.approx(one.values, abs=1e-10)
    assert two.sd == pytest.approx(one.sd, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("plane", [False, True])
def test_expected_psf_and_its_sd_are_those_of_drawn_paths(plane: bool) -> None:
    rng = np.random.default_rng(1)
    path = np.stack([PATH, 0.5 * PATH[::-1]]) if plane else PATH
    # The range is uncertain, and so is each step a little.
    flat = path.ravel()
    covariance = 0.05**2 * np.outer(flat, flat) + 0.004**2 * np.eye(flat.size)
    psf = motion_psf(path, covariance, KERNEL, SCALE)
    draws = rng.multivariate_normal(flat, covariance, 1500).reshape(1500, *path.shape)
    values = []
    for draw in draws:
        one = motion_psf(draw, None, KERNEL, SCALE)
        room = np.zeros(tuple(2 * 25 + 1 for _ in one.origin))
        room[tuple(slice(25 - o, 25 - o + n) for o, n in zip(one.origin, one.values.shape, strict=True))] = one.values
        values.append(room[tuple(slice(25 - o, 25 - o + n) for o, n in zip(psf.origin, psf.values.shape, strict=True))])
    mean, sd = np.mean(values, axis=0), np.std(values, axis=0)
    error = sd / math.sqrt(len(draws))
    assert (abs(psf.values - mean) < 5 * error + 1e-5).all()
    assert abs(psf.sd - sd).max() < 0.25 * sd.max()
    assert np.linalg.norm(psf.sd - sd) < 0.15 * np.linalg.norm(sd)


def test_no_displacement_stays_in_reach_of_a_path_far_away() -> None:
    psf = motion_psf(np.full(10, 20 * SCALE), None, Kernel(shape="gaussian", sigma=0.001), SCALE)
    assert psf.origin == (0,)
    assert np.flatnonzero(psf.values > 0.5).tolist() == [20]


@settings(max_examples=30)
@given(st.floats(-math.pi / 2 + 0.01, math.pi / 2 - 0.01), st.floats(6, 25))
def test_a_straight_line_is_found_at_any_angle(angle: float, length: float) -> None:
    path = np.linspace(0, length, 150) * np.array([[math.cos(angle)], [math.sin(angle)]])
    line = along_line(motion_psf(path, None, Kernel(shape="gaussian", sigma=0.3), 1.0))
    away = (line.angle_rad - angle + math.pi / 2) % math.pi - math.pi / 2
    assert abs(away) < 0.06
    assert line.deviation_px < 0.3
    taps = np.arange(len(line.psf.values)) - line.psf.origin[0]
    assert abs(abs(taps @ line.psf.values) - length / 2) < 0.1


def test_a_bent_path_is_no_line() -> None:
    turn = np.linspace(0, math.pi, 100)
    line = along_line(motion_psf(np.stack([8 * np.cos(turn), 8 * np.sin(turn)]), None, KERNEL, 1.0))
    assert line.deviation_px > 2


def test_plain_numbers_are_normalised_and_centred() -> None:
    psf = as_psf([1.0, 2.0, 1.0, 0.0])
    assert psf.values.tolist() == [0.25, 0.5, 0.25, 0.0]
    assert psf.origin == (2,)
    assert as_psf(np.ones((3, 5))).origin == (1, 2)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ([], "at least one tap"),
        (np.zeros((2, 2, 2)), "at least one tap"),
        ([0.5, math.nan, 0.5], "1 of the PSF's 3 values are not finite"),
        ([0.5, math.inf], "not finite"),
        ([0.7, -0.2, 0.5], "smallest value is -0.2"),
        ([0.0, 0.0], "zero everywhere"),
    ],
)
def test_values_that_are_no_psf_are_refused(values: list[float], says: str) -> None:
    with pytest.raises(RestorationError, match=says):
        as_psf(values)


def test_an_origin_outside_the_taps() -> None:
    with pytest.raises(RestorationError, match="pad the PSF with zeros"):
        Psf(values=np.ones(3) / 3, origin=(3,))


@pytest.mark.parametrize(
    ("path", "covariance", "scale", "says"),
    [
        (np.zeros((3, 10)), None, 1.0, "shape \\(3, 10\\)"),
        ([], None, 1.0, "expected finite positions"),
        ([0.0, math.nan], None, 1.0, "expected finite positions"),
        (np.zeros(10), np.eye(9), 1.0, "10 x 10"),
        (np.zeros(10), None, 0.0, "above zero"),
    ],
)
def test_a_path_that_is_none_is_refused(
    path: np.ndarray, covariance: np.ndarray | None, scale: float, says: str
) -> None:
    with pytest.raises(RestorationError, match=says):
        motion_psf(path, covariance, KERNEL, scale)


@pytest.mark.parametrize("shares", [np.ones(9), np.full(10, math.nan), np.r_[-0.1, np.ones(9)], np.zeros(10)])
def test_shares_that_are_none_are_refused(shares: np.ndarray) -> None:
    with pytest.raises(RestorationError, match="expected 10, of which none is negative, and some not zero"):
        motion_psf(np.zeros(10), None, KERNEL, SCALE, shares)
