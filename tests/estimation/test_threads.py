"""The bits of an estimate do not depend on the number of threads."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import hashlib
import dataclasses
import numpy as np
from aolink.estimation import ESTIMATOR_NAMES, exposure_model, run
from aolink.estimation.kalman.filter import BlurFilter
from aolink.estimation.pixels import joint_pixels
from aolink.estimation.frames.spots import measure_spots
from aolink.estimation.moments.windowed import WindowedMoments
from aolink.estimation.frames.frame_data import Needs, Profile
from aolink.rig import load_rig
from aolink.simulation.model import simulate

digest = hashlib.sha256()
rig = load_rig("section-vi-lively")
for estimates in run(rig, simulate(rig, 10), ESTIMATOR_NAMES).values():
    for e in estimates:
        for value in (e.path, e.path_sd, e.end_state, e.end_covariance, e.coefficient_covariance, e.nis):
            digest.update(value.tobytes())
plant = dataclasses.replace(rig.plant, axes=64)
rng = np.random.default_rng(1)
profile = Profile(density=rng.standard_normal((64, 40)), mask=np.ones((64, 40), bool))
model = exposure_model(plant, 200)
step = BlurFilter(plant, WindowedMoments(rig.sensor, 1)).step(model, model.response(rng.random((200, 64))), profile)
digest.update(step.coefficients.covariance.tobytes())
small = load_rig("sh-4x4")
sensor = dataclasses.replace(small.sensor, grid=(30, 30))
plant = dataclasses.replace(small.plant, axes=1800)
pixels = rng.integers(400, 700, sensor.shape).astype(np.uint16)
needs = Needs(what="moments", orders=(1, 2))
measured, _ = measure_spots(sensor, plant, pixels, np.ones(sensor.shape, bool), needs, least_significance=-99.0)
digest.update(measured.value.tobytes() + measured.covariance.tobytes())
membrane = load_rig("membrane-12x12")
for estimates in run(membrane, simulate(membrane, 2), ["o3", "moments"]).values():
    for value in (estimates[-1].coefficients, estimates[-1].coefficient_covariance, estimates[-1].end_covariance):
        digest.update(value.tobytes())
joint_pixels.LARGEST_SPREAD = 9.0  # pixels from the first exposure on
e = run(membrane, simulate(membrane, 1), ["profile"])["profile"][0]
digest.update(e.coefficients.tobytes() + e.coefficient_covariance.tobytes() + e.nis.tobytes())
print(digest.hexdigest())
"""


def digest(threads: int) -> str:
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    environment = os.environ | dict.fromkeys(names, str(threads))
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    return done.stdout


@pytest.mark.rare
def test_one_thread_and_two_give_the_same_bits():
    assert digest(1) == digest(2) != ""
