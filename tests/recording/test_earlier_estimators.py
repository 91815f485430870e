"""A recording with estimates of an estimator that only earlier versions had: read and shown, and not made again."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from aolink.colours import by_rank, estimator_colour
from aolink.errors import EstimatorError
from aolink.recording.reader import Recording

Run = Callable[..., "subprocess.CompletedProcess[str]"]
OLD = Path(__file__).parents[1] / "data" / "with-mixture.mcap"
LINE = (
    "with-mixture.mcap has estimates that are not made again: mixture is an estimator of earlier versions: use profile"
)


def test_its_estimates_are_read() -> None:
    recording = Recording(OLD)
    assert sorted(recording.estimators) == ["mixture", "o1"]
    assert [each.estimator for each in recording.estimates("mixture")] == ["mixture"] * 3


@pytest.mark.slow
def test_its_estimates_are_shown_and_exported(aolink: Run) -> None:
    assert by_rank(["mixture", "profile"]) == ["profile", "mixture"]
    assert all(0 <= each <= 255 for each in estimator_colour("mixture"))
    done = aolink("export", OLD, "-o", "a.npz")
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("command", ["estimate", "replay"])
def test_a_command_that_takes_its_estimators_leaves_that_one_out_and_says_so(aolink: Run, command: str) -> None:
    done = aolink(command, OLD, "--json")
    assert done.returncode == 0, done.stderr
    assert {"o1"} <= json.loads(done.stdout).keys() <= {"o1", "differs_from_recorded"}
    assert done.stderr.replace("\n", " ").count(LINE) == 1


@pytest.mark.slow
def test_a_comparison_with_itself_does_so_too(aolink: Run) -> None:
    compared = aolink("compare", OLD, "--json")
    assert LINE in compared.stderr.replace("\n", " ")
    assert json.loads(compared.stdout)


def test_it_is_refused_by_name(aolink: Run) -> None:
    done = aolink("estimate", OLD, "-e", "mixture")
    assert done.returncode == EstimatorError.exit_code
    assert done.stderr.strip() == "aolink: mixture is an estimator of earlier versions: use profile"
