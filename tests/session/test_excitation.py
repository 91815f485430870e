"""Inputs that a session plays in the place of the rig file's drive."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import DeviceError, RigError
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.session.excitation import excitation
from aolink.wire import messages_pb2 as pb
from tests.commands import simulated_rig
from tests.kinds import messages_of

RIG = load_rig("section-vi")
TWO = load_rig("single-lenslet")
STEP_S = RIG.timing.fast_step_s
MOST = float(RIG.mirror.input_max[0] - RIG.drive.offset[0])
Run = Callable[..., subprocess.CompletedProcess[str]]


def played(*texts: str, n: int = 20_000) -> np.ndarray:
    """The changes of the first input."""
    return (excitation(texts, RIG)(0, n) - RIG.drive.offset)[:, 0]


def power(u: np.ndarray, low: float, high: float) -> float:
    """Share of the power between two frequencies, Hz."""
    spectrum = np.abs(np.fft.rfft(u - u.mean())) ** 2
    f = np.fft.rfftfreq(len(u), STEP_S)
    return float(spectrum[(f >= low) & (f <= high)].sum() / spectrum.sum())


def test_a_sine_has_its_amplitude_and_frequency() -> None:
    u = played(f"sine:amplitude={MOST / 2},frequency=5")
    np.testing.assert_allclose(u, MOST / 2 * np.sin(2 * np.pi * 5 * np.arange(20_000) * STEP_S), atol=1e-12)


def test_a_chirp_stays_in_its_band_and_goes_on_without_a_jump() -> None:
    u = played(f"chirp:amplitude={MOST},from=2,to=40,period=4")
    assert power(u, 1, 45) > 0.99
    assert np.abs(np.diff(u)).max() <= MOST * 2 * np.pi * 40 * STEP_S
    early, turned = u[:500], u[4000:4500]  # at 2 Hz, and just after it has reached 40 Hz
    assert np.count_nonzero(np.diff(np.sign(early))) < 10 < 30 < np.count_nonzero(np.diff(np.sign(turned)))


def test_a_prbs_has_two_values_and_a_band_and_is_the_same_with_the_same_seed() -> None:
    text = f"prbs:amplitude={MOST},to=40"
    u = played(text)
    assert set(np.round(u / MOST, 12)) == {-1.0, 1.0}
    assert power(u, 0, 80) > 0.8
    held = np.diff(np.flatnonzero(np.diff(u)))
    assert set(held % round(0.5 / 40 / STEP_S)) == {0}
    np.testing.assert_array_equal(u, played(text + ",seed=1"))
    assert (u != played(text + ",seed=2")).any()


def test_inputs_are_the_same_in_whatever_parts_they_are_asked_for() -> None:
    for text in ("chirp:amplitude=1e-3,from=2,to=40", "prbs:amplitude=1e-3,to=40", "step:amplitude=-1e-3,at=0.1"):
        parts = excitation([text], RIG)
        np.testing.assert_array_equal(
            np.concatenate([parts(0, 130), parts(130, 70)]), excitation([text], RIG)(0, 200), err_msg=text
        )


def test_each_column_has_its_own_and_several_are_added() -> None:
    low, high = TWO.mirror.input_min, TWO.mirror.input_max
    size = float((high - low).min()) / 8
    u = excitation([f"sine:amplitude={size},frequency=5,column=1", f"step:amplitude={size},at=0,column=1"], TWO)(0, 400)
    u = np.asarray(u - TWO.drive.offset)
    assert (u[:, 0] == 0).all()
    assert u[:, 1].max() == pytest.approx(2 * size, rel=1e-3)
    both = np.asarray(excitation([f"prbs:amplitude={size},to=50"], TWO)(0, 5000) - TWO.drive.offset)
    assert abs(np.corrcoef(both.T).flat[1]) < 0.2


def test_an_amplitude_beyond_the_limits_is_refused_with_the_limit() -> None:
    with pytest.raises(DeviceError, match="limits"):
        excitation([f"sine:amplitude={1.01 * MOST},frequency=0.001"], RIG)


def test_a_change_beyond_the_slew_limit_is_refused_with_the_limit() -> None:
    slow = replace(RIG, mirror=replace(RIG.mirror, slew_max_per_s=MOST))
    excitation([f"sine:amplitude={MOST / 10},frequency=1"], slow)
    for text in (f"sine:amplitude={MOST / 10},frequency=5", f"prbs:amplitude={MOST / 10},to=5"):
        with pytest.raises(DeviceError, match="slew_max_per_s"):
            excitation([text], slow)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("square:amplitude=1", "KIND"),
        ("nowhere.npy", "KIND"),
        ("sine:amplitude=0.1", "frequency=NUMBER"),
        ("sine:amplitude=0.1,frequency=9000", "500"),
        ("sine:amplitude=0.1,frequency=x", "float"),
        ("sine:amplitude=nan,frequency=1", "amplitude=NUMBER"),
        ("prbs:amplitude=0.1,from=3", "has no from"),
        ("sine:amplitude=0.1,frequency=1,column=1", "column=1"),
        ("chirp:amplitude=0.1,from=1,to=2,period=0", "period=0"),
    ],
)
def test_what_is_misspelt_is_refused(text: str, why: str) -> None:
    with pytest.raises(RigError, match=why):
        excitation([text], RIG)


def test_a_table_of_inputs_is_played_row_by_row_and_then_the_safe_input(tmp_path: Path) -> None:
    u = np.linspace(0, MOST, 450)[:, None]
    np.save(tmp_path / "u.npy", u)
    found = excitation([str(tmp_path / "u.npy")], RIG)
    np.testing.assert_array_equal(found(0, 450), u)
    np.testing.assert_array_equal(found(450, 3), np.tile(RIG.mirror.park, (3, 1)))
    assert (found.exposures, found.text) == (2, "file u.npy")


@pytest.mark.parametrize(("table", "why"), [(np.zeros((5, 2)), "shape"), (np.full((5, 1), "x"), "table")])
def test_a_file_that_is_no_table_of_inputs_is_refused(tmp_path: Path, table: np.ndarray, why: str) -> None:
    np.save(tmp_path / "u.npy", table)
    with pytest.raises(RigError, match=why):
        excitation([str(tmp_path / "u.npy")], RIG)


def test_a_table_beyond_the_limits_is_refused_before_anything_is_sent(tmp_path: Path) -> None:
    np.save(tmp_path / "u.npy", np.concatenate([np.zeros(5000), [9e9]]))
    with pytest.raises(DeviceError, match="fast step 5000"):
        excitation([str(tmp_path / "u.npy")], RIG)


@pytest.mark.slow
def test_a_session_plays_what_it_is_told_and_says_so(aolink: Run, tmp_path: Path) -> None:
    text = f"prbs:amplitude={MOST},to=40,seed=3"
    with simulated_rig("section-vi") as (camera, mirror):
        ports = ("--camera", camera, "--mirror", mirror, "--rig", "section-vi", "--input")
        first = aolink("record", *ports, text, "--exposures", "4", "-o", "a.mcap")
        again = aolink("record", *ports, "a.mcap", "-o", "b.mcap")
        refused = aolink("record", *ports, "sine:amplitude=9e9,frequency=1", "-o", "c.mcap")
    assert (first.returncode, again.returncode, refused.returncode) == (0, 0, DeviceError.exit_code), again.stderr
    assert not (tmp_path / "c.mcap").exists()
    for name, said in (("a.mcap", text), ("b.mcap", "file a.mcap")):
        recording = Recording(tmp_path / name)
        commands = messages_of(pb.CommandBlock, recording, topics.COMMAND)
        u = np.concatenate([np.array(each.u) for each in commands])
        np.testing.assert_array_equal(u, excitation([text], RIG)(0, 800)[:, 0])
        assert recording.metadata["input"] == said
        assert recording.metadata["exposures"] == "4"
