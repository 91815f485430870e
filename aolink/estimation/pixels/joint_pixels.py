"""The pixels of all spots of one large plant: one mode of the joint posterior, by Levenberg and Marquardt's method.

As `aolink.estimation.pixels.modes`, but for hundreds of coefficients and in information form: the objective is
(t - m)' P^-1 (t - m) / 2 minus the pixels' log-likelihood, with Fisher's information instead of the Hessian. At the
mode its inverse is the covariance.

The search starts at the prior's mean only. One spot does not distinguish a path from its reversal; the spots that one
membrane moves do, once the states are roughly known: on the rig membrane-12x12, reversed paths, mirrored or not, were
worse by 200 and more (in log posterior) in every exposure but the first, and a start from the truth found nothing
better in nine of ten. Where the prior's standard deviation of paths is more than two fifths of the kernel's there are
many modes, and one of them says little: there, as in the first exposures of a recording, windowed moments of all spots
(`JointMoments`) are taken instead, whose covariance includes what the blur leaves ambiguous.

36 actuators before 16 lenslets are few enough for the dense `profile` with all its starts: path RMSE 0.090 there, 0.088
here; 3 s a frame there, 20 ms here. The covariance at a mode is slightly too small: NEES of the start state 330 for 288
states, of the end state 285, and no better with more coefficients or nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from aolink.estimation.frames.frame_data import SpotWindows
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model.joint_paths import JointPaths, compiled_loops
from aolink.estimation.moments.joint_moments import JointMoments, JointObservation
from aolink.estimation.pixels.levenberg_marquardt import Place, minimise
from aolink.numerics.arrays import FloatArray
from aolink.numerics.batched import symmetric
from aolink.numerics.single_thread import covariance_of_information, gram, matmul_one_thread, solve_information
from aolink.optics.camera import effective_noise_density, shot_gain
from aolink.optics.kernel import pixel_masses
from aolink.optics.plane import mehler_series
from aolink.optics.sensor import SpotSensor

_PASSES = 12
# The objective, which is of hundreds of coefficients, changes by less than this at a mode.
CONVERGED = 0.3
# Rms of a path's prior, in standard deviations of the kernel, up to which there is one mode that matters.
LARGEST_SPREAD = 0.4
# Relative to the information of a spot: one without pixels has none.
_NO_LIGHT = 1e-9


class JointPixels:
    """The pixels of one frame as a function of the coefficients of all spots together.

    ``windows`` are the spots of one copy of the plant, as `by_spot` gives them.
    """

    def __init__(self, sensor: SpotSensor, paths: JointPaths, windows: SpotWindows) -> None:
        self.paths, self._edges, self._area = paths, sensor.profile.edges, sensor.pixel_size
        self.y, self.mask = (
            np.ascontiguousarray(each.reshape(len(each), -1)) for each in (windows.density, windows.mask)
        )
        share = np.ones(paths.spots) if windows.light is None else windows.light[:, 0]
        self._read = effective_noise_density(sensor) / self._area / share**2
        self._gain = shot_gain(sensor) / share
        self._kernel = sensor.kernel.covariance + paths.widening * np.eye(2)
        self._terms = mehler_series(self._kernel)

    @property
    def kernel_variance(self) -> float:
        """Variance of the kernel in its narrowest direction, slope units squared."""
        return float(np.linalg.eigvalsh(self._kernel)[0])

    def at(self, t: FloatArray) -> Linearised:
        """Log-likelihood, score and information at a point (size,)."""
        path, highest = self.paths.positions(t), len(self._terms)
        X, Y = (np.stack(pixel_masses(self._kernel[d, d], self._edges, path[:, d], highest)) for d in (0, 1))
        # A displacement is one more course.
        courses = np.column_stack([self.paths.functions, np.ones(len(self.paths.weights))])
        spots, m = len(path), courses.shape[1]
        log_likelihood, score = np.empty(spots), np.empty((spots, 2 * m))
        information = np.empty((spots, 2 * m, 2 * m))
        compiled_loops().looked_at(
            X, Y, np.array(self._terms), self.paths.weights, courses, self._area, self.y, self.mask, self._read,
            self._gain, log_likelihood, score, information,
        )  # fmt: skip
        score, information = score.reshape(spots, 2, m), information.reshape(spots, 2, m, 2, m)
        return Linearised(
            log_likelihood=float(log_likelihood.sum()), score=score[..., :-1], displacement_score=score[..., -1],
            information=np.ascontiguousarray(information[:, :, :-1, :, :-1]),
            displaced=information[:, :, :-1, :, -1], of_displacement=information[:, :, -1, :, -1],
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Linearised:
    """Pixels about a point, by the courses' shares of each spot's path (2, m) and by its displacement (2)."""

    log_likelihood: float
    score: FloatArray
    """(spots, 2, m)"""
    information: FloatArray
    """(spots, 2, m, 2, m)"""
    displaced: FloatArray
    """(spots, 2, m, 2)"""
    of_displacement: FloatArray
    """(spots, 2, 2)"""
    displacement_score: FloatArray
    """(spots, 2)"""


def find_mode(view: JointPixels, mean: FloatArray, precision: FloatArray, start: FloatArray) -> Place:
    """The mode that a start leads to, for a prior with this mean and precision; it keeps the `Linearised` pixels."""
    paths = view.paths

    def at(t: FloatArray) -> Place:
        near, pull = view.at(t), matmul_one_thread(precision, t - mean)
        objective, H = 0.5 * float((t - mean) @ pull) - near.log_likelihood, paths.information(near.information)
        return Place(t, objective, paths.score(near.score) - pull, precision + H, near)

    # The expected gain of a step shows when the search is at a mode, before the pixels are linearised again.
    return minimise(at, start, _PASSES - 1, CONVERGED, foreseen=CONVERGED, solve=solve_information)


class JointProfile(JointObservation):
    """The estimator `profile` of a plant with hundreds of states: the mode of the posterior.

    Its innovation is each spot's displacement from its prediction, as the pixels linearised at the mode give it: one
    number for each output. Its NIS is chi-square distributed where model and covariances are right.
    """

    def __init__(self, sensor: SpotSensor, n_outputs: int) -> None:
        super().__init__(sensor, n_outputs)
        self._moments = JointMoments(sensor, n_outputs)

    def corrected(self, paths: JointPaths, prior: Gaussian, windows: SpotWindows) -> tuple[FloatArray, ...]:
        before, P, view = prior.mean, prior.covariance, JointPixels(self.sensor, paths, windows)
        if paths.rms_spread(P) <= LARGEST_SPREAD * np.sqrt(view.kernel_variance):
            mode = find_mode(view, before, paths.prior_information(P), before)
            t, after, at = mode.x, covariance_of_information(mode.hessian), mode.seen
        else:
            t, after, *_ = self._moments.corrected(paths, prior, windows)
            at = view.at(t)
        new, S, nis = displacements(paths, before, P, t, at)
        return t, after, new, S, nis, nis


def displacements(
    paths: JointPaths, mean: FloatArray, state_covariance: FloatArray, t: FloatArray, at: Linearised
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Displacement of each spot from its prediction, as the pixels linearised at a point give it, (n_outputs,), its
    variance (n_outputs,), and its NIS."""
    spots, n = paths.spots, len(state_covariance)
    information = at.of_displacement
    most = np.einsum("sdd->s", information).max()
    information = information + (_NO_LIGHT * most) * np.eye(2)
    noise = np.linalg.inv(information)
    # How much each share displaces its spot, (spots, 2, 2, m), and so each coefficient.
    by_share = noise @ at.displaced.transpose(0, 3, 1, 2).reshape(spots, 2, -1)
    by_share = by_share.reshape(spots, 2, 2, -1)
    patterns = paths.patterns.reshape(spots, 1, 2, -1)
    H = by_share[:, :, 0, paths.course_of] * patterns[:, :, 0] + by_share[:, :, 1, paths.course_of] * patterns[:, :, 1]
    H = H.reshape(2 * spots, -1)
    new = (noise @ at.displacement_score[..., None]).ravel() + matmul_one_thread(H, t - mean)
    S = matmul_one_thread(matmul_one_thread(H[:, :n], state_covariance), H[:, :n].T)
    S += gram(H[:, n:].T)
    for s in range(spots):
        S[2 * s : 2 * s + 2, 2 * s : 2 * s + 2] += noise[s]
    S = symmetric(S)
    return new, np.diagonal(S).copy(), np.asarray(new @ solve_information(S, new))
