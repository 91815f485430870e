"""Rows of the registry: ours, one of a package that is really installed, one that is broken."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest

from aolink.colours import by_rank, estimator_colour
from aolink.errors import EstimatorError
from aolink.estimation import ESTIMATOR_NAMES, estimator_rows, make_estimator
from aolink.estimation.options import with_options
from aolink.jobs.demo import usual_estimators
from aolink.rig import load_rig
from aolink.simulation.model import simulate
from tests.commands import simulated_rig


def test_names_come_by_rank():
    assert ESTIMATOR_NAMES == ("open-loop", "o1", "o2", "o3", "moments", "profile")
    assert [row.rank for row in estimator_rows()] == sorted(row.rank for row in estimator_rows())


def test_hundreds_of_spots_of_one_plant_are_refused_by_all_that_compare_every_two():
    rig = load_rig("sh-30x30")
    for name in ("moments", "profile"):
        with pytest.raises(EstimatorError, match=f"{name} takes at most 128 spots .* sh-30x30 has 900: use o3"):
            make_estimator(rig, name)


def test_a_row_refuses_what_making_the_estimator_refuses():
    rig = load_rig("sh-30x30")
    refused = {row.name: reason for row in estimator_rows() if (reason := row.refusal(rig))}
    assert refused.keys() == {"moments", "profile"}
    for name, reason in refused.items():
        with pytest.raises(EstimatorError) as raised:
            make_estimator(rig, name)
        assert str(raised.value) == reason


def test_options_may_follow_the_name():
    rig = load_rig("section-vi-lively")
    named = make_estimator(rig, "o3:second_order,gate=false")
    given = make_estimator(rig, "o3", second_order=True, gate=False)
    for exposure in simulate(rig, 4):
        ours, theirs = named.step(exposure), given.step(exposure)
        assert ours.estimator == "o3:second_order,gate=false"
        assert np.array_equal(ours.end_state, theirs.end_state)
    assert with_options("o1:engine=filterpy,gate=false") == ("o1", {"engine": "filterpy", "gate": False})
    assert by_rank(["moments", "o3:second_order", "o3", "o1"]) == ["o1", "o3", "o3:second_order", "moments"]
    assert estimator_colour("o3:second_order") != estimator_colour("o3")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("o3:tuning=3", "o3:tuning=3: estimators have no option 'tuning': use gate, engine"),
        ("o3:", "no estimator 'o3:': after the colon"),
        ("o3:second_order=maybe", "second_order = 'maybe', expected true or false"),
        ("o3:engine=some", "engine = 'some' is not known"),
        ("o4:second_order", "no estimator 'o4': use one of open-loop, o1"),
        ("profile:tempered=0", "profile:tempered=0: estimators have no option 'tempered': use gate"),
    ],
)
def test_an_option_that_makes_no_sense_is_named(text, message):
    with pytest.raises(EstimatorError, match=re.escape(message)):
        make_estimator(load_rig("section-vi-lively"), text)


@pytest.mark.rare
def test_options_of_a_session_go_with_the_recording(aolink, tmp_path):
    """Beside the loop in real time; and all that reads the recording has the same estimator."""
    names = ("-e", "o3:second_order", "-e", "o3")
    with simulated_rig("loop", "--real-time") as (camera, mirror):
        recorded = aolink(
            "record", "--camera", camera, "--mirror", mirror, "--rig", "loop", *names, "--control", "lqg",
            "--exposures", "20", "-o", "a.mcap",
        )  # fmt: skip
    assert recorded.returncode == 0, recorded.stderr
    again = aolink("compare", "a.mcap", "-t", "/estimate/")
    assert again.returncode == 0, again.stdout
    for command in (("view", "-o", "a.rrd"), ("export", "-o", "a.npz"), ("report", "-o", "a.html")):
        made = aolink(command[0], "a.mcap", *command[1:])
        assert made.returncode == 0, made.stderr


def test_the_demo_runs_what_works_on_the_rig():
    rig = load_rig("moving-scene")
    assert usual_estimators(rig) == ["open-loop", "o1", "moments"]
    assert usual_estimators(rig, "lqg") == ["moments", "o1", "open-loop"]
    assert usual_estimators(load_rig("sh-30x30")) == ["open-loop", "o1"]


@pytest.mark.slow
def test_an_installed_package_adds_an_estimator(aolink, with_example, tmp_path):
    """In a session, when it is estimated again, in the list of all, and in the viewer's palette."""
    with simulated_rig("section-vi-lively") as (camera, mirror):
        recorded = aolink(
            "record", "--camera", camera, "--mirror", mirror, "--rig", "section-vi-lively", "-e", "open-loop", "-e",
            "threshold", "--exposures", "12", "-o", "a.mcap", env=with_example,
        )  # fmt: skip
    assert recorded.returncode == 0, recorded.stderr
    again = aolink("estimate", "a.mcap", "-e", "threshold", "-e", "open-loop", "--json", env=with_example)
    assert again.returncode == 0, again.stderr
    scored = json.loads(again.stdout)
    assert aolink("compare", "a.mcap", env=with_example).returncode == 0
    assert scored["threshold"]["path_rmse"] < 0.8 * scored["open-loop"]["path_rmse"]
    asked = (
        "from aolink.estimation import ESTIMATOR_NAMES;"
        "from aolink.colours import by_rank, estimator_colour;"
        "print(ESTIMATOR_NAMES[:3], estimator_colour('threshold'), by_rank(['o3', 'threshold', 'o1']))"
    )
    done = subprocess.run([sys.executable, "-c", asked], env=with_example, capture_output=True, text=True, check=True)
    assert done.stdout == "('open-loop', 'o1', 'threshold') (250, 250, 120) ['o1', 'threshold', 'o3']\n"
    # Without the package the recording is there, and its estimates have a colour and come last.
    assert by_rank(["threshold", "o3"]) == ["o3", "threshold"]
    assert estimator_colour("threshold") != (250, 250, 120)
    assert aolink("info", "a.mcap").returncode == 0
    alone = aolink("estimate", "a.mcap", "-e", "threshold")
    assert alone.returncode == 2
    assert "there is no estimator 'threshold'" in alone.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("value", "why"),
    [
        ("nowhere.at_all:ROW", "cannot be loaded: ModuleNotFoundError"),
        ("math:pi", "(math:pi) is 3.14159"),
    ],
)
def test_a_broken_package_is_one_line_for_who_asks_for_it(aolink, with_example, tmp_path, value, why):
    metadata = tmp_path / "site" / "broken-0.1.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 0.1\n")
    (metadata / "entry_points.txt").write_text(f"[aolink.estimators]\ncracked = {value}\n")
    environment = with_example | {"PYTHONPATH": f"{metadata.parent}:{with_example['PYTHONPATH']}"}
    code = (
        "from aolink.estimation import make_estimator; from aolink.rig import load_rig; rig = load_rig('section-vi');"
    )
    fine = subprocess.run(
        [sys.executable, "-c", code + "make_estimator(rig, 'o1'); make_estimator(rig, 'threshold')"],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert fine.stderr == ""
    asked = subprocess.run(
        [sys.executable, "-c", code + "make_estimator(rig, 'cracked')"], env=environment, capture_output=True, text=True
    )
    assert asked.stderr.splitlines()[-1].startswith("aolink.errors.EstimatorError: the estimator cracked of broken")
    assert why in asked.stderr.splitlines()[-1]
    listed = subprocess.run(
        [sys.executable, "-c", "import aolink.estimation; print(aolink.estimation.ESTIMATOR_NAMES)"],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert "cracked" not in listed.stdout
    assert "UserWarning: the estimator cracked of broken" in listed.stderr
