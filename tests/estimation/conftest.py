"""Plants and rigs that the estimation tests share."""

import dataclasses

import numpy as np
import pytest

from aolink.rig import Plant, Rig, load_rig, parse_rig


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


@pytest.fixture(scope="session")
def small_membrane() -> Rig:
    """membrane-12x12 with 6 x 6 actuators and 4 x 4 lenslets: 72 states, 32 slopes, small enough for dense models."""
    text = load_rig("membrane-12x12").toml
    for old, new in (
        ("actuators = [12, 12]", "actuators = [6, 6]"), ("grid = [10, 10]", "grid = [4, 4]"),
        ("pitch_m = 1.0e-3", "pitch_m = 2.0e-3"), ("pad_radius_m = 0.45e-3", "pad_radius_m = 0.9e-3"),
        ("process_noise = 300.0", "process_noise = 6.0"),
    ):  # fmt: skip
        assert text.count(old) == 1
        text = text.replace(old, new)
    return parse_rig(text)
