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

import numpy as np

from aolink.estimation.frames.frame_data import HALF, Needs, SpotWindows
from aolink.estimation.kalman.gaussian import Gaussian
from aolink.estimation.model.quadrature import QuadraturePaths
from aolink.estimation.moments.windowed import Regression, Windowed, expected_response, weighted_sums
from aolink.numerics import batched
from aolink.numerics.arrays import BoolArray, FloatArray
from aolink.optics.sensor import SpotSensor

# Covariances are between every two nodes, directions and spots: so there are fewer nodes than for a line sensor.
_MOST_NODES = 40
# Terms of Mehler's series: what the fifth adds is in the rounding unless the two directions are one.
_TERMS = 5
_HIGHEST = 7
# A row of pixels of which more are missing is left out; so is, of the rest, a column with any missing.
_LEAST_OF_A_ROW = 0.5


class WindowedSpots(Windowed[SpotWindows]):
    """Windowed moments of all spots that one copy of the plant moves; its outputs are spot 0's x and y, spot 1's x and
    y, ...

    Of each spot the light in its window, the moments of the orders 1 to 3 along x and along y, and y_11 are taken.
    """

    most_nodes = _MOST_NODES
    orders = ((0, 0), (1, 0), (2, 0), (3, 0), (0, 1), (0, 2), (0, 3), (1, 1))
    needs = Needs(what="windows", least_usable=HALF)

    def __init__(self, sensor: SpotSensor, spots: int) -> None:
        self.sensor, self.spots = sensor, spots
        self.n_measurements = spots * len(self.orders)

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
