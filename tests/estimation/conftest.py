"""Plants and rigs that the estimation tests share."""

import dataclasses

import numpy as np
import pytest

from aolink.rig import Plant, Rig, load_rig


@pytest.fixture(scope="session")
def rig() -> Rig:
    return load_rig("section-vi-lively")


@pytest.fixture(scope="session")
def mimo() -> Plant:
    """Two coupled outputs, three states, two inputs, two noises."""
    rng = np.random.default_rng(11)
    A = rng.standard_normal((3, 3))
    return Plant(
        A=A / np.abs(np.linalg.eigvals(A)).max() * 0.98,
        B=rng.standard_normal((3, 2)),
        B_w=rng.standard_normal((3, 2)) * 0.1,
        C=rng.standard_normal((2, 3)),
        process_noise=np.array([[1.0, 0.3], [0.3, 0.5]]),
        initial_mean=np.array([0.1, -0.2, 0.3]),
        initial_covariance=np.eye(3),
        axes=1,
    )


@pytest.fixture(scope="session")
def with_axes():
    def change(plant: Plant, axes: int) -> Plant:
        return dataclasses.replace(plant, axes=axes)

    return change
