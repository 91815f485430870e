"""The estimator `moments`: moments 0 to 3 in a window about each spot, by iterated statistical linearisation.

A moment, with any window or mask, is a weighted sum of pixels, y = sum_i W_i Y_i D. A
spot resting at theta makes g(theta) = sum_i W_i (kernel integrated over pixel i) of it, so that
E[y | path] = mean_k g(theta_k) holds with kernel, pixels, window and mask all in it: there is no bias to remove.

The prior makes theta_k Gaussian, and under a Gaussian the expectations of g and its derivatives are again
error functions, of a wider kernel. So the linear regression of y on the coefficients is in closed form
(statistical linearisation), and what it leaves out, Omega, too. It is repeated about the posterior, with the
window drawn tighter each time.

Omega depends on the state, which hardly changes from frame to frame on a plant that remembers: its errors
do not average out as independent ones would. It is therefore weighted with (1 + rho)/(1 - rho), as the
variance of a mean of errors that are correlated by rho. Without that, a filter that follows a resonance trusts one of
several phases that the blur cannot distinguish. rho is how much of the path that an error makes in this exposure it
makes in the next (rms). Where the frames carry little information, the plant correlates the errors, by A^N; where they
carry much, an error is passed on by A^N (I - K H) only, as far as that is linear. rho is the geometric mean of both:
the first alone wastes the frames' information, the second gives too small a covariance where several paths explain the
blur.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from aolink.estimation.compiled.windows import LINE, PLANE, Optics, Path, Regression, Windows, linearise
from aolink.estimation.frames.frame_data import HALF, Needs, Profile, SpotWindows
from aolink.estimation.kalman.gaussian import Gaussian, Update
from aolink.estimation.kalman.update import joseph_update
from aolink.estimation.model.base import Dynamics, ExposureModel, InputResponse
from aolink.estimation.model.quadrature import QuadraturePaths, paths_for
from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray
from aolink.numerics.workers import in_threads, thread_count
from aolink.optics.camera import effective_noise_density
from aolink.optics.sensor import BaseSensor

PASSES = 3
MOST_INFLATION = 1e3
# With fewer axes a second thread costs more than it saves, and more of them do not fit into the processor's cache.
_AXES_OF_A_THREAD, _AT_ONCE = 16, 512


class WindowedMoments:
    """Moments of all spots that one copy of the plant moves, as an observation of `BlurFilter`.

    One output is that of a line sensor; more are spot 0's x and y, spot 1's x and y, ...
    """

    models_noise = True

    def __init__(self, sensor: BaseSensor, outputs: int) -> None:
        line = outputs == 1
        self.sensor: BaseSensor = sensor.profile if line else sensor
        self.orders, spots = LINE if line else PLANE, max(1, outputs // 2)
        self.moment_orders = np.tile(self.orders.sum(axis=1), spots)
        self.n_measurements = len(self.moment_orders)
        self.needs = Needs(what="profile" if line else "windows", least_usable=HALF)
        size = self.sensor.pixel_size
        self._optics = Optics(
            low=float(sensor.profile.edges[0]), pixel=sensor.profile.pixel_width, size=size,
            read_noise=effective_noise_density(self.sensor) * size,
            shot_noise=size / self.sensor.photoelectrons if self.sensor.photoelectrons else 0.0,
            kernel=np.ascontiguousarray(self.sensor.kernel.covariance), widening=0.0,
        )  # fmt: skip

    def update(
        self, model: ExposureModel, response: InputResponse, prior: Gaussian, measured: Profile | SpotWindows
    ) -> Update:
        """Iterated statistical linearisation, from the prior to the posterior."""
        nodes = paths_for(model, self.sensor, prior.mean[:, : model.plant.n_states], response)
        return self.updated(model.dynamics, nodes, prior, measured)

    def updated(
        self, dynamics: Dynamics, nodes: QuadraturePaths, prior: Gaussian, measured: Profile | SpotWindows
    ) -> Update:
        """`update` with the paths at their nodes, whose coefficients the prior may be of."""
        axes = len(prior.mean)
        threads = min(thread_count(), -(-axes // _AXES_OF_A_THREAD))
        count = max(threads, -(-axes // _AT_ONCE))
        ends = [axes * k // count for k in range(count + 1)]
        parts = in_threads(
            lambda s: self._updated(dynamics, nodes.part(s), prior.part(s), measured.part(s)),
            [slice(*each) for each in pairwise(ends)],
        )
        if count == 1:
            return parts[0]
        mean, covariance, *rest = (np.concatenate(each) for each in zip(*map(_arrays, parts), strict=True))
        return Update(Gaussian(mean, covariance), *rest)

    def _updated(
        self, dynamics: Dynamics, nodes: QuadraturePaths, prior: Gaussian, measured: Profile | SpotWindows
    ) -> Update:
        about, inflation = prior, Inflation(dynamics, prior)
        windows, path, factor = windows_of(measured), path_of(nodes), inflation.by_plant
        for to_come in reversed(range(PASSES)):
            fit = self.regression(windows, path, about, nodes.widening)
            innovation = fit.value - fit.expected - batched.matvec(fit.slope, prior.mean - about.mean)
            R = fit.noise + factor[:, None, None] * fit.remainder
            done = joseph_update(prior, innovation, fit.slope, R)
            about = done.posterior
            if to_come:
                factor = inflation.by_frames(prior, fit.slope, R)
        # The covariance of this one innovation is without the inflation; the gate is that of the update.
        S = done.innovation_covariance - R + fit.noise + fit.remainder
        nis = batched.dot(innovation, batched.matvec(batched.inverse(S), innovation))
        return Update(about, innovation, S, nis, done.nis)

    def regression(self, windows: Windows, path: Path, about: Gaussian, widening: float = 0.0) -> Regression:
        """The moments and their regression on the coefficients under a Gaussian of these.

        ``widening`` is the variance of the path about its nodes that no coefficient covers, slope units squared.
        """
        (axes, n), m = about.mean.shape, windows.density.shape[1] * len(self.orders)
        out = Regression(*(np.empty((axes, *shape)) for shape in ((m,), (m, m), (m,), (m, n), (m, m))))
        optics = self._optics._replace(widening=float(widening))
        linearise(windows, optics, path, self.orders, *map(_contiguous, (about.mean, about.covariance)), out)
        return out


def windows_of(measured: Profile | SpotWindows) -> Windows:
    """The pixels as compiled code takes them: a line is a window of one row."""
    density, mask, light = measured.density, measured.mask, measured.light
    if density.ndim == 2:
        density, mask = density[:, None, None], mask[:, None, None]
    share = np.ones(density.shape[:2]) if light is None else light.reshape(density.shape[:2])
    return Windows(_contiguous(density), np.ascontiguousarray(mask), _contiguous(share))


def path_of(nodes: QuadraturePaths) -> Path:
    """The path as compiled code takes it."""
    return Path(*map(_contiguous, (nodes.basis.swapaxes(1, 2), nodes.inputs, nodes.weights)))


class Inflation:
    """The factor of the remainder's covariance: an error that the linearisation leaves out returns in later exposures.

    A state that stays but is known makes no path's error, and does not count.
    """

    def __init__(self, dynamics: Dynamics, prior: Gaussian) -> None:
        n = len(dynamics.transition)
        self._dynamics, self._P = dynamics, prior.covariance[:, :n, :n]
        self._here = np.einsum("ij,aji->a", dynamics.gram, self._P)
        self._by_plant = self._persistence(dynamics.transition)
        self.by_plant = inflation(self._by_plant)
        """By the plant alone, (axes,)."""

    def by_frames(self, prior: Gaussian, H: FloatArray, R: FloatArray) -> FloatArray:
        """By the plant and by what a frame corrects, A (I - K H), (axes,): the geometric mean of both."""
        n = len(self._dynamics.transition)
        PH = batched.matmul(prior.covariance, batched.transpose(H))
        K = batched.matmul(PH, batched.inverse(batched.symmetric(batched.matmul(H, PH)) + R))
        kept = np.eye(prior.mean.shape[1])[:, :n] - batched.matmul(K, H[:, :, :n])
        return inflation(np.sqrt(self._by_plant * self._persistence(np.matmul(self._dynamics.end_rows, kept))))

    def _persistence(self, transition: FloatArray) -> FloatArray:
        """Rms of the path that an error of the prior makes in the next exposure, over that in this one, (axes,)."""
        moved = np.matmul(transition, self._P)
        there = (np.matmul(self._dynamics.gram, moved) * transition).sum(axis=(1, 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(self._here > 0, np.sqrt(np.maximum(there, 0.0) / self._here), 0.0))


def inflation(rho: FloatArray) -> FloatArray:
    """Variance of a mean of errors correlated by rho, over that of independent ones: (1 + rho) / (1 - rho), bounded."""
    return np.asarray(np.minimum(MOST_INFLATION, (1 + rho) / np.maximum(1 - rho, 1e-9)))


def _arrays(done: Update) -> tuple[FloatArray, ...]:
    assert done.gate is not None
    after = done.posterior
    return after.mean, after.covariance, done.innovation, done.innovation_covariance, done.nis, done.gate


def _contiguous(values: FloatArray) -> FloatArray:
    return np.ascontiguousarray(values, dtype=np.float64)
