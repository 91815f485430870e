"""The plain twins, in NumPy, of what compiled code does for pixels: of a line sensor, and of spots on a plane."""

import numpy as np

from aolink.estimation.moments.windowed import WindowedMoments
from aolink.estimation.pixels import modes
from aolink.estimation.pixels.levenberg_marquardt import Place, minimise
from aolink.estimation.pixels.likelihood import PixelView
from aolink.numerics import batched
from aolink.numerics.covariance import cholesky
from aolink.optics.kernel import pixel_masses
from aolink.optics.plane import mehler_series


def whitened(prior, t):
    """Coordinates of points t (axes, k, n) in which the prior is N(0, I)."""
    return np.linalg.solve(cholesky(prior.covariance), batched.transpose(t - prior.mean[:, None])).swapaxes(-1, -2)


def by_moments(view, prior):
    """The posterior of windowed moments, from which searches start."""
    moments = WindowedMoments(view.sensor, view.outputs)
    return moments.updated(view.dynamics, view.moment_nodes, prior, view.measured).posterior


class PlainView(PixelView):
    """A `PixelView` whose likelihood and modes are those of NumPy."""

    sees_line: bool

    @classmethod
    def of(cls, view):
        """The twin of a view."""
        twin = cls.__new__(cls)
        twin.__dict__.update(vars(view), on_line=False, sees_line=view.on_line)
        return twin

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

    def paths(self, t):
        """Outputs at the nodes, (axes, k, n_outputs, nodes)."""
        flat = batched.long_matmul(t, self.rows.T)
        return np.asarray(flat.reshape(*t.shape[:2], self.outputs, -1) + self.nodes.inputs[:, None])

    def log_likelihood(self, f):
        """Log-likelihood of the usable pixels, up to a constant, (axes, k), if f (axes, k, pixels) is expected."""
        R = self._variance(f)
        e = self.y[:, None] - f
        terms = e * e / R
        if self.gain:
            terms = terms + np.log(R / self.read_noise)
        return np.asarray(-0.5 * np.add.reduce(np.where(self.mask[:, None], terms, 0.0), axis=-1))

    def information(self, f):
        """Score and Fisher information of each pixel by its expected density f, all (axes, k, pixels).

        The variance grows with f (shot noise), which adds information of its own.
        """
        R = self._variance(f)
        e = self.y[:, None] - f
        score, information = e / R, 1 / R
        if self.gain:
            grows = np.where(f > 0, self.gain, 0.0)
            score = score + grows * (e * e / R - 1) / (2 * R)
            information = information + grows**2 / (2 * R * R)
        usable = self.mask[:, None]
        return np.where(usable, score, 0.0), np.where(usable, information, 0.0)

    def _variance(self, f):
        return self.read_noise + self.gain * np.maximum(f, 0.0)


def find_modes(view, prior, starts):
    """The mode that each start, in whitened coordinates, (axes, starts, n), leads to, with this prior of each axis."""
    axes, count, n = starts.shape
    rows = view.part(np.repeat(np.arange(axes), count))
    m, L = np.repeat(prior.mean, count, axis=0)[:, None], cholesky(np.repeat(prior.covariance, count, axis=0))

    def at(one):
        seen = rows.part(one), m[one], L[one]
        return lambda s: _at(*seen, s[None])

    each = [
        minimise(at(slice(k, k + 1)), start, modes.PASSES, modes.CONVERGED)
        for k, start in enumerate(starts.reshape(-1, n))
    ]
    s, objective, _, hessian = (np.array(values) for values in list(zip(*each, strict=True))[:4])
    covariance = batched.congruence(L, batched.symmetric(np.asarray(np.linalg.inv(hessian), dtype=np.float64)))
    _, log_H = np.linalg.slogdet(hessian)
    evidence = -objective - 0.5 * log_H
    mean = m[:, 0] + batched.matvec(L, s)
    score, information = (value[:, 0] for value in rows.information(rows.predicted(mean[:, None])))
    square = (score**2 / np.where(information > 0, information, 1.0)).reshape(len(mean), -1).sum(axis=1)
    free = n - np.trace(np.linalg.inv(hessian), axis1=1, axis2=2)
    numbers = (evidence, square + batched.dot(s, s), square + free, objective)
    return modes.Modes(
        mean.reshape(axes, count, n), batched.symmetric(covariance).reshape(axes, count, n, n),
        *(value.reshape(axes, count) for value in numbers),
    )  # fmt: skip


def modes_of(view, prior, wide, at_length):
    """The modes of a posterior; ``wide`` is the posterior of windowed moments, from which searches start.

    A search starts at its mean and, where it is to be ``at_length``, (axes,), at points on both sides of it
    (`spread_starts`). After their modes come those that the best mode's reversal and mirror images lead to.
    """
    starts, squares = spread_starts(view, prior, wide)
    many = at_length & (squares[:, 0] > modes.WIDE_PATH * view.kernel_variance)
    found = find_modes(view, prior, starts[:, :1])
    for which, some in ((at_length, starts[:, 1:3]), (many, starts[:, 3:])):
        if len(rows := np.flatnonzero(which)):
            found = with_more(found, rows, find_modes(view.part(rows), prior.part(rows), some[rows]))
    if len(rows := np.flatnonzero(at_length)):
        best = found.mean[rows, found.best[rows]][:, None]
        back = reversed_starts(view.part(rows), prior.part(rows), best)
        found = with_more(found, rows, find_modes(view.part(rows), prior.part(rows), back))
    return found


def _at(rows, m, L, s):
    """Information, gradient and objective at whitened coordinates, one start a row."""
    f, J = rows.linearised(m + batched.matvec(L, s)[:, None])
    score, information = rows.information(f)
    J = batched.long_matmul(J[:, 0], L)
    H = batched.long_matmul(batched.transpose(J) * information, J) + np.eye(s.shape[1])
    g = batched.matvec(batched.transpose(J), score[:, 0]) - s
    objective = 0.5 * batched.dot(s, s) - rows.log_likelihood(f)[:, 0]
    return Place(s[0], float(objective[0]), g[0], batched.symmetric(H)[0])


def spread_starts(view, prior, wide):
    """The mean of a wide Gaussian and points on both sides of it along the path's most uncertain directions.

    They are (axes, 1 + 2 directions, n), in coordinates in which the prior is N(0, I): the mean, and a pair for each
    direction. The second result is the mean square of the path along each direction at one standard deviation, the
    largest first, (axes, n).
    """
    axes, n = wide.mean.shape
    L = cholesky(wide.covariance)
    values, V = np.linalg.eigh(batched.symmetric(batched.matmul(batched.transpose(L), batched.matmul(view.gram, L))))
    V = batched.transpose(V[:, :, ::-1])
    along = batched.matmul(V[:, : modes.DIRECTIONS], batched.transpose(L)) * modes.START_REACH
    mean = wide.mean[:, None]
    pairs = np.stack([mean + along, mean - along], axis=2).reshape(axes, -1, n)
    return whitened(prior, np.concatenate([mean, pairs], axis=1)), values[:, ::-1]


def reversed_starts(view, prior, points):
    """Whitened coordinates of paths with the same blur as those of points, (axes, k, n) -> (axes, 3 k, n).

    The paths are reversed in time, which gives the same blur; mirrored about their mean, which gives the same blur
    where it is symmetric, as that of a vibration is; and both.
    """
    L, m = cholesky(prior.covariance), prior.mean
    nodes, outputs = view.whole_nodes, view.outputs
    rows = view.rows.reshape(outputs, -1, view.reduced.size)[:, :nodes].reshape(outputs * nodes, -1)
    weights = view.nodes.weights[:nodes] / view.nodes.weights[:nodes].sum()
    precision = np.tile(weights, outputs) * modes.precision_of_reversal(view)
    B = batched.matmul(np.broadcast_to(rows, (len(L), *rows.shape)), L)
    path = view.paths(points)[..., :nodes]
    mirrored = 2 * (path @ weights)[..., None] - path
    like = np.concatenate([path[..., ::-1], mirrored, mirrored[..., ::-1]], axis=1)
    back = like.reshape(len(like), -1, outputs * nodes)
    away = back - view.paths(m[:, None])[..., :nodes].reshape(-1, 1, outputs * nodes)
    weighted = B * precision[:, None]
    H = batched.matmul(batched.transpose(weighted), B) + np.eye(B.shape[-1])
    right = batched.matmul(away, weighted)
    return np.asarray(np.linalg.solve(H, batched.transpose(right)).swapaxes(-1, -2))


def with_more(found, axes, more):
    """The same modes, and after them those that more starts of some axes led to."""
    spread = modes.Modes.none(len(found.mean), *more.mean.shape[1:])
    for room, new in zip(spread, more, strict=True):
        room[axes] = new
    return modes.Modes(*(np.concatenate(each, axis=1) for each in zip(found, spread, strict=True)))


def settled_modes(view, prior, starts):
    """The modes again from where the search has ended, until it leads next to nowhere."""
    search = find_modes if isinstance(view, PlainView) else modes.find_modes
    found = search(view, prior, starts)
    for _ in range(4):
        found = search(view, prior, whitened(prior, found.mean))
    return found
