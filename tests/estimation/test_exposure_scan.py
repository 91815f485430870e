"""The exposure scan against ensembles of simulated exposures that o1 really estimates."""

import dataclasses
import json

import numpy as np
import pytest

from aolink.errors import EstimatorError
from aolink.estimation import make_estimator
from aolink.estimation.exposure_scan import best, candidates, exposure_scan, with_exposure
from aolink.rig import load_rig, parse_rig
from aolink.simulation.model import simulate
from tests.kinds import truth_of

LIVELY = load_rig("section-vi-lively")


def ensemble(rig, n_steps, exposures, seed):
    """Root mean squares of o1's error in the path and in the output after it."""
    rig = with_exposure(rig, n_steps)
    estimator = make_estimator(rig, "o1")
    path, end = [], []
    for exposure in simulate(rig, exposures, seed):
        estimate = estimator.step(exposure)
        path.append(estimate.path - truth_of(exposure).path)
        end.append((rig.plant.C @ (estimate.end_state - truth_of(exposure).end_state)[..., None]).ravel())
    return np.sqrt(np.mean(np.square(path[20:]))), np.sqrt(np.mean(np.square(end[20:])))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "n_steps", "dead"), [
    ("section-vi-lively", 50, 0), ("section-vi-lively", 400, 30), ("single-lenslet", 200, 0), ("jitter", 30, 0),
])  # fmt: skip
def test_errors_are_those_of_an_ensemble(name, n_steps, dead):
    rig = load_rig(name)
    timing = dataclasses.replace(rig.timing, frame_period_steps=rig.timing.exposure_steps + dead)
    rig = dataclasses.replace(rig, timing=timing)
    (expected,) = exposure_scan(rig, [n_steps])
    found = ensemble(rig, n_steps, 1500, 3)
    assert (expected.path_rms, expected.end_rms) == pytest.approx(found, rel=0.08)


def test_light_and_read_out_noise_go_with_the_exposure():
    longer = with_exposure(load_rig("sh-8x8"), 200)
    assert longer.sensor.photoelectrons == 4000
    assert longer.sensor.noise_density == pytest.approx(2e-5 / 4)
    scan = exposure_scan(LIVELY, [100, 200])
    assert scan[0].noise_rms == pytest.approx(2 * scan[1].noise_rms, rel=1e-3)


def test_there_is_a_best_exposure_between_noise_and_motion():
    errors = exposure_scan(LIVELY)
    steps = [e.exposure_steps for e in errors]
    assert steps == candidates(LIVELY)
    assert LIVELY.timing.exposure_steps in steps
    assert steps[0] < best(errors).exposure_steps < steps[-1]


def test_the_command_recommends_the_best(aolink):
    done = aolink("rig", "section-vi-lively", "--exposure-scan")
    assert done.returncode == 0, done.stderr
    assert f"exposure_steps = {best(exposure_scan(LIVELY)).exposure_steps}," in done.stdout
    rows = json.loads(aolink("rig", "section-vi-lively", "--exposure-scan", "--json").stdout)
    assert [row["exposure_steps"] for row in rows] == candidates(LIVELY)


def test_what_has_no_steady_state_or_is_too_large_is_refused():
    with pytest.raises(EstimatorError, match="256 outputs at most"):
        exposure_scan(load_rig("sh-30x30"))
    with pytest.raises(EstimatorError, match="64 states of one plant at most, membrane-12x12 has 288"):
        exposure_scan(load_rig("membrane-12x12"))
    text = LIVELY.toml.replace("C = [[1.0, 0.0]]", "C = [[1.0, 0.0, 0.0]]").replace(
        "A = [[1.0000, 0.0010], [-0.0197, 0.9704]]", "A = [[0.9, 0, 0], [0, 0.9, 0], [0, 0, 1]]"
    )
    text = text.replace("B = [[0.0], [1.0]]", "B = [[0.0], [1.0], [0]]").replace(
        "B_w = [[0.0], [0.05]]", "B_w = [[1], [0.0], [0.05]]\ninitial_covariance = [[1,0,0],[0,1,0],[0,0,1]]"
    )
    with pytest.raises(EstimatorError, match="has no steady state"):
        exposure_scan(parse_rig(text), [100])
