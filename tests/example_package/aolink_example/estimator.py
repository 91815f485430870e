"""An estimator of another package: the centroid of the pixels above a threshold, in a Kalman filter."""

import numpy as np

from aolink.estimation import BlurFilter, EstimatorRow, Needs, joseph_update

THRESHOLD = 0.2  # of the brightest pixel
CENTROID_SD = 0.1  # slope units


class Threshold:
    needs = Needs(what="profile")
    models_noise = False
    n_measurements = 1

    def __init__(self, sensor):
        self.sensor = sensor

    def update(self, model, response, prior, measured):
        brightest = measured.density.max(axis=1, keepdims=True)
        light = np.where(measured.density > THRESHOLD * brightest, measured.density, 0.0)
        centroid = light @ self.sensor.centres / light.sum(axis=1)
        innovation = centroid[:, None] - prior.mean @ model.mean_row.T - response.mean
        H = np.tile(model.mean_row, (len(innovation), 1, 1))
        R = np.full((len(innovation), 1, 1), CENTROID_SD**2)
        return joseph_update(prior, innovation, H, R)


def refusal(rig):
    several = f"threshold follows one output of each copy of the plant, {rig.name} has several: use o1"
    return several if rig.plant.n_outputs > 1 else None


def build(rig, options):
    return BlurFilter(rig.plant, Threshold(rig.sensor.profile), gate=options.gate)


ROW = EstimatorRow(name="threshold", rank=15, colour=(250, 250, 120), build=build, refusal=refusal)
