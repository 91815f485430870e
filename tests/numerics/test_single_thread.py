"""Linear algebra by one thread, against NumPy's; and who else is given one."""

import os
import subprocess
import sys
from pathlib import Path
from threading import Thread

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from threadpoolctl import threadpool_info

from aolink.numerics.single_thread import (
    by_one_thread,
    congruence_one_thread,
    covariance_of_information,
    gram,
    inverse_by_cholesky,
    matmul_one_thread,
    root_of_information,
    solve_information,
)

sizes = st.integers(0, 130)


def random(*shape: int) -> np.ndarray:
    return np.random.default_rng(sum(shape)).standard_normal(shape)


@settings(max_examples=40)
@given(sizes, sizes, sizes)
def test_products_are_those_of_whole_matrices(n: int, k: int, m: int) -> None:
    a, b = random(n, k), random(k, m)
    np.testing.assert_allclose(matmul_one_thread(a, b), a @ b, atol=1e-12)
    np.testing.assert_allclose(matmul_one_thread(b.T, a.T), b.T @ a.T, atol=1e-12)
    np.testing.assert_allclose(
        matmul_one_thread(a, b[:, 0] if m else np.zeros(k)),
        a @ (b[:, 0] if m else np.zeros(k)),
        atol=1e-12,
    )
    square = gram(a)
    np.testing.assert_allclose(square, a.T @ a, atol=1e-12)
    np.testing.assert_array_equal(square, square.T)


@pytest.mark.parametrize("n", [1, 47, 48, 49, 200])
def test_the_inverse_of_a_root_gives_the_inverse(n: int) -> None:
    a = random(n, n + 5)
    a = a @ a.T
    W = root_of_information(a)
    np.testing.assert_array_equal(W, np.tril(W))
    np.testing.assert_allclose(W @ np.linalg.cholesky(a), np.eye(n), atol=1e-8)
    for inverse in (inverse_by_cholesky, covariance_of_information):
        np.testing.assert_allclose(inverse(a) @ a, np.eye(n), atol=1e-7)
    x = random(n)
    np.testing.assert_allclose(solve_information(a, a @ x), x, atol=1e-7)


def test_a_matrix_without_a_root_is_refused() -> None:
    a = np.eye(100)
    a[70, 71] = a[71, 70] = 2
    with pytest.raises(np.linalg.LinAlgError):
        root_of_information(a)


@pytest.mark.parametrize("share", [0.01, 1.0])
def test_congruence_by_entries_and_whole(share: float) -> None:
    a, p = random(90, 150) * (np.random.default_rng(1).random((90, 150)) < share), random(150, 150)
    p = p + p.T
    np.testing.assert_allclose(congruence_one_thread(a, p), a @ p @ a.T, atol=1e-11)


@pytest.mark.parametrize("touched", [0, 60, 149, 150])
def test_congruence_of_what_is_independent_at_its_end(touched: int) -> None:
    a, p = random(90, 150), np.eye(150)
    a[:, :40] *= np.random.default_rng(2).random((90, 40)) < 0.02
    own = random(touched, touched)
    p[:touched, :touched] = own + own.T
    np.testing.assert_allclose(congruence_one_thread(a, p), a @ p @ a.T, atol=1e-11)


def blas_threads() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


@pytest.mark.slow
def test_one_thread_as_long_as_anybody_is_inside() -> None:
    """In a process whose BLAS has two threads otherwise: a worker of the tests has one."""
    program = "from tests.numerics.test_single_thread import see_who_is_inside; see_who_is_inside()"
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "2"}
    subprocess.run([sys.executable, "-c", program], env=environment, cwd=Path(__file__).parents[2], check=True)


def see_who_is_inside() -> None:
    before, seen = {2}, []
    assert blas_threads() == before

    def other() -> None:
        with by_one_thread:
            seen.append(blas_threads())
        seen.append(blas_threads())

    thread = Thread(target=other)
    with by_one_thread:
        thread.start()
        matmul_one_thread(np.eye(3), np.eye(3))
        assert blas_threads() == {1}
        assert not seen
    thread.join()
    assert seen == [{1}, before]
    with pytest.raises(np.linalg.LinAlgError):
        inverse_by_cholesky(-np.eye(3))
    assert blas_threads() == before
