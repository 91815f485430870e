"""What was identified is written so that the rig file has the same system."""

import numpy as np
import pytest

from aolink.identification import IdentifiedPlant, Process, ProcessSum, identified_text
from aolink.rig import load_rig, parse_rig
from aolink.rig.disturbance import Disturbance, DisturbanceModel
from tests.kinds import must_be

PROCESSES = [
    Process("random-walk", (0.3,)),
    Process("ornstein-uhlenbeck", (0.03, 2.0)),
    Process("second-order", (0.05, 0.008, 0.3)),
    Process("resonance", (12.0, 0.005, 0.2)),
]


def model_of(rig):
    """What a rig file says of its disturbance."""
    return must_be(DisturbanceModel, must_be(Disturbance, rig.disturbance).model)


def lagged(rig, output, lags):
    """Covariances of the disturbance that a rig file has in its model, or of its steps for a walk."""
    model = model_of(rig)
    Q = model.B_w @ model.process_noise @ model.B_w.T
    C = model.C[output]
    if np.abs(np.linalg.eigvals(model.A)).max() > 1 - 1e-9:
        return [float(C @ Q @ C)]
    return [float(C @ np.linalg.matrix_power(model.A, k) @ model.initial_covariance @ C) for k in lags]


@pytest.mark.parametrize("process", PROCESSES, ids=lambda each: each.kind)
def test_the_file_has_the_same_process(process):
    rig = load_rig("section-vi")
    text = identified_text(rig.toml, rig, [ProcessSum((process,))])
    made = parse_rig(text)
    lags = [0, 5, 60]
    expected = (
        process.covariance(np.array(lags) * 1e-3).tolist() if process.is_stationary else [process["intensity"] * 1e-3]
    )
    assert lagged(made, 0, lags) == pytest.approx(expected, rel=0.01, abs=1e-3 * expected[0])
    states = made.plant.n_states - made.plant.disturbance_states
    assert not made.plant.process_noise[:states, :states][0].any()
    assert text.startswith(rig.toml[:200])


def test_each_output_has_its_own():
    rig = load_rig("tip-tilt")
    models = [
        ProcessSum((Process("resonance", (43.0, 0.01, 0.02)),)),
        ProcessSum((Process("second-order", (0.1, 0.02, 0.1)), Process("random-walk", (0.1,)))),
    ]
    made = parse_rig(identified_text(rig.toml, rig, models))
    C = model_of(made).C
    assert C.shape == (2, 5)
    assert (C != 0).sum(axis=0).max() == 1
    assert lagged(parse_rig(identified_text(rig.toml, rig, [models[0], models[0]])), 1, [0]) == pytest.approx([4e-4])


def test_a_model_from_before_is_replaced():
    rig = load_rig("section-vi")
    once = identified_text(rig.toml, rig, [ProcessSum((PROCESSES[3],))])
    twice = identified_text(once, parse_rig(once), [ProcessSum((PROCESSES[1],))])
    assert "resonance" not in twice
    assert twice.count("[[disturbance.model]]") == 1


def test_a_plant_is_written_with_its_noise():
    rig = load_rig("section-vi")
    plant = IdentifiedPlant("second-order", (50.0, 0.7, 3.0, 0.14))
    made = parse_rig(identified_text(rig.toml, rig, [ProcessSum(())], plant=plant)).plant
    rest = made.C @ np.linalg.solve(np.eye(2) - made.A, made.B)
    assert rest[0, 0] == pytest.approx(50.0, rel=1e-6)
    assert (made.C @ made.initial_covariance @ made.C.T)[0, 0] == pytest.approx(0.14**2, rel=1e-3)
