"""What a Rerun file holds of a recording: each entity beside what was recorded."""

from __future__ import annotations

import gc
import resource
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from scipy import stats

from aolink.colours import estimator_colour
from aolink.errors import ViewerError
from aolink.estimation.estimate import Estimate
from aolink.gathered import nis_bounds
from aolink.optics.kernel import exposure_density
from aolink.plain import plain_data
from aolink.recording import topics
from aolink.recording.editing import cut, merge
from aolink.recording.messages import RecordedMessage
from aolink.recording.reader import Recording
from aolink.rig import load_rig
from aolink.series import Step
from aolink.session import record
from aolink.viewing import save
from aolink.viewing.camera import HISTORY
from aolink.viewing.incidents import log_status, log_warnings
from aolink.viewing.motion import log_estimates
from aolink.viewing.palette import MISSING, NOTHING, TRUTH
from aolink.viewing.save import save_rrd
from aolink.viewing.series import POINTS, Drawing
from aolink.viewing.timebase import Timebase
from tests.commands import simulated_rig
from tests.kinds import truth_of
from tests.recording.small import write_small
from tests.viewing.rrd import Entities, read_blueprint, read_rrd, scalars

N = 200
NAMES = ["open-loop", "o1", "o3"]
SHOWN = np.linspace(0, N - 1, POINTS).astype(int)
"""The fast steps of an exposure at which a path is drawn."""


@plain_data
class Drawn(Estimate):
    """An estimate whose path is given."""

    drawn: np.ndarray
    drawn_sd: np.ndarray

    @property
    def path(self) -> np.ndarray:
        return self.drawn

    @property
    def path_sd(self) -> np.ndarray:
        return self.drawn_sd


def session(path: Path, *options: str) -> Recording:
    """A session that has lost frames 1, 2, 8 and 9."""
    with simulated_rig("section-vi-lively", "--fault", "missing=0.2", *options) as ports:
        record(load_rig("section-vi-lively"), *ports, path, estimators=NAMES, exposures=12)
    return Recording(path)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return session(tmp_path_factory.mktemp("recorded") / "session.mcap")


@pytest.fixture(scope="module")
def saved(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_rrd(recording, tmp_path_factory.mktemp("rrd") / "session.rrd")


@pytest.fixture(scope="module")
def entities(saved: Path) -> Entities:
    return read_rrd(saved)


@pytest.fixture
def drawing(recording: Recording, tmp_path: Path) -> Drawing:
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "drawn.rrd")
    return Drawing(stream=stream, rig=recording.rig)


def drawn(drawing: Drawing, tmp_path: Path) -> Entities:
    drawing.stream.disconnect()
    return read_rrd(tmp_path / "drawn.rrd")


def without_breaks(values: np.ndarray) -> np.ndarray:
    return np.asarray(values[~np.isnan(values).any(axis=1)])


def absent_from_views(path: Path) -> list[str]:
    """Entities that a view names and the file does not hold, or of which nothing is below one that it names."""
    queries = {
        expression.removeprefix("+ ").removeprefix("- ")
        for view in read_blueprint(path).values()
        for row in view.get("ViewContents:query", [])
        for expression in row
        if "$" not in expression
    }
    assert len(queries) > 2
    known = [f"{entity}/" for entity in read_rrd(path)]
    return sorted(
        name for name in queries
        if not any(each == f"{name}/" or (name.endswith("/**") and each.startswith(name[:-2])) for each in known)
    )  # fmt: skip


def words(entity: dict[str, list[Any]], column: str) -> list[str]:
    return [text for (text,) in entity[column]]


def messages(recording: Recording, topic: str, device: str = "") -> list[Any]:
    every: list[Any] = [each.message for each in recording.messages(topic)]
    return [each for each in every if not device or each.device == device]


def test_every_view_shows_entities_that_exist_and_rerun_finds_no_fault(saved: Path) -> None:
    assert absent_from_views(saved) == []
    done = subprocess.run([sys.executable, "-m", "rerun_cli", "rrd", "verify", str(saved)], capture_output=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", NAMES)
def test_path_band_and_errors_are_the_estimates(recording: Recording, entities: Entities, name: str) -> None:
    pairs = list(zip(recording.estimates(name), recording.exposures(), strict=True))
    mean = np.concatenate([e.path[0, SHOWN] for e, _ in pairs])
    sd = np.concatenate([e.path_sd[0, SHOWN] for e, _ in pairs])
    np.testing.assert_array_equal(without_breaks(scalars(entities[f"/path/{name}/mean"]))[:, 0], mean)
    band = without_breaks(scalars(entities[f"/path/{name}/band"]))
    np.testing.assert_allclose(band, np.stack([mean + 2 * sd, mean - 2 * sd], axis=1), rtol=1e-14)
    errors = np.array([e.path[0] - truth_of(exposure).path[0] for e, exposure in pairs])
    shown = without_breaks(scalars(entities[f"/error/path/{name}"]))[:, 0]
    np.testing.assert_allclose(shown, errors[:, SHOWN].ravel(), atol=1e-15)
    rms = scalars(entities[f"/error/path_rms/{name}"])[:, 0]
    np.testing.assert_allclose(rms, np.linalg.norm(errors, axis=1) / np.sqrt(N))
    for i in range(2):
        end = [estimate.end_state[0, i] - truth_of(exposure).end_state[0, i] for estimate, exposure in pairs]
        np.testing.assert_allclose(scalars(entities[f"/error/end/x{i + 1}/{name}"])[:, 0], end, atol=1e-15)


def test_a_path_is_at_its_own_fast_steps_and_seconds_and_a_lost_frame_breaks_it(
    recording: Recording, entities: Entities
) -> None:
    truth, exposures = entities["/path/truth"], list(recording.exposures())
    steps = np.array(truth["fast_step"])
    np.testing.assert_array_equal(np.array(truth["time"]), (steps - exposures[0].first_step) * 1_000_000)
    broken = np.isnan(scalars(truth)[:, 0])
    np.testing.assert_array_equal(steps[~broken], np.concatenate([e.first_step + SHOWN for e in exposures]))
    ends = [a.first_step + N for a, b in pairwise(exposures) if b.first_step > a.first_step + N]
    assert steps[broken].tolist() == ends
    assert len(ends) == 1
    assert "frame" not in truth


def test_states_stand_where_they_hold(recording: Recording, entities: Entities) -> None:
    estimates = recording.estimates("o3")
    for where, late in (("start", 0), ("end", N)):
        for i in range(2):
            entity = entities[f"/state/{where}/x{i + 1}/o3/mean"]
            states = [getattr(e, f"{where}_state")[0, i] for e in estimates]
            np.testing.assert_array_equal(scalars(entity)[:, 0], states)
            assert entity["fast_step"] == [e.first_step + late for e in estimates]
            assert entity["frame"] == [e.frame_id for e in estimates]
    band = scalars(entities["/state/end/x2/o3/band"])
    sd = np.sqrt([e.end_covariance[0, 1, 1] for e in estimates])
    np.testing.assert_allclose(band[:, 0] - band[:, 1], 4 * sd)


def test_nis_is_shown_between_its_95_percent_bounds(recording: Recording, entities: Entities) -> None:
    for name, degrees in (("o1", 1), ("o3", 2)):
        estimates = recording.estimates(name)
        np.testing.assert_array_equal(scalars(entities[f"/nis/{name}/value"])[:, 0], [e.nis[0] for e in estimates])
        low, high = nis_bounds(degrees)
        assert stats.chi2.cdf(high, degrees) - stats.chi2.cdf(low, degrees) == pytest.approx(0.95)
        bounds = entities[f"/nis/{name}/bounds"]
        np.testing.assert_array_equal(scalars(bounds), [[low, high]] * 2)
        assert bounds["frame"] == [estimates[0].frame_id, estimates[-1].frame_id]
    assert not [path for path in entities if path.startswith("/nis/open-loop")]  # it measures nothing
    assert set(words(entities["/status/open-loop"], "StateChange:state")) == {"PREDICTED"}


def test_frames_are_the_counts_that_came(recording: Recording, entities: Entities) -> None:
    frames, exposures = entities["/camera/image"], list(recording.exposures())
    for buffer, exposure in zip(frames["Image:buffer"], exposures, strict=False):
        np.testing.assert_array_equal(np.array(buffer[0], dtype=np.uint8).view("<u2"), exposure.pixels.ravel())
    assert frames["frame"] == [e.frame_id for e in exposures]


def test_a_page_has_a_row_for_each_exposure_and_marks_what_never_came(recording: Recording, entities: Entities) -> None:
    exposures = list(recording.exposures())
    numbers = [e.frame_id - exposures[0].frame_id for e in exposures]
    ((buffer,),) = entities["/camera/history"]["Image:buffer"]
    page = np.array(buffer, dtype=np.uint8).reshape(HISTORY, 40, 3)
    lost = [k for k in range(HISTORY) if (page[k] == MISSING).all()]
    assert lost == sorted(set(range(numbers[-1])) - set(numbers)) != []
    assert (page[numbers[-1] + 1 :] == NOTHING).all()
    rows = [np.array(strips[0])[:, 1] for strips in entities["/camera/history/now"]["LineStrips2D:strips"]]
    assert [(row.min(), row.max()) for row in rows] == [(k, k + 1) for k in numbers]
    (strips,) = entities["/camera/history/path/truth"]["LineStrips2D:strips"]
    newest = np.array(strips[-1])
    assert len(strips) == len(numbers)
    np.testing.assert_allclose(newest[[0, -1], 0], (truth_of(exposures[-1]).path[0, [0, -1]] + 1) / 0.05, rtol=1e-6)
    assert numbers[-1] < newest[0, 1] < newest[-1, 1] < numbers[-1] + 1


def test_pages_follow_each_other_and_each_picture_is_sent_once(tmp_path: Path) -> None:
    """A frame that is lost where a page ends is marked there."""
    write_small(tmp_path / "all.mcap", 70)
    for part, start, end in (("a", 0.0, 6.2), ("b", 6.4, 20.0)):
        cut(tmp_path / "all.mcap", tmp_path / f"{part}.mcap", start, end)
    merge([tmp_path / "a.mcap", tmp_path / "b.mcap"], tmp_path / "gap.mcap")
    history = read_rrd(save_rrd(Recording(tmp_path / "gap.mcap"), tmp_path / "long.rrd"))["/camera/history"]
    assert history["frame"] == [1, 33, 65]
    pages = [np.array(buffer[0], dtype=np.uint8).reshape(HISTORY, 40, 3) for buffer in history["Image:buffer"]]
    assert [[k for k in range(HISTORY) if (page[k] == MISSING).all()] for page in pages] == [[31], [], []]


def test_exposures_are_intervals_and_what_went_wrong_is_on_the_timeline(
    recording: Recording, entities: Entities
) -> None:
    exposures = list(recording.exposures())
    (after,) = (b for a, b in pairwise(exposures) if b.frame_id > a.frame_id + 1)
    lane = entities["/status/exposure"]
    states = dict(zip(lane["fast_step"], words(lane, "StateChange:state"), strict=True))
    assert [step for step, state in states.items() if state != "LOST"] == [e.first_step for e in exposures]
    assert list(states.values()).count("LOST") == 1
    assert entities["/warnings"]["frame"] == [after.frame_id]


def test_what_an_estimator_had_no_time_for_is_shown(recording: Recording, drawing: Drawing, tmp_path: Path) -> None:
    steps = list(recording.steps(["o3"]))
    steps[3] = replace(steps[3], estimates={}, skipped={"o3"})
    timebase = Timebase.of(recording.rig, [each.exposure for each in steps])
    log_status(drawing, timebase, "o3", steps)
    log_warnings(drawing, timebase, steps[3:4])
    entities = drawn(drawing, tmp_path)
    assert words(entities["/status/o3"], "StateChange:state") == ["OK", "SKIPPED", "OK"]
    assert entities["/status/o3"]["frame"] == [steps[k].exposure.frame_id for k in (0, 3, 4)]
    assert entities["/warnings"]["frame"] == [steps[3].exposure.frame_id]


def given(recording: Recording, paths: np.ndarray) -> list[Step]:
    """The exposures, without their truth, with estimates whose paths are given, (axes, n_steps), one after another."""
    axes, steps = len(paths), []
    for number, exposure in enumerate(recording.exposures()):
        (estimate,) = recording[number : number + 1].estimates("o3")
        made = {name: getattr(estimate, name) for name in Estimate.__dataclass_fields__}
        made |= {
            name: np.repeat(made[name], axes, axis=0)
            for name in ("start_state", "start_covariance", "end_state", "end_covariance", "nis")
        }
        one = Drawn(**made, drawn=paths + 0.01 * number, drawn_sd=np.full(paths.shape, 0.04))
        steps.append(Step(number, replace(exposure, truth=None), {"o3": one}))
    return steps


def log_given(recording: Recording, drawing: Drawing, steps: Sequence[Step]) -> None:
    log_estimates(drawing, Timebase.of(recording.rig, [each.exposure for each in steps]), "o3", steps)


def test_a_path_that_swings_too_often_for_a_line_is_drawn_as_its_range(
    recording: Recording, drawing: Drawing, tmp_path: Path
) -> None:
    """What it is between holds every fast step, and the estimate's band is outside of it."""
    steps = given(recording, 0.2 * np.sin(2 * np.pi * np.arange(N) / 6.1)[None])
    log_given(recording, drawing, steps)
    entities = drawn(drawing, tmp_path)
    assert "/path/o3/mean" not in entities
    high, low = without_breaks(scalars(entities["/path/o3/range"])).T
    above, below = without_breaks(scalars(entities["/path/o3/band"])).T
    parts = [part for each in steps for part in np.array_split(each.estimates["o3"].path[0], POINTS // 2)]
    np.testing.assert_array_equal(high, [part.max() for part in parts])
    np.testing.assert_array_equal(low, [part.min() for part in parts])
    assert (above > high).all()
    assert (below < low).all()


def test_many_axes_become_percentiles(recording: Recording, drawing: Drawing, tmp_path: Path) -> None:
    steps = given(recording, np.random.default_rng(0).normal(size=(1800, N)))
    drawing.points = None
    log_given(recording, drawing, steps)
    entities = drawn(drawing, tmp_path)
    assert len(entities) < 30
    values = np.concatenate([each.estimates["o3"].path for each in steps], axis=1)
    np.testing.assert_array_equal(without_breaks(scalars(entities["/path/o3/mean"]))[:, 0], values[0])
    spread = without_breaks(scalars(entities["/path/o3/mean/axes"]))
    np.testing.assert_allclose(spread, np.percentile(values, [5, 50, 95], axis=0).T)


def test_the_profile_is_the_measured_one_and_what_the_kernel_makes_of_the_path(
    recording: Recording, entities: Entities
) -> None:
    """In the widest exposure: a narrower one may reach over the top."""
    estimates, line = recording.estimates("o3"), recording.rig.sensor.profile
    widest = int(np.argmax([np.std(each.path) for each in estimates]))
    measured, predicted = (
        np.array(entities[f"/profile/{what}"]["LineStrips2D:strips"][-len(estimates) :][widest][0])[:, 1]
        for what in ("measured", "predicted/o3")
    )
    counts = (recording[widest].pixels.ravel() - float(line.black_level)) / line.counts_per_density
    scale = measured[::2][np.argmax(counts)] / counts.max()
    np.testing.assert_allclose(measured[::2], scale * counts, atol=1e-5)
    expected = exposure_density(line.kernel, line.edges, estimates[widest].path[0])
    np.testing.assert_allclose(predicted, scale * expected, atol=1e-4)


def test_commands_and_what_was_applied(recording: Recording, entities: Entities) -> None:
    """At the steps where they change, and of those so many that a path has; the extremes are among them."""
    for entity, topic in (("/mirror/command", topics.COMMAND), ("/mirror/applied", topics.APPLIED)):
        blocks, shown = messages(recording, topic), entities[entity]
        first, inputs = blocks[0].first_step, np.concatenate([each.u for each in blocks])
        steps, values = np.array(shown["fast_step"]) - first, scalars(shown)[:, 0]
        assert (steps[0], steps[-1]) == (0, len(inputs) - 1)
        assert len(inputs) // N * POINTS // 3 < len(steps) <= len(inputs) // N * POINTS + 2
        np.testing.assert_array_equal(values, inputs[steps])
        assert (values.min(), values.max()) == (inputs.min(), inputs.max())


def test_what_links_and_clocks_do_is_shown_in_its_units(recording: Recording, entities: Entities) -> None:
    for device in ("camera", "mirror"):
        clock = messages(recording, topics.CLOCK, device)
        for field in ("sigma_ns", "round_trip_ns"):
            expected = [getattr(each, field) / 1e3 for each in clock]
            np.testing.assert_allclose(scalars(entities[f"/clock/{field}/{device}"])[:, 0], expected)
        change = scalars(entities[f"/clock/offset_ns/{device}"])[:, 0]
        np.testing.assert_allclose(change, [(each.offset_ns - clock[0].offset_ns) / 1e3 for each in clock], atol=1e-3)
        link = messages(recording, topics.CONNECTION, device)
        trips = [each.round_trip_s * 1e3 for each in link]
        np.testing.assert_allclose(scalars(entities[f"/connection/round_trip_s/{device}"])[:, 0], trips)
        times = [each.log_time_ns for each in recording.messages(topics.CONNECTION) if each.message in link]
        rates = np.diff([each.bytes_received for each in link]) / np.diff(sorted(set(times))) * 1e6
        np.testing.assert_allclose(scalars(entities[f"/connection/bytes_received/{device}"])[:, 0], rates)
    lost = np.cumsum([each.frames_lost_before for each in messages(recording, topics.EXPOSURE)])
    assert scalars(entities["/camera/exposure/frames_lost_before"])[:, 0].tolist() == lost.tolist()
    log = messages(recording, topics.LOG)
    assert words(entities["/log"], "TextLog:text") == [f"{each.name}: {each.message}" for each in log]
    assert set(words(entities["/log"], "TextLog:level")) <= {"INFO", "WARN"}


@pytest.mark.slow
def test_latency_counts_from_the_end_of_the_exposure(tmp_path: Path) -> None:
    recording = session(tmp_path / "live.mcap", "--real-time")
    entities = read_rrd(save_rrd(recording, tmp_path / "live.rrd"))
    latencies = messages(recording, topics.LATENCY)
    for field in ("first_byte_ns", "complete_ns", "estimated_ns"):
        expected = [(getattr(each, field) - each.exposure_end_ns) / 1e6 for each in latencies]
        np.testing.assert_allclose(scalars(entities[f"/latency/{field}"])[:, 0], expected)
    took = [each.took_ns / 1e6 for each in messages(recording, topics.estimation_topic("o3"))]
    np.testing.assert_allclose(scalars(entities["/estimation/took_ns/o3"])[:, 0], took)


def test_a_quantity_has_one_colour_everywhere(entities: Entities) -> None:
    def colours(path: str) -> set[int]:
        columns = [v for k, v in entities[path].items() if k.endswith(":colors")]
        return {colour >> 8 for rows in columns for row in rows for colour in row or []}

    for name, colour in (("truth", TRUTH), ("o3", estimator_colour("o3"))):
        packed = {int.from_bytes(bytes(colour), "big")}
        shown = [p for p in entities if name in p.split("/") and not p.startswith(("/status", "/estimate"))]
        assert len(shown) >= 4
        assert {path: colours(path) for path in shown} == dict.fromkeys(shown, packed)


def test_what_a_session_lacks_has_no_view(tmp_path: Path) -> None:
    path = save_rrd(Recording(write_small(tmp_path / "bare.mcap", 4)), tmp_path / "bare.rrd")
    entities = read_rrd(path)
    assert "/profile/measured" in entities
    assert not [p for p in entities if p.startswith(("/error", "/path", "/nis", "/latency", "/state"))]
    layout = str(read_blueprint(path))
    assert "Input " in layout
    for absent in ("error", "NIS", "Latency", "state"):
        assert f"{absent} " not in layout


def test_an_existing_file_is_only_replaced_when_told_to(recording: Recording, tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    path.write_text("precious")
    with pytest.raises(ViewerError, match="overwritten"):
        save_rrd(recording, path)
    assert path.read_text() == "precious"
    save_rrd(recording, path, overwrite=True)
    assert "/path/truth" in read_rrd(path)


def test_a_file_that_cannot_be_written_is_one_clear_error_and_leaves_nothing(
    recording: Recording, tmp_path: Path
) -> None:
    with pytest.raises(ViewerError, match="folder"):
        save_rrd(recording, tmp_path / "absent" / "session.rrd")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    for size in (0, 100_000):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            with pytest.raises(ViewerError, match="disk full"):
                save_rrd(recording, tmp_path / "session.rrd")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_of_a_long_session_one_part_is_in_memory_and_its_lines_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with simulated_rig("section-vi-lively", "--fault", "missing=0.2") as ports:
        record(load_rig("section-vi-lively"), *ports, tmp_path / "a.mcap", exposures=8 * HISTORY)
    recording, alive, drawn = Recording(tmp_path / "a.mcap"), list[int](), list[Entities]()
    for pages in (1, 100):
        monkeypatch.setattr(save, "_PAGES", pages)
        save_rrd(
            recording, path := tmp_path / f"{pages}.rrd",
            progress=lambda _: alive.append(sum(isinstance(each, RecordedMessage) for each in gc.get_objects())),
        )  # fmt: skip
        drawn.append(read_rrd(path))
    assert alive[0] >= max(alive)
    lines = [each for each in drawn[1] if each.startswith(("/clock", "/connection", "/status"))]
    assert len(lines) > 12
    for entity in lines:
        ours, theirs = ([v for v in each[entity]["fast_step"] if v is not None] for each in drawn)
        np.testing.assert_allclose(ours, theirs, atol=1, err_msg=entity)
        for column in drawn[1][entity].keys() & {"Scalars:scalars", "StateChange:state"}:
            ours, theirs = ([v for v in each[entity][column] if v is not None] for each in drawn)
            assert ours == theirs, entity
