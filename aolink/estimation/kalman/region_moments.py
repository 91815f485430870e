"""What a filter takes of a region of any picture: mean and covariance of its path (`aolink.optics.texture`)."""

from __future__ import annotations

import numpy as np

from aolink.estimation.frames.frame_data import Measurement, Needs
from aolink.estimation.kalman.gaussian import Gaussian, Update
from aolink.estimation.kalman.update import blocked_update
from aolink.estimation.model.base import ExposureModel, InputResponse
from aolink.numerics.arrays import FloatArray
from aolink.optics.texture import Texture


class RegionMoments:
    """Mean, and covariance, of the path along x and y, as far as a texture shows them.

    With coefficients z ~ N(m, P) and the path's deviation from its mean in the exposure R z + c, the covariance of
    outputs a and b is quadratic, z'M z + ..., M = mean (R_a'R_b + R_b'R_a)/2. It is taken to second order, which is
    exact: its mean has tr(M P) more, its covariance with that of another pair 2 tr(M P M' P). Athans, Wishner,
    Bertolini, IEEE Trans. Automatic Control 13 (1968).
    """

    def __init__(self, texture: Texture, orders: tuple[int, ...], *, models_noise: bool) -> None:
        self.needs, self.models_noise = Needs(what="moments", orders=orders), models_noise
        self._means, self._spreads = texture.known_means, texture.known_spreads[: 3 if 2 in orders else 0]
        self.n_measurements = len(self._means) + len(self._spreads)
        self._of_model: tuple[ExposureModel, FloatArray, FloatArray] | None = None

    def update(self, model: ExposureModel, response: InputResponse, prior: Gaussian, measured: Measurement) -> Update:
        if self._of_model is None or self._of_model[0] is not model:
            rows = model.basis if self.models_noise else model.state_rows
            after = model.rows_after[:, : rows.shape[2]]
            rows = np.concatenate([model.seen(rows), after[:, None]], axis=1)  # (outputs, steps, coefficients)
            share = np.append(np.full(model.exposed_steps, 1 / model.exposed_steps), model.moved)
            share[0] -= model.moved
            self._of_model = model, rows, share
        _, rows, share = self._of_model
        (z,), P = prior.mean, prior.covariance[0]
        known = np.concatenate([model.seen_path(response.path), model.last_response(response.end)[..., None]], axis=2)
        path = known[0] + rows @ z
        mean, mean_rows = path @ share, np.einsum("osn,s->on", rows, share)
        away, R = path - mean[:, None], rows - mean_rows[:, None]
        pairs = ((0, 0), (0, 1), (1, 1))
        M = np.array([(R[a].T * share) @ R[b] for a, b in pairs])
        M = (M + M.swapaxes(1, 2)) / 2
        MP = M @ P
        spread = np.array([(away[a] * share) @ away[b] for a, b in pairs]) + np.trace(MP, axis1=1, axis2=2)
        spread_rows = np.array([(away[a] * share) @ R[b] + (away[b] * share) @ R[a] for a, b in pairs])
        T, count = self._spreads, len(self._means)
        expected = np.concatenate([self._means @ mean, T @ spread])
        H = np.concatenate([self._means @ mean_rows, T @ spread_rows])
        noise = measured.single_block.copy()
        noise[:, count:, count:] += T @ (2 * np.einsum("aij,bji->ab", MP, MP)) @ T.T
        return blocked_update(prior, measured.value - expected, H[None], noise[:, None])
