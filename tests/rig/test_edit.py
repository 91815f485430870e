"""New values in a rig file leave everything else as its owner wrote it."""

from __future__ import annotations

import tomllib

import pytest
import tomlkit

from aolink.errors import RigError
from aolink.rig.edit import with_table, with_value

TEXT = """\
name = "mine"  # of the bench

[sensor]   # a line camera
  counts_per_density   =  2_000 # from the data sheet
field = [ -1,
          1 ]   # mrad

# What the lens does.
[sensor.kernel]
sigma = 0.05
"""


def test_a_value_changes_and_nothing_else() -> None:
    assert with_value(TEXT, "sensor.counts_per_density", 2100) == TEXT.replace("2_000", "2100")
    assert with_value(TEXT, "sensor.kernel.sigma", 0.06) == TEXT.replace("0.05", "0.06")
    assert with_value(TEXT, "sensor.field", [-2, 2]) == TEXT.replace("[ -1,\n          1 ]", "[-2, 2]")


def test_a_comment_takes_the_place_of_the_old_one() -> None:
    text = "[plant]\nA = 1 # a walk\nB = 2 # stays\nC = 3\n"
    assert with_value(text, "plant.A", 4, comment="new") == text.replace("A = 1 # a walk", "A = 4 # new")
    assert with_value(text, "plant.C", 4, comment="new") == text.replace("C = 3", "C = 4 # new")


def test_a_number_keeps_the_digits_that_it_is_given_with() -> None:
    assert "sigma = 0.0600\n" in with_value(TEXT, "sensor.kernel.sigma", tomlkit.value("0.0600"))


def test_a_new_key_stands_behind_the_last_of_its_table() -> None:
    new = with_value(TEXT, "sensor.black_level", 100, may_be_new=True)
    assert new == TEXT.replace("# mrad\n", "# mrad\nblack_level = 100\n")
    end = with_value(TEXT.rstrip(), "sensor.kernel.shape", "gaussian", may_be_new=True)
    assert end == TEXT + 'shape = "gaussian"\n'


@pytest.mark.parametrize(
    "text",
    [
        "sensor = { a = 1, kernel.sigma = 2 }  # one line\nname = 'x'\n",
        "sensor.a = 1 # dotted\nsensor.kernel.sigma = 2\nname = 'x'\n",
        "name = 'x'\n[sensor]\na = 1\n[mirror]\nb = 2 # between\n[sensor.kernel]\nsigma = 2\n",
        "name = 'x'\n[sensor.kernel]\nsigma = 2\n",
    ],
)
def test_a_value_is_changed_in_every_way_to_write_a_table(text: str) -> None:
    expected = tomllib.loads(text)
    expected["sensor"] |= {"new": 3}
    expected["sensor"]["kernel"]["sigma"] = 4
    new = with_value(with_value(text, "sensor.new", 3, may_be_new=True), "sensor.kernel.sigma", 4)
    assert tomllib.loads(new) == expected
    assert [line[line.index("#") :] for line in new.splitlines() if "#" in line] == [
        line[line.index("#") :] for line in text.splitlines() if "#" in line
    ]


def test_a_table_is_added_at_the_end_and_then_changed_in_its_place() -> None:
    first = with_table(TEXT, "calibration", {"dark_frames": 3}, "by a test")
    assert first == TEXT + "\n[calibration] # by a test\ndark_frames = 3\n"
    second = with_table(first + "# the end\n", "calibration", {"dark_frames": 4, "sources": ["a"]}, "not used")
    assert tomllib.loads(second)["calibration"] == {"dark_frames": 4, "sources": ["a"]}
    assert "# the end\n" in second


def test_line_ends_stay_as_they_are() -> None:
    crlf = TEXT.replace("\n", "\r\n")
    new = with_table(with_value(crlf, "sensor.black_level", 1, may_be_new=True), "calibration", {"a": 1}, "x")
    assert new.count("\n") == new.count("\r\n") > crlf.count("\r\n")


@pytest.mark.parametrize(
    ("text", "key", "says"),
    [
        (TEXT, "sensor.colour", r"sensor.colour: the rig file has no such key: known there: counts_per_density, field"),
        (TEXT, "sensor.feild", "did you mean field"),
        (TEXT, "name.x", "known there: none"),
        ("name = \n", "name", "not valid TOML"),
    ],
)
def test_a_value_that_cannot_be_changed_is_refused(text: str, key: str, says: str) -> None:
    with pytest.raises(RigError, match=says):
        with_value(text, key, 1)
