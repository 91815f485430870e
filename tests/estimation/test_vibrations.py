"""Vibrations about which a blur leaves much open: intervals that are honest, frames that are believed, two paths."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import block_diag, expm, solve_discrete_lyapunov

from aolink.estimation import Status, run
from aolink.estimation.frames.frame_data import Needs, Profile
from aolink.estimation.frames.measure import measure
from aolink.estimation.model.exposure_model import exposure_model
from aolink.estimation.pixels.likelihood import PixelView, reduction
from aolink.estimation.pixels.profile import ProfileFilter
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.estimation.pixels.plain import by_moments
from tests.kinds import must_be, truth_of

LINE, PLANE = load_rig("section-vi-lively"), load_rig("single-lenslet")


def swinging(swings, along=((1.0,),), *, steps=80, sd=0.15, noise=2e-4, damping=1e-3, kernel=0.17, beside=1.0):
    """A spot that swings so often in each exposure, along these directions with a phase each, with a standard deviation
    of ``sd`` slope units. ``beside`` is A of a state beside it in each output, which nothing drives and which is zero.
    """
    w = 2 * np.pi * swings / steps
    A, push = expm(np.array([[0.0, w], [-w, -2 * damping * w]])), np.array([[0.0], [1.0]])
    gain, outputs = sd / np.sqrt(solve_discrete_lyapunov(A, push @ push.T)[0, 0]), len(along[0])
    modes, rest = np.eye(len(along)), np.eye(outputs)
    A = block_diag(np.kron(modes, A), beside * rest)
    B_w = np.vstack([np.kron(modes, gain * push), np.zeros((outputs, len(along)))])
    P = np.kron(modes, sd**2 * np.eye(2))
    C = np.hstack([np.kron(np.array(along).T, [[1.0, 0.0]]), rest])
    base = LINE if outputs == 1 else PLANE
    plant = dataclasses.replace(
        base.plant, A=A, B=np.zeros((len(A), 1)), B_w=B_w, C=C, process_noise=np.eye(len(along)), axes=1,
        initial_mean=np.zeros(len(A)), initial_covariance=block_diag(P, 1e-8 * rest),
    )  # fmt: skip
    size = {"pixels": 24} if outputs == 1 else {"window": (24, 24)}
    sensor = dataclasses.replace(
        base.sensor, noise_density=noise, kernel=dataclasses.replace(base.sensor.kernel, sigma=kernel), bit_depth=16,
        black_level=3000, counts_per_density=4000 if outputs == 1 else 60000 * kernel**2, **size,
    )  # fmt: skip
    timing = dataclasses.replace(base.timing, exposure_steps=steps, frame_period_steps=steps)
    return dataclasses.replace(base, plant=plant, sensor=sensor, timing=timing)


def known(rig, name, *, seeds=1, count=30, believed=None):
    """Error of the path over its own size, share of it inside 95 % intervals, and share of the exposures that are
    OK."""
    off, path, inside, fine = [], [], [], []
    for seed in range(seeds):
        exposures = simulate(rig, count, seed=seed, inputs=np.zeros((count * rig.timing.exposure_steps, 1)))
        for k, (x, e) in enumerate(zip(exposures, run(believed or rig, exposures, [name])[name], strict=True)):
            fine.append(e.status == Status.OK)
            if k >= 10:
                off.append(e.path - truth_of(x).path)
                path.append(truth_of(x).path)
                inside.append(np.abs(off[-1]) <= 1.96 * e.path_sd)
    return np.sqrt(np.mean(np.square(off)) / np.mean(np.square(path))), np.mean(inside), np.mean(fine)


@pytest.mark.slow
@pytest.mark.parametrize("swings", [2, 4])
@pytest.mark.parametrize("name", ["moments", "profile"])
def test_intervals_are_honest_about_a_phase_that_no_frame_tells(name, swings):
    """After whole swings the blur is the same whatever the phase is; predicting nothing has an error of one."""
    error, inside, fine = known(swinging(swings), name, seeds=4)
    assert fine == 1
    assert error < 1.1
    assert inside > 0.9


@pytest.mark.slow
def test_a_state_that_stays_changes_nothing_in_what_is_known_of_a_vibration():
    stays, decays = (known(swinging(3.3, damping=1e-2, beside=a), "moments", seeds=2)[0] for a in (1.0, 0.9))
    assert stays == pytest.approx(decays, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("slope", [1.0, 1e-3])
def test_frames_of_a_fast_vibration_aslant_are_believed(slope):
    rig = swinging(24, ((1.0, slope),), steps=120, noise=1e-4, kernel=0.16)
    assert known(rig, "moments")[2] > 0.97


@pytest.mark.slow
def test_a_vibration_aslant_of_another_size_than_the_rigs_is_followed():
    """The rig has x and y as modes apart, of one frequency."""
    how = {"noise": 1e-3, "damping": 1e-4}
    wrong = swinging(4.25, ((1.0, 0.0), (0.0, 1.0)), sd=0.14, **how)
    error, _, fine = known(swinging(4.25, ((1.0, 1.0),), sd=0.34, **how), "moments", believed=wrong)
    assert fine > 0.9
    assert error < 0.7


def view_of(rig):
    """The pixels of one exposure, and what was known before."""
    (exposure,) = simulate(rig, 1, seed=3, inputs=np.zeros((rig.timing.exposure_steps, 1)))
    measured = must_be(Profile, measure(rig, exposure, Needs(what="profile"))[0])
    model = exposure_model(rig.plant, exposure.n_steps)
    view = PixelView(rig.sensor, model, model.response(exposure.inputs), measured, reduction(model, rig.sensor))
    blur = ProfileFilter(rig.plant, rig.sensor)
    return view, blur.prior, blur


def test_profile_is_moments_where_the_posterior_is_a_ring():
    view, prior, blur = view_of(swinging(4))
    found, moments = blur.found(view, prior), by_moments(view, view.reduced.prior(prior.gaussian))
    assert found.is_multimodal[0]
    assert np.isfinite(found.posterior.log_weight).sum() == 1
    np.testing.assert_allclose(found.posterior.gaussian.mean, moments.mean, atol=1e-12)
    np.testing.assert_allclose(found.posterior.gaussian.covariance, moments.covariance, atol=1e-12)


@pytest.mark.slow
def test_profile_tells_two_paths_apart_that_moments_cannot():
    """Half a swing: to and fro. Later exposures tell which it was."""
    rig = swinging(0.5)
    view, prior, blur = view_of(rig)
    found = blur.found(view, prior)
    assert found.is_multimodal[0]
    np.testing.assert_allclose(np.exp(found.posterior.log_weight), [[0.5, 0.5]], atol=0.01)
    (error, inside, _), (moments, _, _) = (known(rig, name, seeds=3) for name in ("profile", "moments"))
    assert error < 0.4 * moments
    assert inside > 0.9
