"""Many recordings into side files: parts for job arrays, two tables, nothing twice."""

from __future__ import annotations

import csv
import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aolink.errors import AolinkError, EstimatorError, RigError
from aolink.files import writing
from aolink.jobs import batch
from aolink.recording.reader import Recording
from tests.recording.small import write_small

Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.mark.slow
@given(st.lists(st.text(min_size=1), unique=True, max_size=40), st.integers(1, 12), st.randoms())
def test_the_parts_are_disjoint_and_all_of_them_are_all(names: list[str], count: int, random: object) -> None:
    shuffled = sorted(names, key=lambda _: random.random())  # type: ignore[attr-defined]
    parts = [batch.shard(names, f"{k + 1}/{count}") for k in range(count)]
    assert parts == [batch.shard(shuffled * 2, f"{k + 1}/{count}") for k in range(count)]
    assert sorted(name for part in parts for name in part) == sorted(names)
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("part", ["0/3", "4/3", "1", "1/0", "a/b", "-1/3", "1/3/5", ""])
def test_a_part_that_makes_no_sense(part: str) -> None:
    with pytest.raises(AolinkError, match="I/N is needed, with I from 1 to N"):
        batch.shard(["a"], part)


def test_thousands_of_names_are_no_matter_and_two_that_are_one_are_refused() -> None:
    sources = [f"{k}.mcap" for k in range(10_000)]
    assert len(batch.jobs(sources, batch.models(None, []), ["o3"], Path("out"))) == 10_000
    with pytest.raises(RigError, match=r"two recordings would be written as s\.o3\.mcap"):
        batch.jobs(["a/s.mcap", "b/s.mcap"], batch.models(None, []), ["o3"], Path("out"))


@pytest.mark.slow
def test_the_command_in_parts_and_then_as_a_whole(aolink: Run, tmp_path: Path) -> None:
    """A part has its own table; the run over all finds everything done, and gives the tables of all."""
    names = [write_small(tmp_path / f"s{k}.mcap", 3 + k).name for k in range(5)]
    (tmp_path / "bad.mcap").write_bytes(b"nonsense, and a good deal of it")
    every = ("estimate", *names, "bad.mcap", "-e", "o3", "-e", "o1", "-o", "out/")
    for part in ("1/2", "2/2"):
        result = aolink(*every, "--shard", part, "--jobs", "2")
        assert result.returncode == (1 if part == "1/2" else 0), result.stderr
    tables = [csv.DictReader((tmp_path / "out" / f"results-{k}-of-2.csv").read_text().splitlines()) for k in (1, 2)]
    rows = [row for table in tables for row in table]
    assert sorted({row["recording"] for row in rows}) == ["bad.mcap", *names]
    assert [row["error"] for row in rows if row["recording"] == "bad.mcap"] == [
        "bad.mcap is not a recording: it is not an MCAP file"
    ] * 2
    again = aolink(*every, "--json")
    (tmp_path / "out" / "results.csv").unlink()
    assert [row["exposures"] for row in json.loads(again.stdout) if row["estimator"] == "o1"] == [3, 4, 5, 6, 7]
    assert "12 of 12 done, 10 of them before, 2 failed; table: out/results.csv" in aolink(*every).stdout
    made = {each.name for each in (tmp_path / "out").glob("*.mcap")}
    assert made == {f"s{k}.{name}.mcap" for k in range(5) for name in ("o1", "o3")}
    assert Recording(tmp_path / "s4.mcap", side=[tmp_path / "out" / "s4.o1.mcap"]).estimators == ["o1"]


@pytest.mark.slow
def test_parts_with_a_table_of_a_name_have_one_each(aolink: Run, tmp_path: Path) -> None:
    names = [write_small(tmp_path / f"s{k}.mcap", 2).name for k in range(2)]
    for part in ("1/2", "2/2"):
        done = aolink("estimate", *names, "-e", "o1", "-o", "out/", "--shard", part, "--table", "all.parquet")
        assert done.returncode == 0, done.stderr
    tables = [pq.read_table(tmp_path / f"all-{k}-of-2.parquet").to_pylist() for k in (1, 2)]
    assert sorted(row["recording"] for table in tables for row in table) == names
    assert not (tmp_path / "all.parquet").exists()


@pytest.mark.slow
def test_the_folder_of_the_table_is_made(aolink: Run, tmp_path: Path) -> None:
    """As that of the side files is, which may be the same; where it cannot be made, nothing is done."""
    write_small(tmp_path / "s.mcap", 2)
    every = ("estimate", "s.mcap", "-e", "o1", "-o", "out/", "--table")
    for table in ("out/all.parquet", "other/deep/all.parquet"):
        done = aolink(*every, table)
        assert done.returncode == 0, done.stderr
        assert [row["recording"] for row in pq.read_table(tmp_path / table).to_pylist()] == ["s.mcap"]
        assert (tmp_path / table).with_name("all.exposures.parquet").exists()
    done = aolink("estimate", "s.mcap", "-e", "o1", "-o", "none/", "--table", "s.mcap/all.parquet")
    assert done.stderr.splitlines() == ["aolink: cannot make the folder s.mcap: file exists"]
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_both_tables_in_parquet(aolink: Run, tmp_path: Path) -> None:
    """A failed recording is in the first; models by their names."""
    names = [write_small(tmp_path / f"s{k}.mcap", 3 + k).name for k in range(2)]
    (tmp_path / "bad.mcap").write_bytes(b"nonsense, and a good deal of it")
    result = aolink(
        "estimate", *names, "bad.mcap", "-e", "o3", "--set", "plant.process_noise=5,10", "-o", "out/",
        "--table", "all.parquet",
    )  # fmt: skip
    assert result.returncode == 1
    recordings = pq.read_table(tmp_path / "all.parquet").to_pylist()
    assert [(row["recording"], row["exposures"]) for row in recordings] == [
        *[("bad.mcap", None)] * 2, *[("s0.mcap", 3)] * 2, *[("s1.mcap", 4)] * 2,
    ]  # fmt: skip
    exposures = pq.read_table(tmp_path / "all.exposures.parquet").to_pylist()
    counts = {(row["recording"], row["model"]): row["exposures"] for row in recordings if row["exposures"]}
    for (recording, model), count in counts.items():
        assert [r["frame_id"] for r in exposures if (r["recording"], r["model"]) == (recording, model)] == [
            *range(1, count + 1)
        ]
    assert len(exposures) == sum(counts.values())


def test_a_part_that_is_started_twice_is_one_clear_line(aolink: Run, tmp_path: Path) -> None:
    """The table is held while its part is worked on."""
    write_small(tmp_path / "a.mcap", 3)
    (tmp_path / "out").mkdir()
    arguments = ("estimate", "a.mcap", "-o", "out/", "--shard", "1/3")
    with writing(tmp_path / "out" / "results-1-of-3.csv"):
        second = aolink(*arguments)
        assert second.returncode == 1
        assert second.stderr.startswith("aolink: out/results-1-of-3.csv is being written by another command: wait")
        assert len(second.stderr.splitlines()) == 1
        assert not [*(tmp_path / "out").glob("*.mcap")]
        assert aolink(*arguments[:-1], "2/3").returncode == 0, "another part is its own matter"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("t.parquet", ["--table", "t.parquet"]),
        ("t.exposures.parquet", ["--table", "t.parquet"]),
        ("out/a.o1.parquet", ["--table", "t.parquet"]),
        ("out/results.csv", []),
    ],
)
def test_a_table_takes_the_place_of_a_table_only(aolink: Run, tmp_path: Path, name: str, arguments: list[str]) -> None:
    write_small(tmp_path / "a.mcap", 1)
    (tmp_path / "out").mkdir()
    (tmp_path / name).write_text("name,mass\nmine,3\n")
    command = ("estimate", "a.mcap", "-e", "o1", *arguments, "-o", "out/")
    refused = aolink(*command)
    assert refused.stderr.startswith(
        f"aolink: {name} exists and is no table of a batch: give another folder or another --table"
    )
    assert refused.stderr.count("\n") == 1
    assert (tmp_path / name).read_text() == "name,mass\nmine,3\n"
    assert not [*(tmp_path / "out").glob("*.mcap")]
    for more in (["--overwrite"], []):  # and then the table is one of ours
        done = aolink(*command, *more)
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--shard", "1/2"], "need -o DIR"),
        (["-o", "out/", "--table", "t.csv"], "give a name that ends with .parquet"),
        (["-o", "out/", "--shard", "3/2"], "I/N is needed"),
        (["-o", "out/", "--scheduler", "tcp://127.0.0.1:1", "--jobs", "2"], "--jobs is for this machine"),
        (["-o", "out/", "-e", "o1", "-e", "o9"], "there is no estimator 'o9'"),
    ],
)
def test_options_that_do_not_go_together(aolink: Run, tmp_path: Path, arguments: list[str], message: str) -> None:
    write_small(tmp_path / "a.mcap", 1)
    result = aolink("estimate", "a.mcap", *arguments)
    assert result.returncode in (1, 2, EstimatorError.exit_code)
    assert message in " ".join(result.stderr.replace("│", " ").split())
    assert not (tmp_path / "out").exists()
