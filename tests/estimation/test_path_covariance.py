"""Covariance of a path, against the exposure basis times the coefficients' covariance."""

from __future__ import annotations

import numpy as np
import pytest

from aolink.estimation import Estimate, run
from aolink.restoration import motion_psf
from aolink.restoration.deblur import scene_psf
from aolink.rig import load_rig
from aolink.simulation.model import simulate


def last_estimate(rig_name: str, estimator: str) -> Estimate:
    rig = load_rig(rig_name)
    return run(rig, simulate(rig, 3), [estimator])[estimator][-1]


def test_it_is_the_basis_times_the_coefficients_covariance() -> None:
    estimate = last_estimate("section-vi-lively", "moments")
    basis = estimate.model.basis[0][:, : estimate.coefficients.shape[1]]
    expected = basis @ estimate.coefficient_covariance[0] @ basis.T
    np.testing.assert_allclose(estimate.path_covariance(), expected, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("rig", ["section-vi-lively", "tip-tilt", "single-lenslet"])
def test_its_diagonal_is_the_paths_variance_and_it_is_a_covariance(rig: str) -> None:
    estimate = last_estimate(rig, "o3")
    covariance = estimate.path_covariance()
    np.testing.assert_allclose(np.diag(covariance), estimate.path_sd.ravel() ** 2, rtol=1e-12)
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance)[0] > -1e-12 * np.trace(covariance)


def test_outputs_are_chosen_by_number_and_keep_what_they_share() -> None:
    """One mirror moves the spot along x and y, and only the light says which: the two errors belong together."""
    estimate = last_estimate("tip-tilt", "moments")
    both, n = estimate.path_covariance(), estimate.n_steps
    np.testing.assert_allclose(estimate.path_covariance([0]), both[:n, :n], atol=1e-15)
    np.testing.assert_allclose(estimate.path_covariance([1, 0])[:n, n:], both[n:, :n], atol=1e-15)


@pytest.mark.slow
def test_what_a_large_plants_basis_leaves_out_is_on_the_diagonal() -> None:
    estimate = last_estimate("membrane-12x12", "o1")
    covariance = estimate.path_covariance([7])
    np.testing.assert_allclose(np.diag(covariance), estimate.path_sd[7] ** 2, rtol=1e-12)


def test_motion_psf_makes_the_psf_of_deblur_with_it() -> None:
    """As README has it: the same PSF as `aolink deblur` restores with."""
    rig = load_rig("moving-scene")
    assert rig.scene is not None
    exposures = simulate(rig, 2)
    estimate = run(rig, exposures, ["moments"])["moments"][-1]
    psf = motion_psf(estimate.path, estimate.path_covariance(), rig.scene.kernel, rig.scene.pixel_scale)
    expected = scene_psf(rig, exposures[-1], estimate)
    assert psf.origin == expected.origin
    np.testing.assert_allclose(psf.values, expected.values, atol=1e-9)
    np.testing.assert_allclose(psf.sd, expected.sd, atol=1e-6)
