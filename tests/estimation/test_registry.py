"""Rows of the registry: ours, one of a package that is really installed, one that is broken."""

import json
import subprocess
import sys

import pytest

from aolink.errors import EstimatorError
from aolink.estimation import ESTIMATOR_NAMES, estimator_rows, make_estimator
from aolink.jobs.demo import possible_estimators, simulated_rig
from aolink.rig import load_rig


def test_names_come_by_rank():
    assert ESTIMATOR_NAMES == ("open-loop", "o1", "o2", "o3", "moments", "profile", "mixture", "sampled")
    assert [row.rank for row in estimator_rows()] == sorted(row.rank for row in estimator_rows())


def test_a_row_refuses_what_making_the_estimator_refuses():
    rig = load_rig("sh-8x8")
    refused = {row.name: reason for row in estimator_rows() if (reason := row.refusal(rig))}
    assert refused.keys() == {"mixture", "sampled"}
    for name, reason in refused.items():
        with pytest.raises(EstimatorError) as raised:
            make_estimator(rig, name)
        assert str(raised.value) == reason


def test_the_demo_runs_what_is_fast_on_the_rig():
    assert possible_estimators(load_rig("section-vi")) == tuple(n for n in ESTIMATOR_NAMES if n != "sampled")
    assert possible_estimators(load_rig("tip-tilt")) == ("open-loop", "o1", "o2", "o3", "moments")


@pytest.mark.long
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
    assert scored["differs_from_recorded"] == {"open-loop": None, "threshold": None}
    assert scored["threshold"]["path_rmse"] < 0.8 * scored["open-loop"]["path_rmse"]
    asked = (
        "from aolink.estimation import ESTIMATOR_NAMES;"
        "from aolink.colours import by_rank, estimator_colour;"
        "print(ESTIMATOR_NAMES[:3], estimator_colour('threshold'), by_rank(['o3', 'threshold', 'o1']))"
    )
    told = subprocess.run([sys.executable, "-c", asked], env=with_example, capture_output=True, text=True, check=True)
    assert told.stdout == "('open-loop', 'o1', 'threshold') (250, 250, 120) ['o1', 'threshold', 'o3']\n"
    # Without the package the recording is there, and its estimates have a colour and come last.
    from aolink.colours import by_rank, estimator_colour

    assert by_rank(["threshold", "o3"]) == ["o3", "threshold"]
    assert estimator_colour("threshold") != (250, 250, 120)
    assert aolink("info", "a.mcap").returncode == 0
    alone = aolink("estimate", "a.mcap", "-e", "threshold")
    assert alone.returncode == EstimatorError.exit_code
    assert "there is no estimator 'threshold'" in alone.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    ("value", "why"),
    [
        ("nowhere.at_all:ROW", "cannot be loaded: ModuleNotFoundError"),
        ("math:pi", "(math:pi) is not an EstimatorRow of this name"),
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
