"""`aolink record --dry-run`: everything is checked, the mirror is sent no input, and no file is left."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from google.protobuf.message import Message

from aolink.rig import load_rig
from aolink.session.dry_run import dry_run
from aolink.wire import messages_pb2 as pb
from tests.commands import simulated_rig
from tests.hostile import lying_rig

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def ports() -> Iterator[tuple[str, ...]]:
    with simulated_rig("section-vi", "--real-time") as (camera, mirror):
        yield "--camera", camera, "--mirror", mirror


@pytest.mark.slow
def test_all_that_was_found_is_said(aolink: Run, ports: tuple[str, ...], tmp_path: Path) -> None:
    arguments = ("record", *ports, "--rig", "section-vi", "--dry-run", "-o", "a.mcap")
    played = aolink(*arguments, "--exposures", "20", "-e", "o3")
    assert (played.returncode, played.stderr) == (0, "")
    said = played.stdout.splitlines()
    assert [line.split()[0] for line in said] == [
        "rig", "camera", "mirror", "time", "inputs", "estimators", "recording", "dry",
    ]  # fmt: skip
    assert "aolink simulated rig 1" in said[2]
    assert "the rig file's drive (sine), within limits -0.05 to 0.05" in said[4]
    assert said[5].split() == ["estimators", "o3"]
    assert "MB for 20 exposures" in said[6]
    closed = json.loads(aolink(*arguments, "--control", "integrator", "--json").stdout)
    assert closed["inputs"].startswith("of the controller integrator")
    assert "enough for" in closed["recording"]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_on_virtual_time_too(aolink: Run, tmp_path: Path) -> None:
    with simulated_rig("section-vi") as (camera, mirror):
        found = aolink(
            "record", "--camera", camera, "--mirror", mirror, "--rig", "section-vi", "--dry-run", "-o", "a.mcap"
        )
        again = aolink(
            "record", "--camera", camera, "--mirror", mirror, "--rig", "section-vi", "--exposures", "3", "-o", "a.mcap"
        )
    assert found.returncode == again.returncode == 0, found.stderr + again.stderr
    assert "virtual" in found.stdout


def test_the_devices_are_asked_who_they_are_and_what_time_it_is_and_nothing_else(tmp_path: Path) -> None:
    answers: set[type[Message]] = set()

    def noted(message: Message) -> Message:
        answers.add(type(message))
        return message

    rig = load_rig("section-vi")
    with lying_rig(rig, camera=noted, mirror=noted, real_time=True) as ports:
        dry_run(rig, *ports, tmp_path / "a.mcap", estimators=["o3"])
    assert answers == {pb.Identity, pb.ClockReply}
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "code", "why"),
    [
        (["--rig", "jitter"], 4, "does not match the device"),
        (["--rig", "section-vi", "--mirror", "/dev/nowhere"], 3, "there is no port /dev/nowhere"),
        (["--rig", "section-vi", "-e", "o9"], 2, "o9"),
        (["--rig", "section-vi", "--input", "sine:amplitude=9,frequency=1"], 4, "beyond the mirror's limits"),
        (["--rig", "section-vi", "--exposures", "4000000000"], 5, "record fewer, or to another disk"),
        (["--rig", "section-vi", "-o", "taken.mcap"], 5, "taken.mcap exists"),
        (["--rig", "section-vi", "-o", "nowhere/a.mcap"], 5, "nowhere"),
        (["--rig", "driven.toml"], 2, "the mirror would refuse it"),
    ],
)
def test_what_the_session_would_fail_with_is_one_line(
    aolink: Run, ports: tuple[str, ...], tmp_path: Path, arguments: list[str], code: int, why: str
) -> None:
    text = load_rig("section-vi").toml.replace("dac_bits = 16", "dac_bits = 16\nslew_max_per_s = 0.001")
    (tmp_path / "driven.toml").write_text(text)
    (tmp_path / "taken.mcap").touch()
    found = aolink("record", *ports, "-o", "a.mcap", "--dry-run", *arguments)
    assert (found.returncode, found.stderr.count("aolink: ")) == (code, 1 + found.stderr.count("aolink: warning")), (
        found.stderr
    )
    assert why in found.stderr
    assert {each.name for each in tmp_path.iterdir()} == {"driven.toml", "taken.mcap"}
