"""The Kalman filter along lines: against filterpy, dense Gaussian algebra, the banded solve."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import linalg

from aolink.errors import RestorationError
from aolink.numerics.arrays import FloatArray
from aolink.restoration import Scanner, first_order, from_correlation, measured_correlation
from aolink.restoration.banded import MANY_LINES, smooth_lines
from aolink.restoration.kalman import kalman, line_model, scene_from_states, smooth
from aolink.restoration.psf import line_matrix
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


def pixels(m: int, columns: int = COLUMNS) -> range:
    return range(-m, columns)


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
    lines = make_lines(LOPSIDED)
    model = line_model(LOPSIDED, COLUMNS, scanner)
    found = kalman(model, lines, NOISE)
    for line in range(len(lines)):
        peer = KalmanFilter(dim_x=len(model.A), dim_z=1)
        peer.x, peer.P = np.zeros((len(model.A), 1)), model.start_covariance.copy()
        peer.F, peer.Q, peer.H, peer.R = model.A, model.Q, model.rows[:1], np.array([[NOISE]])
        for k in range(COLUMNS):
            assert found.predicted[k, line] == pytest.approx(peer.x[:, 0], abs=1e-10)
            peer.update(lines[line, k])
            assert found.filtered[k, line] == pytest.approx(peer.x[:, 0], abs=1e-10)
            peer.predict()


@pytest.mark.parametrize("scanner", [FIRST, THIRD], ids=["first", "third"])
def test_predictor_filter_and_lag_are_conditional_expectations(scanner: Scanner) -> None:
    lines, m = make_lines(LOPSIDED, scanner), len(LOPSIDED) - 1
    model = line_model(LOPSIDED, COLUMNS, scanner)
    found = kalman(model, lines, NOISE)
    predicted = scene_from_states(model, found.predicted, range(COLUMNS))
    filtered = scene_from_states(model, found.filtered, range(COLUMNS))
    lagged = scene_from_states(model, found.filtered, range(COLUMNS), lag=m)
    for k in range(1, COLUMNS):
        before, now = (given_pixels(lines, LOPSIDED, scanner, upto) for upto in (k, k + 1))
        late = given_pixels(lines, LOPSIDED, scanner, min(k + m + 1, COLUMNS))
        assert predicted[:, k] == pytest.approx(before[:, m + k], abs=1e-10)
        assert filtered[:, k] == pytest.approx(now[:, m + k], abs=1e-10)
        assert lagged[:, k] == pytest.approx(late[:, m + k], abs=1e-10)


@pytest.mark.parametrize("values", [UNIFORM, DECAYING, DECAYING[::-1], LOPSIDED, np.ones(1)], ids=len)
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("varying", [False, True])
@pytest.mark.parametrize("count", [3, MANY_LINES + 1])
def test_smoother_banded_solve_and_dense_least_squares_agree(
    values: FloatArray, masked: bool, varying: bool, count: int
) -> None:
    rng, m = np.random.default_rng(5), len(values) - 1
    if varying:
        values = values * rng.uniform(0.5, 1.5, (COLUMNS, m + 1))
    lines = make_lines(values, n=count)
    # Some of the lines have the same mask.
    seen = np.repeat(rng.random((2, COLUMNS)) > 0.2, [1, count - 1], axis=0) if masked else None
    model = line_model(values, COLUMNS, FIRST)
    states = smooth(model, kalman(model, lines, NOISE, seen, keep=True))
    kalmans = scene_from_states(model, states, pixels(m))
    banded = smooth_lines(lines, values, 0.9, 1.0, NOISE, seen)
    dense = given_pixels(lines, values, FIRST, COLUMNS, seen)
    assert abs(kalmans - dense).max() < 1e-10
    assert abs(banded - dense).max() < 1e-10


def test_a_pixel_that_was_not_seen_is_not_looked_at() -> None:
    lines = make_lines(UNIFORM)
    seen = np.ones(lines.shape, bool)
    seen[:, 10:14] = False
    seen[0, 30] = False
    spoilt = np.where(seen, lines, 1e6)
    model = line_model(UNIFORM, COLUMNS, FIRST)
    one, other = (kalman(model, each, NOISE, seen).filtered for each in (lines, spoilt))
    assert (one == other).all()
    assert (
        smooth_lines(lines, UNIFORM, 0.9, 1.0, NOISE, seen) == smooth_lines(spoilt, UNIFORM, 0.9, 1.0, NOISE, seen)
    ).all()


@pytest.mark.parametrize("count", [3, MANY_LINES + 1])
@pytest.mark.parametrize("scanner", [FIRST, THIRD], ids=["first", "third"])
def test_known_pixels_before_the_line(scanner: Scanner, count: int) -> None:
    lines, m = make_lines(LOPSIDED, scanner, count), len(LOPSIDED) - 1
    known = np.random.default_rng(2).standard_normal((len(lines), m))
    # Dense: the known pixels as measured without noise.
    C = np.vstack([np.eye(m, COLUMNS + m), line_matrix(LOPSIDED, COLUMNS)])
    R = scene_covariance(scanner, COLUMNS + m)
    S = C @ R @ C.T + np.diag(np.r_[np.zeros(m), np.full(COLUMNS, NOISE)])
    dense = (R @ C.T @ np.linalg.solve(S, np.concatenate([known, lines], axis=1).T)).T
    model = line_model(LOPSIDED, COLUMNS, scanner, known[:, ::-1])
    states = smooth(model, kalman(model, lines, NOISE, keep=True))
    assert abs(scene_from_states(model, states, pixels(m)) - dense).max() < 1e-9
    if scanner is FIRST:
        banded = smooth_lines(lines, LOPSIDED, 0.9, 1.0, NOISE, known=known)
        assert abs(banded - dense).max() < 1e-10


@settings(max_examples=25)
@given(
    st.lists(st.floats(0, 1), min_size=1, max_size=8).filter(lambda c: sum(c) > 0.1),
    st.floats(0, 0.99),
    st.floats(1e-4, 1.0),
)
def test_the_smoother_is_the_banded_solution_for_any_psf_and_scanner(
    taps: list[float], correlation: float, noise: float
) -> None:
    values, scanner = np.array(taps) / sum(taps), first_order(correlation, 1.0)
    lines = np.random.default_rng(1).standard_normal((2, 20))
    model = line_model(values, 20, scanner)
    states = smooth(model, kalman(model, lines, noise, keep=True))
    banded = smooth_lines(lines, values, correlation, 1.0, noise)
    assert abs(scene_from_states(model, states, pixels(len(values) - 1, 20)) - banded).max() < 1e-8


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
