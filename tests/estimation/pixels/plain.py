"""The plain twins, in NumPy, of what compiled code does for pixels: of a line sensor, and of spots on a plane."""

import math

import numpy as np

from aolink.estimation import Profile
from aolink.estimation.pixels import importance
from aolink.estimation.pixels.constants import PROFILE
from aolink.estimation.pixels.gaussian_mixture import GaussianMixture, log_sum
from aolink.estimation.pixels.likelihood import PixelView
from aolink.estimation.pixels.modes import find_modes, whitened
from aolink.numerics import batched
from aolink.numerics.covariance import cholesky
from aolink.optics.kernel import pixel_masses
from aolink.optics.plane import mehler_series
from tests.estimation.moments.plain import PlainMoments
from tests.kinds import must_be


class PlainView(PixelView):
    """A `PixelView` whose likelihood and modes are those of NumPy."""

    sees_line: bool

    @classmethod
    def of(cls, view):
        """The twin of a view."""
        twin = cls.__new__(cls)
        twin.__dict__.update(vars(view), on_line=False, sees_line=view.on_line)
        return twin

    @property
    def work(self):
        """That of the view, which decides on the number of points."""
        twin = PixelView.__new__(PixelView)
        twin.__dict__.update(vars(self), on_line=self.sees_line)
        return twin.work

    def moments(self, about):
        if not self.sees_line:
            return super().moments(about)
        return PlainMoments(self.sensor.profile).look(self.nodes, about, must_be(Profile, self.measured))

    def predicted(self, t):
        """Densities of the pixels without noise, (axes, k, pixels)."""
        if self.sees_line:
            return self.linearised(t)[0]
        w, edges, terms = self.nodes.weights, self.optics.profile.edges, mehler_series(self.kernel)
        path = self.paths(t).reshape(*t.shape[:2], self.outputs // 2, 2, -1)
        X, Y = (pixel_masses(self.kernel[d, d], edges, path[:, :, :, d], len(terms) - 1) for d in (0, 1))
        light = sum(c * batched.long_matmul(batched.transpose(Y[j]), X[j] * w[:, None]) for j, c in enumerate(terms))
        return np.asarray(light).reshape(*t.shape[:2], -1) / self.optics.pixel_size

    def linearised(self, t):
        if not self.sees_line:
            return self._linearised_spots(t)
        path, w, pixel = self.paths(t)[:, :, 0], self.nodes.weights, self.optics.pixel_size
        mass, slope = pixel_masses(self.kernel[0, 0], self.optics.profile.edges, path, 1)
        f = batched.matmul(w[None], mass)[..., 0, :] / pixel
        return f, batched.long_matmul(np.swapaxes(slope * w[:, None], -1, -2), self.nodes.basis[0]) / pixel

    def _linearised_spots(self, t):
        w, edges, D = self.nodes.weights[:, None], self.optics.profile.edges, self.optics.pixel_size
        lead, size, spots, terms = t.shape[:2], t.shape[2], self.outputs // 2, mehler_series(self.kernel)
        path = self.paths(t).reshape(*lead, spots, 2, -1)
        X, Y = (pixel_masses(self.kernel[d, d], edges, path[:, :, :, d], len(terms)) for d in (0, 1))
        along, across = (self.nodes.basis.reshape(spots, 2, -1, size)[:, d] for d in (0, 1))
        light = np.zeros(())
        slopes = np.zeros(())
        for j, c in enumerate(terms):
            left = batched.transpose(Y[j])
            light = light + c * batched.long_matmul(left, X[j] * w)
            # d/dt sum_k w Y_r X_c: the columns' derivative times the rows, and the other way round.
            columns = (X[j + 1] * w)[..., None] * along[:, :, None, :]
            by_x = batched.long_matmul(left, columns.reshape(*columns.shape[:-2], -1))
            rows = (Y[j + 1] * w)[..., None] * across[:, :, None, :]
            by_y = batched.long_matmul(batched.transpose(X[j]), rows.reshape(*rows.shape[:-2], -1))
            n_rows, n_columns = left.shape[-2], X[j].shape[-1]
            by_x = by_x.reshape(*lead, spots, n_rows, n_columns, size)
            by_y = by_y.reshape(*lead, spots, n_columns, n_rows, size).swapaxes(-3, -2)
            slopes = slopes + c * (by_x + by_y)
        return light.reshape(*lead, -1) / D, slopes.reshape(*lead, -1, size) / D

    def log_likelihoods(self, t):
        return self.log_likelihood(self.predicted(t))


def with_noise(prior, t):
    """Log-densities of t = (start state, standard normal noise coefficients), (axes, points, n) -> (axes, points)."""
    states = prior.mean.shape[2]
    rest = t[..., states:]
    constant = -0.5 * rest.shape[-1] * math.log(2 * math.pi)
    return prior.log_density(t[..., :states]) - 0.5 * np.add.reduce(rest * rest, axis=-1) + constant


def settled_modes(view, prior, starts):
    """`find_modes` again from where it has ended, until a search leads next to nowhere."""
    modes = find_modes(view, prior, starts)
    for _ in range(4):
        modes = find_modes(view, prior, whitened(prior, modes.mean))
    return modes


def importance_corrected(view, prior, proposal, share, enough):
    """The twin of `importance.importance_corrected`."""
    n = view.reduced.size
    points = importance.points_of_round(view, share)
    proposals = list[GaussianMixture]()
    t = np.zeros((len(prior.mean), 0, n))
    target, effective = np.zeros(t.shape[:2]), np.zeros(len(t))
    fit, going_on = proposal, np.ones(len(t), dtype=bool)
    for k in range(PROFILE.rounds):
        new = _drawn(proposal, points, k)
        proposals.append(proposal)
        t = np.concatenate([t, new], axis=1)
        target = np.concatenate([target, with_noise(prior, new) + view.log_likelihoods(new)], axis=1)
        log_weight = target - log_sum(np.stack([q.log_density(t) for q in proposals], axis=1), axis=1)
        log_weight -= log_sum(log_weight, axis=1)[:, None]
        effective = np.where(going_on, np.exp(-log_sum(2 * log_weight, axis=1)), effective)
        tempered = _tempered(log_weight, PROFILE.least_effective)
        scale = PROFILE.loosened if k else PROFILE.tightened
        scaled = proposal._replace(covariance=proposal.covariance * scale)
        last = _refitted(proposal, t, tempered, scaled, n * PROFILE.last_prior_points)
        some = np.flatnonzero(going_on)
        fit = fit.replaced(some, last.part(some))
        going_on &= effective < enough
        if not going_on.any():
            break
        proposal = _refitted(proposal, t, tempered, proposal, n * PROFILE.prior_points)
    return fit, effective


def _tempered(log_weight, least):
    """Weights raised to the largest power up to one at which the effective sample size is ``least``, or half of all."""
    least = min(least, log_weight.shape[1] / 2)
    low, high = np.zeros(len(log_weight)), np.ones(len(log_weight))
    power = high
    for _ in range(PROFILE.halvings):
        w = power[:, None] * log_weight
        enough = -log_sum(2 * (w - log_sum(w, axis=1)[:, None]), axis=1) >= math.log(least)
        low, high = np.where(enough, power, low), np.where(enough, high, power)
        power = (low + high) / 2
        power = np.where(low == 1, 1.0, power)
    w = np.where(low == 1, 1.0, low)[:, None] * log_weight
    return w - log_sum(w, axis=1)[:, None]


def _drawn(proposal, count, number):
    """Points of a mixture, (axes, count, n); those of each round have a number."""
    axes, _, n = proposal.mean.shape
    u, e = importance.quasi_random(count, n, number)
    total = np.cumsum(np.exp(proposal.log_weight), axis=1)
    component = np.minimum((total[:, None] < u[:, None] * total[:, -1:, None]).sum(axis=2), total.shape[1] - 1)
    rows = np.arange(axes)[:, None]
    root = cholesky(proposal.covariance)[rows, component]
    return np.asarray(proposal.mean[rows, component] + np.add.reduce(root * e[:, None], axis=-1))


def _refitted(mixture, points, log_weight, beside, prior_points):
    """One EM step with weighted points; the covariances of ``beside`` count as ``prior_points`` more."""
    logs = mixture.component_log_densities(points)
    share = np.exp(logs - log_sum(logs, axis=1)[:, None] + log_weight[:, None])  # (axes, components, points)
    mass = np.add.reduce(share, axis=2)
    effective = mass**2 / np.maximum(np.add.reduce(share * share, axis=2), 1e-300)
    safe = np.maximum(mass, 1e-300)[..., None]
    mean = batched.long_matmul(share, points) / safe
    mean = np.where(mass[..., None] > 1e-9, mean, mixture.mean)
    away = points[:, None] - mean[:, :, None]
    spread = batched.long_matmul(batched.transpose(away * share[..., None]), away) / safe[..., None]
    trust = (effective / (effective + prior_points))[..., None, None]
    covariance = batched.symmetric(trust * spread + (1 - trust) * beside.covariance)
    mass = np.where(mass > PROFILE.negligible * np.add.reduce(mass, axis=1)[:, None], mass, 0.0)
    with np.errstate(divide="ignore"):
        return GaussianMixture(np.log(mass / np.add.reduce(mass, axis=1)[:, None]), mean, covariance)
