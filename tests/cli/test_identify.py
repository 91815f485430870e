"""`aolink identify`: what it writes, and what it says of recordings that it cannot use."""

import json
from pathlib import Path

import pytest

from aolink.rig import load_rig
from aolink.rig.disturbance import Disturbance, DisturbanceModel
from aolink.session import record
from tests.commands import simulated_rig
from tests.kinds import must_be

REFERENCE = Path(__file__).parents[2] / "recordings"


@pytest.fixture(scope="module")
def shaken(tmp_path_factory):
    path = tmp_path_factory.mktemp("identify") / "shaken.mcap"
    with simulated_rig("jitter") as ports:
        record(load_rig("jitter"), *ports, path, exposures=24)
    return path


@pytest.mark.slow
def test_a_model_goes_into_a_rig_file(aolink, shaken, tmp_path):
    out = tmp_path / "identified.toml"
    done = aolink("identify", shaken, "-o", out, "--model", "ornstein-uhlenbeck", "--json")
    printed = json.loads(done.stdout)["outputs"][0]
    assert printed["exposures"] == 24
    assert set(printed["parameters"]) == {"correlation_s", "intensity"}
    model = must_be(DisturbanceModel, must_be(Disturbance, load_rig(out).disturbance).model)
    assert model.A.shape == (1, 1)
    variance = printed["parameters"]["intensity"]["value"] * printed["parameters"]["correlation_s"]["value"] / 2
    assert model.initial_covariance[0, 0] == pytest.approx(variance, rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--fit", "second-order"], "no input to identify a plant from"),
        (["--model", "wobble"], "kind of process"),
        (["--model", "resonance", "--model", "random-walk"], "or one --model"),
        (["--model", "resonance", "--highest", "900"], "above half of the fast rate"),
    ],
)
def test_what_cannot_be_identified_is_one_line(aolink, shaken, tmp_path, arguments, says):
    done = aolink("identify", shaken, "-o", tmp_path / "rig.toml", *arguments)
    assert done.returncode == 14
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "rig.toml").exists()


def test_too_short_a_recording_is_one_line(aolink, tmp_path):
    done = aolink("identify", REFERENCE / "jitter.mcap", "-o", tmp_path / "rig.toml")
    assert done.returncode == 14
    assert "too short" in done.stderr
