"""The rig file's own disturbance as the likelihood takes it, against the processes and the recursion that it is of."""

import numpy as np
import pytest
from scipy import linalg

from aolink.errors import IdentificationError
from aolink.identification import Process, ProcessSum, identified_text, rig_model
from aolink.rig import load_rig, parse_rig

LAGS = np.linspace(0.0, 0.4, 37)


def covariance(model, lags):
    return sum(process.covariance(lags) for process in model.processes)


@pytest.mark.parametrize(
    "processes",
    [
        (Process("resonance", (12.0, 0.01, 0.2)),),
        (Process("ornstein-uhlenbeck", (0.3, 0.05)), Process("resonance", (31.0, 0.3, 0.1))),
        (Process("ar3", (9.0, 0.02, 0.2, 0.1)),),
        (Process("second-order", (0.2, 0.2, 0.1)),),
    ],
)
def test_what_was_identified_is_in_the_rig_file_that_it_was_written_into(processes):
    """Between the fast steps too, where the likelihood's nodes are; the file holds its noise for a fast step."""
    rig, model = load_rig("loop"), ProcessSum(processes)
    written = rig_model(parse_rig(identified_text(rig.toml, rig, [model])), 0)
    assert covariance(written, LAGS) == pytest.approx(covariance(model, LAGS), abs=1e-3 * covariance(model, LAGS)[0])


def test_a_plant_that_noise_drives_has_the_covariance_of_its_recursion():
    rig = load_rig("jitter")
    plant = rig.plant
    P = linalg.solve_discrete_lyapunov(plant.A, plant.B_w @ plant.process_noise @ plant.B_w.T)
    steps = np.array([0, 1, 7, 40, 300])
    oracle = [(plant.C @ np.linalg.matrix_power(plant.A, k) @ P @ plant.C.T)[0, 0] for k in steps]
    assert covariance(rig_model(rig, 0), steps * rig.timing.fast_step_s) == pytest.approx(oracle, rel=1e-6)


def test_a_random_walk_keeps_its_intensity():
    rig = load_rig("loop")
    model = ProcessSum((Process("random-walk", (0.03,)), Process("resonance", (12.0, 0.01, 0.2))))
    written = rig_model(parse_rig(identified_text(rig.toml, rig, [model])), 0)
    assert sum(process.walk for process in written.processes) == pytest.approx(0.03, rel=1e-5)
    assert sum(process.is_stationary for process in written.processes) == 1


def test_each_output_has_its_own_model():
    rig = load_rig("tip-tilt")
    models = [ProcessSum((Process("resonance", (hz, 0.01, 0.2)),)) for hz in (12.0, 20.0)]
    written = parse_rig(identified_text(rig.toml, rig, models))
    for output, model in enumerate(models):
        assert covariance(rig_model(written, output), LAGS) == pytest.approx(covariance(model, LAGS), abs=1e-5)


def test_a_rig_that_nothing_disturbs_is_one_line():
    rig = load_rig("loop")
    still = parse_rig(rig.toml[: rig.toml.index("[[disturbance.model]] #")].replace("= 1e-8", "= 0.0"))
    with pytest.raises(IdentificationError, match="nothing disturbs this output"):
        rig_model(still, 0)
