"""`aolink identify --follow`: on recordings that are being written, on finished ones, and on what it refuses."""

import json
import os
import signal
import threading
import time
import tomllib
from pathlib import Path

import pytest

from aolink import files
from aolink.rig import load_rig
from aolink.session import record
from tests.commands import TIMEOUT_S, simulated_rig

REFERENCE = Path(__file__).parents[2] / "recordings"
EXPOSURES = 64


@pytest.fixture(scope="module")
def steady(tmp_path_factory):
    """A session whose disturbance is what its rig file says."""
    path = tmp_path_factory.mktemp("follow") / "steady.mcap"
    with simulated_rig("loop") as ports:
        record(load_rig("loop"), *ports, path, exposures=EXPOSURES)
    return path


def unfinished(path):
    """The bytes of a recording up to before the end of its data."""
    data = path.read_bytes()
    return data[: data.rindex(b"\x0f\x04" + bytes(7))]


@pytest.mark.slow
def test_a_finished_recording_goes_through_once(aolink, steady, tmp_path):
    done = aolink("identify", steady, "--follow", "-o", "identified.toml")
    assert done.returncode == 0
    first, last = done.stdout.splitlines()
    assert first.startswith("frame 60: the rig file's model fits: squared errors of prediction (NIS) ")
    assert last == f"{steady} ended after {EXPOSURES} exposures; offers: none"
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_session_of_another_process_is_followed_up_to_its_end(aolink, start_aolink, tmp_path):
    path = tmp_path / "session.mcap"
    with simulated_rig("loop") as (camera, mirror):
        recording = start_aolink(
            "record", "--camera", camera, "--mirror", mirror, "--rig", "loop", "--exposures", str(EXPOSURES), "-o", path
        )
        until = time.monotonic() + TIMEOUT_S
        while not path.exists() and recording.poll() is None and time.monotonic() < until:
            time.sleep(0.02)
        done = aolink("identify", path, "--follow", "-o", "identified.toml", "--json")
        recorded = recording.communicate(timeout=TIMEOUT_S)
    assert recording.returncode == 0, recorded
    assert done.returncode == 0, done.stderr
    (line,) = map(json.loads, done.stdout.splitlines())
    assert (line["frame"], line["fits"]) == (60, True)
    assert [each.name for each in tmp_path.iterdir()] == ["session.mcap"]


@pytest.mark.slow
def test_ctrl_c_ends_it_while_the_session_goes_on(start_aolink, steady, tmp_path):
    """The file stays locked and unfinished, as that of a session does."""
    data, descriptor = unfinished(steady), files.create(tmp_path / "session.mcap").descriptor
    try:
        os.write(descriptor, data)
        following = start_aolink("identify", "session.mcap", "--follow", "-o", "identified.toml")
        alarm = threading.Timer(TIMEOUT_S, following.kill)
        alarm.start()
        said = following.stdout.readline()
        following.send_signal(signal.SIGINT)
        _, complaint = following.communicate()
        alarm.cancel()
    finally:
        os.close(descriptor)
    assert "fits" in said
    assert following.returncode == 130
    assert complaint.splitlines()[-1] == "aolink: interrupted by SIGINT"
    assert [each.name for each in tmp_path.iterdir()] == ["session.mcap"]
    assert (tmp_path / "session.mcap").read_bytes() == data


@pytest.mark.slow
def test_of_a_session_that_died_it_says_so_and_what_it_found(aolink, steady, tmp_path):
    (tmp_path / "cut.mcap").write_bytes(unfinished(steady))
    done = aolink("identify", "cut.mcap", "--follow", "-o", "identified.toml")
    assert done.returncode == 0
    assert "it was cut off" in done.stderr
    assert "cut.mcap ended after" in done.stdout


@pytest.mark.rare  # a fit of both processes takes minutes
def test_an_offer_is_written_into_a_rig_file_of_its_own_and_said(aolink, tmp_path):
    """The rig has its vibration at 14.4 Hz, and the session's rig file believes in 12 Hz."""
    believed, moved = load_rig("loop").toml, tmp_path / "moved.toml"
    moved.write_text(believed.replace("frequency_hz = 12.0", "frequency_hz = 14.4"))
    with simulated_rig(moved) as ports:
        record(load_rig("loop"), *ports, tmp_path / "session.mcap", exposures=130)
    recorded = (tmp_path / "session.mcap").read_bytes()
    done = aolink("identify", "session.mcap", "--follow", "-o", "identified.toml")
    assert done.returncode == 0, done.stderr
    offered, values = (line for line in done.stdout.splitlines() if line.startswith("frame 128: identified.toml"))
    assert "explains frames 97 to 128, to which it was not fitted, better than the rig file's model (0.5 s" in offered
    assert "the output: ornstein-uhlenbeck+resonance: " in values
    assert done.stdout.splitlines()[-1].endswith("offers: identified.toml")
    tables = tomllib.loads((tmp_path / "identified.toml").read_text())["disturbance"]["model"]
    (line,) = (each for each in tables if each["kind"] == "resonance")
    assert line["frequency_hz"] == pytest.approx(14.4, rel=0.01)
    assert load_rig(tmp_path / "identified.toml").n_outputs == 1
    assert (tmp_path / "session.mcap").read_bytes() == recorded
    assert {each.name for each in tmp_path.iterdir()} == {"session.mcap", "moved.toml", "identified.toml"}


@pytest.mark.slow
def test_too_short_a_recording_is_one_line(aolink, tmp_path):
    done = aolink("identify", REFERENCE / "jitter.mcap", "--follow", "-o", "identified.toml")
    assert done.returncode == 14
    assert "ended after 20 exposures: 60 or more" in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["none.mcap", "-o", "new.toml"], 5, "cannot read none.mcap: no such file"),
        (["steady", "-o", "there.toml"], 14, "there.toml exists and is not overwritten"),
        (["steady", "-o", "old.toml"], 14, "old-2.toml exists, and further offers would have such names"),
        (["steady", "-o", "new.mcap"], 14, "what is written is a .toml file"),
        (["steady", "-o", "new.toml", "--model", "wobble"], 14, "no kind of process"),
        (["steady", "steady", "-o", "new.toml"], 2, "--follow is for one recording"),
        (["steady", "-o", "new.toml", "--fit", "first-order"], 2, "leave out --fit"),
        (["steady", "-o", "there.toml", "--overwrite"], 2, "never overwrites"),
    ],
)
def test_what_cannot_be_followed_is_refused_before_it_begins(aolink, steady, tmp_path, arguments, code, says):
    for name in ("there.toml", "old-2.toml"):
        (tmp_path / name).write_text("mine")
    done = aolink("identify", *(steady if each == "steady" else each for each in arguments), "--follow")
    assert done.returncode == code
    assert says in " ".join(done.stderr.replace("│", " ").split())
    assert {each.name: each.read_text() for each in tmp_path.iterdir()} == {"there.toml": "mine", "old-2.toml": "mine"}
