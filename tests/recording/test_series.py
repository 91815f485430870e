"""A series: one pass over a recording, parts of it, estimates in memory beside it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.records import ChunkIndex

import aolink
from aolink import AolinkError
from aolink.errors import EstimatorError, RecordingError
from aolink.exporting.files import export
from aolink.plotting.report import write_report
from aolink.recording import scan
from aolink.recording.reader import Recording
from aolink.recording.reestimate import scored_anew, write_reestimated
from aolink.rig import load_rig
from aolink.series import NOTHING, Also, Series, Step
from aolink.viewing import save_rrd
from tests.needs import needed

LIVELY = Path(__file__).parents[2] / "recordings" / "section-vi-lively.mcap"


def test_a_walk_gives_each_exposure_with_all_its_estimates() -> None:
    recording = aolink.read(LIVELY)
    each = {name: {found.frame_id: found for found in recording.estimates(name)} for name in recording.estimators}
    walked = list(recording.walk())
    assert [exposure.frame_id for exposure, _ in walked] == [exposure.frame_id for exposure in recording]
    for exposure, found in walked:
        assert list(found) == recording.estimators
        assert exposure.truth is not None
        for name, estimate in found.items():
            assert estimate.path.tobytes() == each[name][exposure.frame_id].path.tobytes()


@pytest.mark.parametrize("index", [slice(3, 18, 4), [0, 7, 8, 19], np.arange(20) % 3 == 1, slice(0, 0), [-2, -1]])
def test_a_part_is_as_in_the_whole(index: Any) -> None:
    recording = aolink.read(LIVELY)
    wanted = np.arange(20)[index].tolist()
    part = recording[index]
    whole = list(recording.walk(["moments"]))
    assert len(part) == len(wanted)
    for k, (exposure, found) in zip(wanted, part.walk(["moments"]), strict=True):
        assert exposure.pixels.tobytes() == whole[k][0].pixels.tobytes()
        assert exposure.inputs.tobytes() == whole[k][0].inputs.tobytes()
        assert found["moments"].path.tobytes() == whole[k][1]["moments"].path.tobytes()
    if wanted:
        assert part[-1].frame_id == whole[wanted[-1]][0].frame_id
        assert [each.frame_id for each in part[1:]] == [whole[k][0].frame_id for k in wanted[1:]]


@pytest.mark.parametrize(
    ("index", "error"), [([3, 1], ValueError), ([2, 2], ValueError), ([20], IndexError), (np.ones(3, bool), IndexError)]
)
def test_a_series_is_read_forwards_and_by_its_own_numbers(index: Any, error: type[Exception]) -> None:
    with pytest.raises(error):
        aolink.read(LIVELY)[index]


def test_new_estimates_are_drawn_and_tabled_without_a_file() -> None:
    needed("pandas")
    needed("xarray")
    series = aolink.estimate(aolink.simulate("section-vi-lively", 6, seed=1), ["o1", "moments"])
    assert series.estimators == ["o1", "moments"]
    table = series[1:5].to_pandas()
    assert len(table) == 4
    assert {"o1_nis", "moments_nis", "moments_path_error_rms"} <= set(table)
    assert series.to_xarray()["path"].dims == ("estimator", "time", "output", "step")
    above, _ = series.plot(["moments"])
    assert above.lines or above.collections
    smoothed = aolink.smooth(series, 2, estimators="o1")
    assert smoothed.estimators == series.estimators
    assert smoothed.estimates("moments")[3].path.tobytes() == series.estimates("moments")[3].path.tobytes()
    assert smoothed.estimates("o1")[3].path.tobytes() != series.estimates("o1")[3].path.tobytes()
    with pytest.raises(RecordingError, match="name one"):
        series.estimates()


def test_a_long_table_has_the_paths() -> None:
    pandas = needed("pandas")
    series = aolink.estimate(aolink.simulate("tip-tilt", 2, seed=1), "o1")
    table = series.to_pandas(paths=True)
    steps = series.rig.timing.exposure_steps
    assert len(table) == 2 * 2 * 2 * steps  # exposures, names, axes
    of_one = table[(table["name"] == "o1") & (table["axis"] == 1) & (table["frame_id"] == series[1].frame_id)]
    estimate = series.estimates()[1]
    np.testing.assert_array_equal(of_one["value"], estimate.path[1])
    np.testing.assert_array_equal(of_one["sd"], estimate.path_sd[1])
    assert set(np.diff(of_one.index)) == {pandas.Timedelta(series.rig.timing.fast_step_s, "s")}


def test_estimates_stand_beside_those_of_the_file() -> None:
    recording = aolink.read(LIVELY)
    series = aolink.estimate(recording[5:15], "o1:second_order")
    assert series.estimators == [*recording.estimators, "o1:second_order"]
    exposure, found = next(series[3:].walk(["moments", "o1:second_order"]))
    assert exposure.frame_id == recording[8].frame_id
    assert found["moments"].frame_id == found["o1:second_order"].frame_id == exposure.frame_id


def test_a_recording_is_read_with_another_rig_file() -> None:
    recording = aolink.read(LIVELY, rig="section-vi")
    assert recording.rig.name == "section-vi"
    assert not recording.rig_is_recorded


def test_what_the_package_offers_is_what_dir_shows() -> None:
    for name in dir(aolink):
        assert getattr(aolink, name) is not None
    assert "exposure" not in dir(aolink)


def test_smooth_takes_a_series_with_its_estimates() -> None:
    exposures = aolink.simulate("section-vi", 2)
    with pytest.raises(EstimatorError, match=r"aolink\.smooth\(series"):
        aolink.smooth(exposures, aolink.estimate(exposures, "o1").estimates())  # type: ignore[arg-type]
    assert issubclass(EstimatorError, AolinkError)


def chunks_read(work: Callable[[], object], monkeypatch: pytest.MonkeyPatch) -> Counter[int]:
    """How often each chunk is read, by its place in the file."""
    read = Counter[int]()
    real: Callable[..., object] = scan.chunk_at

    def counting(file: object, index: ChunkIndex, *rest: object) -> object:
        read[index.chunk_start_offset] += 1
        return real(file, index, *rest)

    with monkeypatch.context() as patch:
        patch.setattr("aolink.recording.messages.chunk_at", counting)
        work()
    return read


@pytest.mark.parametrize(
    ("what", "most"),
    [("loop", 1), ("walk", 1), ("estimate", 1), ("copy", 1), ("table", 1), ("csv", 1), ("report", 3), ("view", 1)],
)
def test_a_recording_is_read_once(what: str, most: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A report also reads the few most telling exposures, which it knows after the first pass."""
    recording = Recording(LIVELY)
    names = ["o1", "moments"]
    work: dict[str, Callable[[], object]] = {
        "loop": lambda: list(recording),
        "walk": lambda: list(recording.walk()),
        "estimate": lambda: scored_anew(recording, names),
        "copy": lambda: write_reestimated(recording, names, tmp_path / "a.mcap"),
        "table": lambda: recording.to_pandas(),
        "csv": lambda: export(recording, tmp_path / "a.csv"),
        "report": lambda: write_report(recording, tmp_path / "a.html"),
        "view": lambda: save_rrd(recording, tmp_path / "a.rrd"),
    }
    read = chunks_read(work[what], monkeypatch)
    assert len(read) >= len(recording.chunk_index or ())
    assert sum(read.values()) <= most * len(read)


def test_a_mask_costs_no_more_for_each_exposure_of_a_long_series() -> None:
    """As many comparisons of numbers as there are exposures, and not their square."""
    compared = 0

    class Number(int):
        __hash__ = int.__hash__

        def __eq__(self, other: object) -> bool:
            nonlocal compared
            compared += 1
            return int(self) == other

    class Source:
        def __init__(self) -> None:
            self.exposures = list(aolink.simulate("section-vi", n_exposures=1, seed=1)) * 1000
            self.rig, self.path, self.metadata = load_rig("section-vi"), LIVELY, dict[str, str]()
            self.estimators, self.has_truth, self.damage = list[str](), False, ""

        def __len__(self) -> int:
            return len(self.exposures)

        def steps(
            self, names: Sequence[str] = (), start: int = 0, stop: int | None = None, *, also: Also = NOTHING
        ) -> Iterator[Step]:
            return (Step(Number(k), each) for k, each in enumerate(self.exposures[start:stop], start))

    assert len(list(Series(Source())[np.arange(1000) % 3 > 0])) == 666
    assert compared < 3000
