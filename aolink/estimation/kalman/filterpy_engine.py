"""The paper's filters on filterpy, for one axis: a check of ours, and a start for users' own filters. filterpy takes a
second to import and computes one axis at a time, so it is imported only where it is asked for.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import linalg

from aolink.estimation.frames.frame_data import Measurement
from aolink.estimation.kalman.gaussian import Gaussian, Update
from aolink.estimation.kalman.path_moments import PathMoments, predicted_moments
from aolink.estimation.model.base import ExposureModel, InputResponse
from aolink.numerics.arrays import FloatArray


class FilterpyMoments(PathMoments):
    """`PathMoments` with every update and prediction done by filterpy."""

    def update(self, model: ExposureModel, response: InputResponse, prior: Gaussian, measured: Measurement) -> Update:
        """KalmanFilter for the centroid alone, ExtendedKalmanFilter where the second moment is taken."""
        from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter

        linear = self.orders == (1,)
        kind = KalmanFilter if linear else ExtendedKalmanFilter
        ekf = kind(dim_x=prior.mean.shape[1], dim_z=self.n_measurements)
        ekf.x, ekf.P = prior.mean[0][:, None].copy(), prior.covariance[0].copy()
        # Spots share no noise, so their covariance may come as its blocks; filterpy takes the whole matrix.
        noise = measured.covariance[0]
        ekf.R = linalg.block_diag(*noise) if noise.ndim == 3 else np.array(noise)
        if linear:
            self._update_linear(ekf, model, measured.value[0][:, None] - response.mean[0][:, None])
        else:
            ekf.update(
                measured.value[0][:, None],
                lambda x: predicted_moments(model, response, x.T, self.orders)[1][0],
                lambda x: predicted_moments(model, response, x.T, self.orders)[0].T,
            )
        nis = (ekf.y.T @ np.linalg.solve(ekf.S, ekf.y))[0]
        return Update(Gaussian(ekf.x.T, ekf.P[None]), ekf.y.T, ekf.S[None], nis)

    def _update_linear(self, kf: Any, model: ExposureModel, z: FloatArray) -> None:
        H = model.mean_row
        kf.H = H
        if self.gain is None:
            kf.update(z)
            return
        P, R = kf.P, kf.R
        kf.K = self.gain
        kf.update_steadystate(z)
        # filterpy leaves the covariance alone where the gain is constant; this is what it is.
        keep = np.eye(len(P)) - self.gain @ H
        kf.P = keep @ P @ keep.T + self.gain @ R @ self.gain.T
        kf.S = H @ P @ H.T + R

    def predict(self, state: Gaussian, transition: FloatArray, noise: FloatArray, kick: FloatArray) -> Gaussian:
        """KalmanFilter.predict, the response to the inputs as its input."""
        from filterpy.kalman import KalmanFilter

        n = len(transition)
        kf = KalmanFilter(dim_x=n, dim_z=1, dim_u=n)
        kf.x, kf.P = state.mean[0][:, None].copy(), state.covariance[0].copy()
        kf.F, kf.Q, kf.B = transition, noise, np.eye(n)
        kf.predict(u=kick[0][:, None])
        return Gaussian(kf.x.T, kf.P[None])
