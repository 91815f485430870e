"""The Kalman filter along lines: against filterpy and dense Gaussian algebra."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from numpy.typing import NDArray
from scipy import linalg

from aolink.errors import RestorationError
from aolink.numerics.arrays import FloatArray
from aolink.restoration import Scanner, first_order, from_correlation, measured_correlation
from aolink.restoration.psf import line_matrix
from aolink.restoration.shahin import expected_gain_db, kalman, line_model, smooth
from tests.restoration.scenes import DECAYING, LOPSIDED, UNIFORM

NOISE = 0.01
FIRST = first_order(0.9, 1.0)
THIRD = from_correlation([1.0, 0.9, 0.75, 0.55])
COLUMNS = 40


def scene_covariance(scanner: Scanner, size: int) -> FloatArray:
    return linalg.toeplitz(scanner.correlation(size - 1))


def given_pixels(
    lines: FloatArray, values: FloatArray, scanner: Scanner, upto: int, seen: NDArray[np.bool_] | None = None
) -> FloatArray:
    """E[scene | pixels before ``upto``] of dense joint Gaussians, the pixels before the line first."""
    m = values.shape[-1] - 1
    C = line_matrix(values, lines.shape[1])[:upto]
    R = scene_covariance(scanner, lines.shape[1] + m)
    out = []
    for k, line in enumerate(lines[:, :upto]):
        use = np.ones(upto, bool) if seen is None else seen[k, :upto]
        S = C[use] @ R @ C[use].T + NOISE * np.eye(int(use.sum()))
        out.append(R @ C[use].T @ np.linalg.solve(S, line[use]))
    return np.array(out)


def make_lines(values: FloatArray, scanner: Scanner = FIRST, n: int = 3, seed: int = 1) -> FloatArray:
    rng = np.random.default_rng(seed)
    m = values.shape[-1] - 1
    root = np.linalg.cholesky(scene_covariance(scanner, COLUMNS + m) + 1e-12 * np.eye(COLUMNS + m))
    scene = rng.standard_normal((n, COLUMNS + m)) @ root.T
    return np.asarray(scene @ line_matrix(values, COLUMNS).T + np.sqrt(NOISE) * rng.standard_normal((n, COLUMNS)))


def test_the_state_space_is_the_transfer_function() -> None:
    model = line_model(LOPSIDED, COLUMNS, first_order(0.0, 1.0))
    m = len(LOPSIDED) - 1
    A, B = model.A[:m, :m], model.A[:m, m:]
    C, d = model.rows[0, :m], model.rows[0, m:]
    for z in (1.3, -0.7 + 0.4j, 2j):
        H = C @ np.linalg.solve(z * np.eye(m) - A, B) + d
        assert H[0] == pytest.approx(sum(c / z**i for i, c in enumerate(LOPSIDED)), abs=1e-12)


@pytest.mark.parametrize("scanner", [FIRST, THIRD, first_order(0.0, 2.0)], ids=["first", "third", "just a delay"])
def test_step_by_step_as_filterpy(scanner: Scanner) -> None:
    lines, m = make_lines(LOPSIDED), len(LOPSIDED) - 1
    model = line_model(LOPSIDED, COLUMNS, scanner)
    predicted, filtered = (
        kalman(model, lines, NOISE, None, range(COLUMNS), which) for which in ("predictor", "filter")
    )
    lagged = kalman(model, lines, NOISE, None, range(COLUMNS), "lag", m)
    for line in range(len(lines)):
        peer = KalmanFilter(dim_x=len(model.A), dim_z=1)
        peer.x, peer.P = np.zeros((len(model.A), 1)), model.start_covariance.copy()
        peer.F, peer.Q, peer.H, peer.R = model.A, model.Q, model.rows[:1], np.array([[NOISE]])
        for k in range(COLUMNS):
            assert predicted[line, k] == pytest.approx(model.output @ peer.x[:, 0], abs=1e-10)
            peer.update(lines[line, k])
            assert filtered[line, k] == pytest.approx(model.output @ peer.x[:, 0], abs=1e-10)
            if k >= m:
                assert lagged[line, k - m] == pytest.approx(peer.x[m - 1, 0], abs=1e-10)
            peer.predict()


@pytest.mark.parametrize("scanner", [FIRST, THIRD], ids=["first", "third"])
def test_predictor_filter_and_lag_are_conditional_expectations(scanner: Scanner) -> None:
    lines, m = make_lines(LOPSIDED, scanner), len(LOPSIDED) - 1
    model = line_model(LOPSIDED, COLUMNS, scanner)
    predicted, filtered = (
        kalman(model, lines, NOISE, None, range(COLUMNS), which) for which in ("predictor", "filter")
    )
    lagged = kalman(model, lines, NOISE, None, range(COLUMNS), "lag", m)
    for k in range(1, COLUMNS):
        before, now = (given_pixels(lines, LOPSIDED, scanner, upto) for upto in (k, k + 1))
        late = given_pixels(lines, LOPSIDED, scanner, min(k + m + 1, COLUMNS))
        assert predicted[:, k] == pytest.approx(before[:, m + k], abs=1e-10)
        assert filtered[:, k] == pytest.approx(now[:, m + k], abs=1e-10)
        assert lagged[:, k] == pytest.approx(late[:, m + k], abs=1e-10)


@pytest.mark.parametrize("values", [UNIFORM, DECAYING, DECAYING[::-1], LOPSIDED, np.ones(1)], ids=len)
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("varying", [False, True])
def test_the_smoother_is_what_the_measured_pixels_let_expect(values: FloatArray, masked: bool, varying: bool) -> None:
    """Of dense joint Gaussians, and of the filter where it has come to the end of a line."""
    rng, m = np.random.default_rng(5), len(values) - 1
    if varying:
        values = values * rng.uniform(0.5, 1.5, (COLUMNS, m + 1))
    lines = make_lines(values)
    seen = rng.random(lines.shape) > 0.2 if masked else None
    found = smooth(lines, values, FIRST, NOISE, seen)
    assert abs(found - given_pixels(lines, values, FIRST, COLUMNS, seen)).max() < 1e-10
    last = kalman(line_model(values, COLUMNS, FIRST), lines, NOISE, seen, range(COLUMNS - 1 - m, COLUMNS), "lag", m)
    assert abs(found[:, -1 - m :] - last).max() < 1e-10


@pytest.mark.parametrize("alike", [False, True])
def test_a_pixel_that_was_not_seen_is_not_looked_at(alike: bool) -> None:
    lines = make_lines(UNIFORM)
    seen = np.ones(lines.shape, bool)
    seen[:, 10:14] = False
    seen[0, 30] = alike
    spoilt, model = np.where(seen, lines, 1e6), line_model(UNIFORM, COLUMNS, FIRST)
    one, other = (kalman(model, each, NOISE, seen, range(COLUMNS), "filter") for each in (lines, spoilt))
    assert (one == other).all()
    assert (smooth(lines, UNIFORM, FIRST, NOISE, seen) == smooth(spoilt, UNIFORM, FIRST, NOISE, seen)).all()


@pytest.mark.parametrize("scanner", [FIRST, THIRD], ids=["first", "third"])
def test_known_pixels_before_the_line(scanner: Scanner) -> None:
    lines, m = make_lines(LOPSIDED, scanner), len(LOPSIDED) - 1
    known = np.random.default_rng(2).standard_normal((len(lines), m))
    # Dense: the known pixels as measured without noise.
    C = np.vstack([np.eye(m, COLUMNS + m), line_matrix(LOPSIDED, COLUMNS)])
    R = scene_covariance(scanner, COLUMNS + m)
    S = C @ R @ C.T + np.diag(np.r_[np.zeros(m), np.full(COLUMNS, NOISE)])
    dense = (R @ C.T @ np.linalg.solve(S, np.concatenate([known, lines], axis=1).T)).T
    assert abs(smooth(lines, LOPSIDED, scanner, NOISE, known=known) - dense).max() < 1e-9
    model = line_model(LOPSIDED, COLUMNS, scanner, known[:, ::-1])
    last = kalman(model, lines, NOISE, None, range(COLUMNS - 1, COLUMNS), "filter")
    assert abs(last - dense[:, -1:]).max() < 1e-9


@pytest.mark.parametrize("taps", [UNIFORM, DECAYING[:3] / DECAYING[:3].sum()], ids=["worse", "better"])
@pytest.mark.parametrize("which", ["predictor", "filter"])
def test_what_a_filter_expects_to_gain_is_what_it_gains_on_its_own_scenes(which: str, taps: FloatArray) -> None:
    rng, m, columns = np.random.default_rng(4), len(taps) - 1, 120
    root = np.linalg.cholesky(scene_covariance(FIRST, columns + m) + 1e-12 * np.eye(columns + m))
    scenes = rng.standard_normal((400, columns + m)) @ root.T
    lines = scenes @ line_matrix(taps, columns).T + np.sqrt(NOISE) * rng.standard_normal((400, columns))
    true, inner = scenes[:, m:], slice(40, -20)
    found = kalman(line_model(taps, columns, FIRST), lines, NOISE, None, range(columns), which)
    blurred, left = (np.mean((each - true)[:, inner] ** 2) for each in (lines, found))
    gained = expected_gain_db(which, taps, 0, FIRST, NOISE)
    assert gained == pytest.approx(10 * np.log10(blurred / left), abs=0.15)


def test_a_scanner_has_the_correlation_that_it_was_made_from() -> None:
    wanted = [2.0, 1.7, 1.3, 0.8]
    assert from_correlation(wanted).correlation(3) == pytest.approx(wanted, abs=1e-12)
    assert first_order(0.8, 3.0).correlation(4) == pytest.approx(3 * 0.8 ** np.arange(5), abs=1e-12)
    image = np.cumsum(np.random.default_rng(1).standard_normal((20, 200)), axis=1)
    measured = measured_correlation(image, 4)
    assert from_correlation(measured).correlation(4) == pytest.approx(measured, rel=1e-8)


@pytest.mark.parametrize("correlation", [[1.0], [1.0, 1.2], [1.0, np.nan]])
def test_a_correlation_that_no_line_has(correlation: list[float]) -> None:
    with pytest.raises(RestorationError, match=r"fewer lags|finite"):
        from_correlation(correlation)


def test_a_scanner_that_never_forgets() -> None:
    with pytest.raises(RestorationError, match="below 1"):
        first_order(1.0, 1.0)
