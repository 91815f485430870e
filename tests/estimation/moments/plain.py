"""The plain twin, in NumPy, of the compiled windowed moments of line sensors."""

import numpy as np

from aolink.estimation.frames.frame_data import Profile
from aolink.estimation.moments.lines import ORDERS, WindowedMoments
from aolink.estimation.moments.windowed import Regression, Windowed, expected_response, weighted_sums
from aolink.numerics import batched


class PlainMoments(Windowed[Profile]):
    """`WindowedMoments` with the arithmetic of `Windowed`."""

    n_measurements, needs = WindowedMoments.n_measurements, WindowedMoments.needs

    def __init__(self, sensor):
        self.sensor = sensor

    def look(self, nodes, about, measured):
        """The weighted sums, their noise, and their regression on the coefficients."""
        basis = nodes.basis[0]
        mean = batched.matvec(basis, about.mean) + nodes.inputs[:, 0]
        spread = batched.congruence(basis, about.covariance)
        W = self.window_weights(mean, np.einsum("akk->ak", spread), measured.mask)
        y, noise = weighted_sums(self.sensor, W, measured.density, measured.light)
        return y, noise, self.regression(W, mean, spread, basis, nodes.weights, nodes.widening)

    def window_weights(self, mean, variance, mask):
        """Weights of the pixels about a path, (axes, sums, pixels), from its mean and variance, both (axes, nodes)."""
        u, inside = self.window(self.sensor, self.sensor.kernel.variance, mean, variance, mask)
        return np.stack([u**p * inside for p in ORDERS], axis=1)

    def regression(self, W, mean, spread, basis, weights, widening=0.0):
        """Regression of the weighted sums on the coefficients.

        Parameters
        ----------
        W:
            (axes, m, pixels)
        mean, spread:
            Mean and covariance of the path at its nodes, (axes, nodes) and (axes, nodes, nodes).
        basis, weights:
            Rows of the exposure basis at the nodes, (nodes, n_coefficients), and the nodes' weights, (nodes,).
        widening:
            Variance of the path about its nodes that no coefficient covers, slope units squared.
        """
        variance = np.maximum(np.einsum("akk->ak", spread), 0.0) + widening
        g = expected_response(self.sensor.kernel.variance, self.sensor.edges, W, mean, variance)
        light = weights[:, None]
        # Mehler: Cov(g(a), g(b)) is the sum over j of C^j / j! times the means of the j-th derivatives.
        square = spread * spread
        remainder = sum(
            batched.matmul(batched.transpose(light * g[j]), batched.matmul(power, light * g[j]))
            for j, power in ((2, square / 2), (3, square * spread / 6))
        )
        slope = batched.matmul(batched.transpose(light * g[1]), np.broadcast_to(basis, (len(W), *basis.shape)))
        return Regression((light * g[0]).sum(axis=1), slope, batched.symmetric(np.asarray(remainder)))
