"""Windowed moments of spots on a plane, for plants of which one copy moves whole spots.

A moment is sum_rc a(c) b(r) Y_rc, a function a of the columns times one b of the rows, in a window about the spot
in both directions. Kernel and prior together displace the spot by a Gaussian (X, Y) from where the path's mean has
it, and E[a(X) b(Y)] is, by Mehler's series, the sum over j of c^j / j! E[a^(j)(X)] E[b^(j)(Y)], c their covariance:
a kernel that couples the two directions is one that adds to c. Each factor is in closed form, as
for a line sensor; so are the regression on the coefficients and what it leaves out.

All sums of all spots of one copy are one observation. The cross moment y_11 belongs to it: it distinguishes motion
along one diagonal from motion along the other, which the moments of the two directions by themselves do not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from aolink.estimation.frames.frame_data import HALF, Flux, Needs, SpotWindows
from aolink.estimation.frames.moments import LEAST_FLUX
from aolink.estimation.kalman.gaussian import Gaussian, Update
from aolink.estimation.kalman.update import joseph_update
from aolink.estimation.model.base import ExposureModel, InputResponse
from aolink.estimation.model.quadrature import QuadraturePaths, equal_parts, quadrature_paths
from aolink.estimation.moments.windowed import (
    KERNEL_REACH,
    MOST_MEMORY,
    NOT_BELIEVED,
    PASSES,
    PATH_REACH,
    Regression,
    error_memory,
    expected_response,
    slowest,
    weighted_sums,
)
from aolink.numerics import batched
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.sensor import Sensor, SpotSensor

# Covariances are between every two nodes, directions and spots: so there are fewer nodes than for a line sensor.
_MOST_NODES = 40
# Axes together: more of them do not fit into the processor's cache.
_AT_ONCE = 8
# Terms of Mehler's series: what the fifth adds is in the rounding unless the two directions are one.
_TERMS = 5
_HIGHEST = 7
# A row of pixels of which more are missing is left out; so is, of the rest, a column with any missing.
_LEAST_OF_A_ROW = 0.5


class WindowedSpots:
    """Windowed moments of all spots that one copy of the plant moves; its outputs are spot 0's x and y, spot 1's x and
    y, ...

    ``orders`` are those of the moments along x and along y; 0 is the light in the window. The first along both belongs
    to the sums as well, y_11.

    ``flux`` is "known" where the light of a frame sums to one; where it is "measured", a spot's sums are divided by
    the light in its window, and order 0 is left out.
    """

    models_noise = True
    most_nodes = _MOST_NODES
    most_memory = MOST_MEMORY
    """Bound of `error_memory`; with 1, errors of an exposure count as independent of those before."""

    def __init__(
        self, sensor: SpotSensor, spots: int, orders: Sequence[int] = (0, 1, 2, 3), *, flux: Flux = "known"
    ) -> None:
        self.sensor, self.spots = sensor, spots
        beyond = [p for p in orders if p]
        light = [(0, 0)] if flux == "measured" or 0 in orders else []
        self.orders = [*light, *((p, 0) for p in beyond), *((0, p) for p in beyond), (1, 1)]
        self.needs, self.flux = Needs(what="windows", least_usable=HALF), flux
        self.n_measurements = spots * (len(self.orders) - (flux == "measured"))

    def update(self, model: ExposureModel, response: InputResponse, prior: Gaussian, measured: SpotWindows) -> Update:
        """Iterated statistical linearisation, from the prior to the posterior."""
        nodes = quadrature_paths(model, response, equal_parts(model.n_steps, self.most_nodes))
        parts = [
            self._update(model, nodes.part(s), prior.part(s), measured.part(s))
            for s in (slice(k, k + _AT_ONCE) for k in range(0, len(prior.mean), _AT_ONCE))
        ]
        if len(parts) == 1:
            return parts[0]
        joined = [np.concatenate(arrays) for arrays in zip(*(_arrays(part) for part in parts), strict=True)]
        return Update(Gaussian(joined[0], joined[1]), *joined[2:])

    def _update(self, model: ExposureModel, nodes: QuadraturePaths, prior: Gaussian, measured: SpotWindows) -> Update:
        about, rho = prior, np.full(len(prior.mean), slowest(model.transition[None])[0])
        memory = error_memory(rho, self.most_memory)
        for to_come in reversed(range(PASSES)):
            y, noise, fit = self.look(nodes, about, measured)
            if self.flux == "measured":
                light = (y / np.sqrt(np.einsum("akk->ak", noise)))[:, :: len(self.orders)].min(axis=1)
                y, noise, fit = self.ratios(y, noise, fit)
            innovation = y - fit.expected - batched.matvec(fit.slope, prior.mean - about.mean)
            R = noise + memory[:, None, None] * fit.remainder
            done = joseph_update(prior, innovation, fit.slope, R)
            about = done.posterior
            if to_come:
                rho_here = np.sqrt(rho * slowest(_closed_loop(model, prior, fit.slope, R)))
                memory = error_memory(rho_here, self.most_memory)
        # The covariance of this one innovation is without the memory.
        HP = batched.matmul(fit.slope, prior.covariance)
        S = batched.symmetric(batched.matmul(HP, batched.transpose(fit.slope)) + noise + fit.remainder)
        nis = batched.dot(innovation, batched.matvec(batched.inverse(S), innovation))
        if self.flux == "measured":
            nis = np.where(light < LEAST_FLUX, NOT_BELIEVED, nis)
        return Update(about, innovation, S, nis)

    def look(
        self, nodes: QuadraturePaths, about: Gaussian, measured: SpotWindows
    ) -> tuple[FloatArray, FloatArray, Regression]:
        """The weighted sums, their noise, and their regression on the coefficients."""
        axes, (_, count, size) = len(about.mean), nodes.basis.shape
        rows = nodes.basis.reshape(self.spots, 2, count, size).swapaxes(1, 2).reshape(-1, size)
        inputs = nodes.inputs.reshape(axes, self.spots, 2, count).swapaxes(2, 3).reshape(axes, -1)
        mean = (batched.matvec(rows, about.mean) + inputs).reshape(axes, self.spots, count, 2)
        spread = batched.congruence(rows, about.covariance).reshape(axes, *(self.spots, count, 2) * 2)
        own = np.einsum("askdske->askde", spread)
        along, across = self.window_functions(mean, np.einsum("askdd->askd", own), measured.mask)
        fit = self.regression(along, across, mean, spread, rows, nodes.weights, nodes.widening)
        y, noise = self.measured(along, across, measured.density, measured.light)
        return y, noise, fit

    def window_functions(
        self, mean: FloatArray, variance: FloatArray, mask: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Functions of the columns and of the rows, both (axes, spots, m, pixels), from mean and variance of the path,
        (axes, spots, nodes, 2), and a mask (axes, spots, rows, columns)."""
        good_rows = mask.mean(axis=3) > _LEAST_OF_A_ROW
        good_columns = (mask | ~good_rows[..., None]).all(axis=2)
        line, kernel, out = self.sensor.profile, self.sensor.kernel.covariance, []
        for direction, good in enumerate((good_columns, good_rows)):
            place, width = (each[..., direction].reshape(-1, mean.shape[2]) for each in (mean, variance))
            u, inside = self.window(line, kernel[direction, direction], place, width, good.reshape(-1, good.shape[-1]))
            functions = [u ** order[direction] * inside for order in self.orders]
            out.append(np.stack(functions, axis=1).reshape(*mean.shape[:2], len(self.orders), -1))
        return out[0], out[1]

    def expectations(
        self, along: FloatArray, across: FloatArray, mean: FloatArray, own: FloatArray
    ) -> list[FloatArray]:
        """Expectations of the sums and of their derivatives by the spot's position, under the prior: for order n, n
        from 0 to 3, the derivatives by x (n - i) times and by y i times, i from 0 to n, (axes, spots, nodes, n + 1, m).

        ``along`` and ``across`` are (axes, spots, m, pixels); ``mean`` and ``own``, mean and covariance of a spot at a
        node, (axes, spots, nodes, 2) and (axes, spots, nodes, 2, 2).
        """
        kernel, edges = self.sensor.kernel.covariance, self.sensor.profile.edges
        variance = np.maximum(np.einsum("askdd->askd", own), 0.0)
        A, B = (
            expected_response(kernel[d, d], edges, each, mean[..., d], variance[..., d], _HIGHEST)
            for d, each in enumerate((along, across))
        )
        shared = (own[..., 0, 1] + kernel[0, 1])[..., None]
        powers = [shared**j / math.factorial(j) for j in range(_TERMS)]

        def derivative(x: int, y: int) -> FloatArray:
            terms = min(_TERMS, _HIGHEST + 1 - max(x, y))
            return np.asarray(sum(powers[j] * (A[j + x] * B[j + y]) for j in range(terms)))

        return [np.stack([derivative(n - i, i) for i in range(n + 1)], axis=3) for n in range(4)]

    def regression(
        self, along: FloatArray, across: FloatArray, mean: FloatArray, spread: FloatArray, rows: FloatArray,
        weights: FloatArray, widening: float = 0.0,
    ) -> Regression:  # fmt: skip
        """Regression of the weighted sums on the coefficients.

        Parameters
        ----------
        along, across:
            Functions of columns and rows, (axes, spots, m, pixels).
        mean, spread:
            Mean and covariance of the path, (axes, spots, nodes, 2) and (axes, spots, nodes, 2, spots, nodes, 2).
        rows:
            Rows of the exposure basis, (spots * nodes * 2, n_coefficients).
        weights:
            Weights of the nodes, (nodes,).
        widening:
            Variance of the path about its nodes that no coefficient covers, slope units squared.
        """
        axes, spots = mean.shape[:2]
        own = np.einsum("askdske->askde", spread)
        if widening:
            own = own + widening * np.eye(2)
        value, *derivatives = (each * weights[:, None, None] for each in self.expectations(along, across, mean, own))
        size = value.shape[-1]
        first, second, third = (batched.transpose(d.reshape(axes, spots, -1, size)) for d in derivatives)
        of_spot = rows.reshape(spots, -1, rows.shape[-1])
        slope = batched.matmul(first, np.broadcast_to(of_spot, (axes, *of_spot.shape)))
        remainder = np.empty((axes, spots, size, spots, size))
        for s in range(spots):
            for t in range(s, spots):
                C = spread[:, s, :, :, t]
                block = sum(
                    batched.matmul(batched.matmul(each[:, s], _meetings(C, n)), batched.transpose(each[:, t]))
                    for n, each in ((2, second), (3, third))
                )
                remainder[:, s, :, t] = block
                remainder[:, t, :, s] = batched.transpose(np.asarray(block))
        joined = batched.symmetric(remainder.reshape(axes, spots * size, spots * size))
        expected = value.sum(axis=2).reshape(axes, -1)
        return Regression(expected, slope.reshape(axes, spots * size, -1), joined)

    def measured(
        self, along: FloatArray, across: FloatArray, density: FloatArray, light: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """The weighted sums, (axes, spots * m), and their noise, which spots do not share, (axes, ., .)."""
        axes, spots, size, _ = along.shape
        W = (across[..., :, None] * along[..., None, :]).reshape(axes, spots, size, -1)
        y, noise = weighted_sums(self.sensor, W, density.reshape(axes, spots, -1), light)
        joint = np.zeros((axes, spots, size, spots, size))
        for k in range(spots):
            joint[:, k, :, k] = noise[:, k]
        return y.reshape(axes, -1), joint.reshape(axes, spots * size, spots * size)

    def window(
        self, sensor: Sensor, kernel: float, mean: FloatArray, variance: FloatArray, mask: BoolArray
    ) -> tuple[FloatArray, BoolArray]:
        """u in [-1, 1] across the window about a path, and the pixels that are in it, both (axes, pixels).

        ``kernel`` is the variance of the kernel in this direction, slope units squared; mean and variance are those of
        the path at its nodes, (axes, nodes); ``mask``, (axes, pixels), is True where a pixel can be used.
        """
        sd = np.sqrt(np.maximum(variance, 0.0))
        margin = KERNEL_REACH * math.sqrt(kernel + sensor.pixel_width**2 / 12)
        # A window needs room on the sensor, wherever the path is expected.
        room = max(margin, 2 * sensor.pixel_width)
        low = np.minimum((mean - PATH_REACH * sd).min(axis=1) - margin, sensor.field[1] - room)
        high = np.maximum((mean + PATH_REACH * sd).max(axis=1) + margin, sensor.field[0] + room)
        low, high = np.maximum(low, sensor.field[0]), np.minimum(high, sensor.field[1])
        edges = sensor.edges
        inside = (edges[1:] > low[:, None]) & (edges[:-1] < high[:, None]) & mask
        return (sensor.centres - (low + high)[:, None] / 2) / ((high - low)[:, None] / 2), inside

    def ratios(self, y: FloatArray, noise: FloatArray, fit: Regression) -> tuple[FloatArray, FloatArray, Regression]:
        """All sums divided by the light that belongs to each, to first order."""
        every, size = np.arange(y.shape[1]), len(self.orders)
        kept = every[every % size > 0]
        lights = kept - kept % size

        def divided(values: FloatArray) -> tuple[FloatArray, FloatArray]:
            light = values[:, lights]
            # Without any light there is no ratio; the NIS says so.
            light = np.where(light == 0, 1.0, light)
            ratio = values[:, kept] / light
            J = np.zeros((*ratio.shape, values.shape[1]))
            rows = np.arange(len(kept))
            J[:, rows, kept], J[:, rows, lights] = 1 / light, -ratio / light
            return ratio, J

        (ratio, at_measured), (expected, at_expected) = divided(y), divided(fit.expected)
        remainder = batched.congruence(at_expected, fit.remainder)
        slope = batched.matmul(at_expected, fit.slope)
        return ratio, batched.congruence(at_measured, noise), Regression(expected, slope, remainder)


def _meetings(C: FloatArray, order: int) -> FloatArray:
    """Terms of Mehler's series between two spots at every two nodes: weights of products of their n-th derivatives.

    Cov(f, f') has, for each n, the sum over all ways to pair n derivatives by x or y of f with n of f', of the product
    of the pairs' covariances, over n!. C is the covariance of the two spots' positions, (axes, nodes, 2, nodes, 2).

    Returns
    -------
    (axes, nodes * (n + 1), nodes * (n + 1)), derivatives in the order of `WindowedSpots.expectations`.
    """
    axes, nodes, _, others, _ = C.shape
    # By the pair's two directions, to the powers from 0.
    powers: list[list[FloatArray | float]] = []
    for a, b in ((1, 1), (1, 0), (0, 1), (0, 0)):
        each: list[FloatArray | float] = [1.0, np.ascontiguousarray(C[:, :, a, :, b])]
        for _ in range(1, order):
            each.append(each[-1] * each[1])
        powers.append(each)
    out = np.empty((axes, nodes, order + 1, others, order + 1))
    for i in range(order + 1):
        for j in range(order + 1):
            total: FloatArray | float = 0.0
            for both in range(max(0, i + j - order), min(i, j) + 1):
                pairs = (both, i - both, j - both, order - i - j + both)
                yy, yx, xy, xx = (each[k] for each, k in zip(powers, pairs, strict=True))
                total += (yy * xx) * (yx * xy) / math.prod(math.factorial(k) for k in pairs)
            out[:, :, i, :, j] = total
    return out.reshape(axes, nodes * (order + 1), others * (order + 1))


def _arrays(correction: Update) -> tuple[FloatArray, ...]:
    after = correction.posterior
    rest = correction.innovation, correction.innovation_covariance, correction.nis
    return (after.mean, after.covariance, *rest)


def _closed_loop(model: ExposureModel, prior: Gaussian, H: FloatArray, R: FloatArray) -> FloatArray:
    """How an error of the start state goes on to the next exposure's, A (I - K H), (axes, n_states, n_states)."""
    n = len(model.transition)
    PH = batched.matmul(prior.covariance, batched.transpose(H))
    K = batched.matmul(PH, batched.inverse(batched.symmetric(batched.matmul(H, PH)) + R))
    kept = np.eye(prior.mean.shape[1])[:, :n] - batched.matmul(K, H[:, :, :n])
    return batched.matmul(np.broadcast_to(model.end_rows, (len(kept), *model.end_rows.shape)), kept)
