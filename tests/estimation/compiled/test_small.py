"""Compiled code for small matrices against NumPy."""

import numpy as np
import pytest

from aolink.estimation.compiled import small


@pytest.mark.slow
def test_small_matrices_are_those_of_numpy():
    rng = np.random.default_rng(5)
    for n in (1, 2, 5, 12):
        a = rng.standard_normal((n, n))
        a = a @ a.T + 0.1 * np.eye(n)
        root, inverse, x = np.empty((n, n)), np.empty((n, n)), rng.standard_normal(n)
        small.cholesky_into(a, root)
        np.testing.assert_allclose(root, np.linalg.cholesky(a), rtol=1e-7, atol=1e-9)
        small.lower_inverse_into(root, inverse)
        np.testing.assert_allclose(inverse @ root, np.eye(n), atol=1e-9)
        solved = x.copy()
        small.cholesky_solve(root, solved)
        np.testing.assert_allclose(a @ solved, x, rtol=1e-6, atol=1e-8)
        solved = x.copy()
        small.lower_solve(root, solved)
        np.testing.assert_allclose(root @ solved, x, rtol=1e-6, atol=1e-8)
        values, vectors, worked = np.empty(n), np.empty((n, n)), a.copy()
        small.eigh(worked, values, vectors)
        np.testing.assert_allclose(values, np.linalg.eigvalsh(a)[::-1], rtol=1e-9)
        np.testing.assert_allclose(vectors @ a @ vectors.T, np.diag(values), atol=1e-9 * values[0])
        np.testing.assert_allclose(vectors @ vectors.T, np.eye(n), atol=1e-12)
    x = np.append(-np.geomspace(1e-9, 39, 200), 0.0)
    np.testing.assert_allclose([small.decay(each) for each in x], np.exp(x), rtol=3e-9)
    assert small.decay(-np.inf) == small.decay(-41.0) < 5e-18
    assert np.isnan(small.decay(np.nan))


def test_roots_of_matrices_that_are_not_positive_definite():
    seen = np.random.default_rng(6).standard_normal((6, 3))
    singular, root = seen @ seen.T, np.empty((6, 6))
    small.cholesky_into(singular, root)
    np.testing.assert_array_equal(root, np.tril(root))
    np.testing.assert_allclose(root @ root.T, singular, atol=1e-9 * singular.max())
    root = np.empty((2, 2))
    small.cholesky_into(np.diag([1.0, -1.0]), root)
    assert np.isnan(root[1, 1])
