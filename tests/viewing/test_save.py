from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from scipy import stats

from aolink.colours import estimator_colour
from aolink.errors import ViewerError
from aolink.estimation.estimate import Estimate
from aolink.gathered import nis_bounds
from aolink.recording.reader import Recording
from aolink.series import Step
from aolink.viewing.camera import HISTORY
from aolink.viewing.motion import log_estimates
from aolink.viewing.palette import MISSING, NOTHING, TRUTH
from aolink.viewing.save import save_rrd
from aolink.viewing.series import POINTS, Drawing
from aolink.viewing.timebase import Timebase
from tests.conftest import Session
from tests.kinds import truth_of
from tests.viewing.rrd import Entities, read_blueprint, read_rrd, scalars
from tests.viewing.stand_in import MEASUREMENTS, StandIn, as_recording

N = 200
LOST = 3
SHOWN = np.linspace(0, N - 1, POINTS).astype(int)
"""The fast steps of an exposure at which a path is drawn."""


@pytest.fixture(scope="module")
def recording() -> StandIn:
    return StandIn(n=12, lost=(LOST,))


@pytest.fixture(scope="module")
def saved(recording: StandIn, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_rrd(as_recording(recording), tmp_path_factory.mktemp("rrd") / "session.rrd")


@pytest.fixture(scope="module")
def entities(saved: Path) -> Entities:
    return read_rrd(saved)


def without_breaks(values: np.ndarray) -> np.ndarray:
    return np.asarray(values[~np.isnan(values).any(axis=1)])


def absent_from_views(path: Path) -> list[str]:
    """Entities that a view names and the file does not hold, or of which nothing is below one that it names."""
    entities = read_rrd(path)
    queries = {
        expression.removeprefix("+ ").removeprefix("- ")
        for view in read_blueprint(path).values()
        for row in view.get("ViewContents:query", [])
        for expression in row
        if "$" not in expression
    }
    assert len(queries) > 2
    known = [f"{entity}/" for entity in entities]
    return sorted(
        name for name in queries
        if not any(each == f"{name}/" or (name.endswith("/**") and each.startswith(name[:-2])) for each in known)
    )  # fmt: skip


def steps_of(recording: StandIn, estimates: Sequence[Estimate]) -> list[Step]:
    """The exposures, without their truth, with an estimator's estimates."""
    exposures = [replace(each, truth=None) for each in recording.exposures()]
    return [Step(k, e, {each.estimator: each}) for k, (e, each) in enumerate(zip(exposures, estimates, strict=True))]


def test_a_recorded_session_shows_its_estimates(recorded: Session, tmp_path: Path) -> None:
    recording = Recording(recorded.path)
    path = save_rrd(recording, tmp_path / "session.rrd")
    entities = read_rrd(path)
    for name in recording.estimators:
        shown = scalars(entities[f"/path/{name}/mean"])[:, 0]
        np.testing.assert_array_equal(shown, np.concatenate([e.path[0, SHOWN] for e in recording.estimates(name)]))
    truth = np.concatenate([truth_of(e).path[0, SHOWN] for e in recording.exposures()])
    np.testing.assert_array_equal(scalars(entities["/path/truth"])[:, 0], truth)
    assert entities["/camera/image"]["frame"] == [e.frame_id for e in recording.exposures()]
    assert absent_from_views(path) == []


def test_rerun_finds_no_fault_in_the_file(saved: Path) -> None:
    done = subprocess.run([sys.executable, "-m", "rerun_cli", "rrd", "verify", str(saved)], capture_output=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", sorted(MEASUREMENTS))
def test_path_and_band_are_the_estimates(recording: StandIn, entities: Entities, name: str) -> None:
    estimates = recording.estimates(name)
    mean = np.concatenate([e.path[0, SHOWN] for e in estimates])
    sd = np.concatenate([e.path_sd[0, SHOWN] for e in estimates])
    np.testing.assert_array_equal(without_breaks(scalars(entities[f"/path/{name}/mean"]))[:, 0], mean)
    band = without_breaks(scalars(entities[f"/path/{name}/band"]))
    np.testing.assert_allclose(band, np.stack([mean + 2 * sd, mean - 2 * sd], axis=1), rtol=1e-14)


@pytest.mark.parametrize("name", sorted(MEASUREMENTS))
def test_errors_are_estimate_minus_truth(recording: StandIn, entities: Entities, name: str) -> None:
    pairs = list(zip(recording.estimates(name), recording.exposures(), strict=True))
    error = [estimate.path[0] - truth_of(exposure).path[0] for estimate, exposure in pairs]
    np.testing.assert_allclose(
        without_breaks(scalars(entities[f"/error/path/{name}"]))[:, 0], np.concatenate(error)[_shown(11)], atol=1e-15
    )
    rms = scalars(entities[f"/error/path_rms/{name}"])[:, 0]
    np.testing.assert_allclose(rms, [np.linalg.norm(e) / np.sqrt(N) for e in error])
    for i in range(2):
        end = [estimate.end_state[0, i] - truth_of(exposure).end_state[0, i] for estimate, exposure in pairs]
        np.testing.assert_allclose(scalars(entities[f"/error/end/x{i + 1}/{name}"])[:, 0], end, atol=1e-15)


def _shown(exposures: int) -> np.ndarray:
    """Places of the shown steps among all of so many exposures."""
    return np.concatenate([N * k + SHOWN for k in range(exposures)])


def test_a_path_is_at_its_own_fast_steps_and_seconds(recording: StandIn, entities: Entities) -> None:
    truth = entities["/path/truth"]
    steps = np.array(truth["fast_step"])
    np.testing.assert_array_equal(np.array(truth["time"]), steps * 1_000_000)
    known = ~np.isnan(scalars(truth)[:, 0])
    np.testing.assert_array_equal(scalars(truth)[known, 0], recording.spot[steps[known]])
    assert "frame" not in truth


def test_a_lost_frame_breaks_the_lines(entities: Entities) -> None:
    truth = entities["/path/truth"]
    (gap,) = np.flatnonzero(np.isnan(scalars(truth)[:, 0]))
    assert truth["fast_step"][gap - 1 : gap + 2] == [LOST * N - 1, LOST * N, (LOST + 1) * N]


def test_states_stand_where_they_hold(recording: StandIn, entities: Entities) -> None:
    estimates = recording.estimates("o3")
    for where, states, steps in (
        ("start", [e.start_state for e in estimates], [e.first_step for e in estimates]),
        ("end", [e.end_state for e in estimates], [e.first_step + N for e in estimates]),
    ):
        for i in range(2):
            entity = entities[f"/state/{where}/x{i + 1}/o3/mean"]
            np.testing.assert_array_equal(scalars(entity)[:, 0], [s[0, i] for s in states])
            assert entity["fast_step"] == steps
            assert entity["frame"] == recording.frame_ids
    band = scalars(entities["/state/end/x2/o3/band"])
    np.testing.assert_allclose(band[:, 0] - band[:, 1], 4 * np.sqrt(0.04))


@pytest.mark.parametrize(("name", "degrees"), [("o1", 1), ("o3", 2)])
def test_nis_is_shown_between_its_95_percent_bounds(
    recording: StandIn, entities: Entities, name: str, degrees: int
) -> None:
    np.testing.assert_array_equal(
        scalars(entities[f"/nis/{name}/value"])[:, 0], [e.nis[0] for e in recording.estimates(name)]
    )
    low, high = nis_bounds(degrees)
    assert stats.chi2.cdf(high, degrees) - stats.chi2.cdf(low, degrees) == pytest.approx(0.95)
    bounds = entities[f"/nis/{name}/bounds"]
    np.testing.assert_array_equal(scalars(bounds), [[low, high]] * 2)
    assert bounds["frame"] == [0, 11]


def test_an_estimator_that_does_not_measure_has_no_nis(entities: Entities) -> None:
    assert not [path for path in entities if path.startswith("/nis/open-loop")]
    assert set(map(tuple, entities["/status/open-loop"]["StateChange:state"])) == {("PREDICTED",)}


def test_frames_are_the_counts_that_came(recording: StandIn, entities: Entities) -> None:
    frames = entities["/camera/image"]
    for buffer, exposure in zip(frames["Image:buffer"], recording.exposures(), strict=False):
        np.testing.assert_array_equal(np.array(buffer[0], dtype=np.uint8).view("<u2"), exposure.pixels.ravel())
    assert frames["frame"] == recording.frame_ids


def test_a_page_has_a_row_for_each_exposure_and_marks_what_never_came(entities: Entities) -> None:
    ((buffer,),) = entities["/camera/history"]["Image:buffer"]
    page = np.array(buffer, dtype=np.uint8).reshape(HISTORY, 40, 3)
    assert (page[5, 30:34] == MISSING).all()
    assert (page[LOST] == MISSING).all()
    assert not (page[4] == MISSING).all(axis=1).any()
    assert (page[12:] == NOTHING).all()
    rows = [np.array(strips[0])[:, 1] for strips in entities["/camera/history/now"]["LineStrips2D:strips"]]
    assert [(row.min(), row.max()) for row in rows] == [(k, k + 1) for k in range(12) if k != LOST]


def test_pages_follow_each_other_and_each_picture_is_sent_once(tmp_path: Path) -> None:
    """A frame that is lost where a page ends is marked there."""
    entities = read_rrd(save_rrd(as_recording(StandIn(n=70, lost=(31, 40), names=("o3",))), tmp_path / "long.rrd"))
    history = entities["/camera/history"]
    assert history["frame"] == [0, 32, 64]
    pages = [np.array(buffer[0], dtype=np.uint8).reshape(HISTORY, 40, 3) for buffer in history["Image:buffer"]]
    assert [[k for k in range(HISTORY) if (page[k] == MISSING).all()] for page in pages] == [[31], [8], []]
    strips = entities["/camera/history/path/o3"]["LineStrips2D:strips"]
    assert [len(each) for each in strips] == [31, 31, 6]


def test_exposures_are_intervals_and_what_went_wrong_is_on_the_timeline(entities: Entities) -> None:
    """Frame 3 was lost, of frame 5 four columns of forty are missing."""
    lane = entities["/status/exposure"]
    assert lane["fast_step"] == [k * N for k in range(12)]
    assert [state for (state,) in lane["StateChange:state"]][2:5] == ["EXPOSURE", "LOST", "EXPOSURE"]
    warnings = entities["/warnings"]
    assert [text for (text,) in warnings["TextLog:text"]] == [
        "1 frame lost before frame 4", "frame 5 is incomplete: 10% of its pixels never came",
    ]  # fmt: skip
    assert warnings["frame"] == [4, 5]


def test_a_path_that_swings_too_often_for_a_line_is_drawn_as_its_range(tmp_path: Path) -> None:
    """What it is between holds every fast step, and the estimate's band is outside of it."""
    recording = StandIn(n=12, names=("o3",))
    swing = 0.2 * np.sin(2 * np.pi * np.arange(N) / 6.1)
    estimates = [replace(e, drawn=swing[None] + 0.01 * k) for k, e in enumerate(recording.estimates("o3"))]
    path = tmp_path / "swings.rrd"
    with rr.RecordingStream("test") as stream:
        stream.save(path)
        timebase = Timebase.of(recording.rig, list(recording.exposures()))
        log_estimates(Drawing(stream=stream, rig=recording.rig), timebase, "o3", steps_of(recording, estimates))
    entities = read_rrd(path)
    assert "/path/o3/mean" not in entities
    high, low = scalars(entities["/path/o3/range"]).T
    above, below = scalars(entities["/path/o3/band"]).T
    assert len(high) == 12 * POINTS // 2
    parts = [part for e in estimates for part in np.array_split(e.path[0], POINTS // 2)]
    np.testing.assert_array_equal(high, [part.max() for part in parts])
    np.testing.assert_array_equal(low, [part.min() for part in parts])
    assert (above > high).all()
    assert (below < low).all()


def test_of_a_few_exposures_every_fast_step_is_shown(tmp_path: Path) -> None:
    recording = StandIn(n=4, names=("o3",))
    entities = read_rrd(save_rrd(as_recording(recording), tmp_path / "few.rrd"))
    mean = scalars(entities["/path/o3/mean"])[:, 0]
    np.testing.assert_array_equal(mean, np.concatenate([e.path[0] for e in recording.estimates("o3")]))


def test_a_path_runs_down_its_own_row(recording: StandIn, entities: Entities) -> None:
    (strips,) = entities["/camera/history/path/truth"]["LineStrips2D:strips"]
    newest = np.array(strips[-1])
    assert len(strips) == 11
    path = truth_of(list(recording.exposures())[-1]).path[0]
    np.testing.assert_allclose(newest[[0, -1], 0], (path[[0, -1]] + 1) / 0.05, rtol=1e-6)
    assert 11 < newest[0, 1] < newest[-1, 1] < 12


def test_predicted_profile_has_unit_mass_about_the_path_it_came_from(recording: StandIn, entities: Entities) -> None:
    predicted = entities["/profile/predicted/o3"]["LineStrips2D:strips"]
    measured = entities["/profile/measured"]["LineStrips2D:strips"]
    (exposure, estimate) = next(zip(recording.exposures(), recording.estimates("o3"), strict=True))
    stairs = np.array(measured[0][0])
    counts = exposure.pixels.ravel()
    scale = stairs[::2, 1][np.argmax(counts)] / ((counts.max() - 20000) / 2000)
    np.testing.assert_allclose(stairs[::2, 1], scale * (counts - 20000.0) / 2000, atol=1e-5)
    x, density = np.array(predicted[0][0]).T / [[1], [scale]]
    assert density.sum() * 0.05 == pytest.approx(1, abs=1e-4)
    assert (x * density).sum() * 0.05 == pytest.approx(estimate.path.mean(), abs=1e-3)


def test_commands_and_what_was_applied(recording: StandIn, entities: Entities) -> None:
    """At the steps where they change, and of those so many that a path has; the extremes are among them."""
    sent, held = entities["/mirror/command"], entities["/mirror/applied"]
    expected = recording.rig.drive.inputs(0, 12 * N, 1e-3)
    for shown, inputs in ((sent, expected), (held, np.round(expected, 4))):
        steps = shown["fast_step"]
        assert (steps[0], steps[-1]) == (0, 12 * N - 1)
        assert len(steps) <= 12 * POINTS + 2
        np.testing.assert_array_equal(scalars(shown), inputs[steps])
        assert scalars(shown).min() == inputs.min()
        assert scalars(shown).max() == inputs.max()
    assert len(sent["fast_step"]) > 12 * POINTS // 3
    assert entities["/status/mirror"]["StateChange:state"] == [["COMMAND"], ["PARKED"], ["COMMAND"]]
    assert entities["/status/mirror"]["fast_step"] == [0, 150, 200]


def test_latency_counts_from_the_end_of_the_exposure(entities: Entities) -> None:
    np.testing.assert_allclose(scalars(entities["/latency/first_byte"]), 0.4)
    np.testing.assert_allclose(scalars(entities["/latency/complete"]), 0.9)
    assert "/latency/command_sent" not in entities  # it never happened


def test_losses_add_up(entities: Entities) -> None:
    assert scalars(entities["/connection/lost/frames"])[:, 0].tolist() == [0] * 3 + [1] * 8
    assert scalars(entities["/connection/lost/chunks"])[:, 0].tolist() == [0] * 4 + [1] * 7


def test_what_links_and_clocks_do_is_shown_in_its_units(entities: Entities) -> None:
    np.testing.assert_allclose(scalars(entities["/connection/received/mirror"])[:, 0], 180)
    np.testing.assert_allclose(scalars(entities["/connection/round_trip/camera"])[:, 0], 0.2)
    np.testing.assert_allclose(scalars(entities["/clock/offset/camera"])[:, 0], [0, 20, 40])
    np.testing.assert_allclose(scalars(entities["/clock/sigma/mirror"])[:, 0], [90, 45, 30])
    assert entities["/clock/sigma/mirror"]["time"][1] == 10**9
    assert entities["/clock/sigma/mirror"]["fast_step"] == [0, 1000, 2000]


def test_the_log_keeps_its_levels(entities: Entities) -> None:
    assert entities["/log"]["TextLog:text"] == [["session: second 0"], ["session: second 1"], ["session: second 2"]]
    assert entities["/log"]["TextLog:level"] == [["INFO"], ["WARN"], ["INFO"]]


def test_a_quantity_has_one_colour_everywhere(entities: Entities) -> None:
    def colours(path: str) -> set[int]:
        columns = [v for k, v in entities[path].items() if k.endswith(":colors")]
        return {colour >> 8 for rows in columns for row in rows for colour in row or []}

    for name, colour in (("truth", TRUTH), ("o3", estimator_colour("o3"))):
        packed = {int.from_bytes(bytes(colour), "big")}
        shown = [p for p in entities if name in p.split("/") and not p.startswith(("/status", "/estimate"))]
        assert len(shown) >= 4
        for path in shown:
            assert colours(path) == packed, path


@pytest.mark.slow
def test_every_view_shows_entities_that_exist(saved: Path) -> None:
    assert absent_from_views(saved) == []


def test_what_a_session_lacks_has_no_view(tmp_path: Path) -> None:
    path = save_rrd(as_recording(StandIn(n=4, with_truth=False, with_latency=False, names=())), tmp_path / "bare.rrd")
    entities = read_rrd(path)
    assert "/profile/measured" in entities
    assert not [p for p in entities if p.startswith(("/error", "/path", "/nis", "/latency", "/state"))]
    layout = str(read_blueprint(path))
    assert "Mirror input " in layout
    for absent in ("error", "NIS", "Latency", "state"):
        assert f"{absent} " not in layout


def test_many_axes_become_percentiles(tmp_path: Path) -> None:
    axes = 1800
    recording = StandIn(n=3, names=("o3",))
    rng = np.random.default_rng(0)
    estimates = [
        replace(
            e, drawn=rng.normal(size=(axes, N)), drawn_sd=np.ones((axes, N)), nis=rng.chisquare(2, size=axes),
            start_state=rng.normal(size=(axes, 2)), start_covariance=np.tile(np.eye(2), (axes, 1, 1)),
            end_state=rng.normal(size=(axes, 2)), end_covariance=np.tile(np.eye(2), (axes, 1, 1)),
        )
        for e in recording.estimates("o3")
    ]  # fmt: skip
    path = tmp_path / "many.rrd"
    with rr.RecordingStream("test") as stream:
        stream.save(path)
        timebase = Timebase.of(recording.rig, list(recording.exposures()))
        drawing = Drawing(stream=stream, rig=recording.rig, points=None)
        log_estimates(drawing, timebase, "o3", steps_of(recording, estimates))
    entities = read_rrd(path)
    assert len(entities) < 30
    values = np.concatenate([e.path for e in estimates], axis=1)
    np.testing.assert_array_equal(scalars(entities["/path/o3/mean"])[:, 0], values[0])
    np.testing.assert_allclose(scalars(entities["/path/o3/mean/axes"]), np.percentile(values, [5, 50, 95], axis=0).T)


def test_an_existing_file_is_only_replaced_when_told_to(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    path.write_text("precious")
    with pytest.raises(ViewerError, match="exists and is not overwritten"):
        save_rrd(as_recording(StandIn(n=2)), path)
    assert path.read_text() == "precious"
    save_rrd(as_recording(StandIn(n=2)), path, overwrite=True)
    assert "/path/truth" in read_rrd(path)


def test_a_file_that_cannot_be_written_is_one_clear_error_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(ViewerError, match=r"cannot write .*there is no folder"):
        save_rrd(as_recording(StandIn(n=2)), tmp_path / "absent" / "session.rrd")
    with pytest.raises(ViewerError, match="no exposure"):
        save_rrd(as_recording(StandIn(n=0)), tmp_path / "empty.rrd")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_clear_error_and_leaves_nothing(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, before[1]))
    try:
        with pytest.raises(ViewerError, match="disk full"):
            save_rrd(as_recording(StandIn(n=12)), tmp_path / "session.rrd")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_fed_exposure_by_exposure_it_shows_what_the_file_shows(recorded: Session, tmp_path: Path) -> None:
    """Frames, paths, errors and states are those of `save_rrd`; only the brightness follows the first frame."""
    import rerun as rr

    from aolink.session.replay import replay
    from aolink.viewing import LiveView

    recording = Recording(recorded.path)
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "live.rrd")
    live = LiveView(stream, recording.rig, recording.estimators)
    for exposure, estimates in replay(recording, recording.estimators):
        live.show(exposure, estimates)
    stream.disconnect()
    save_rrd(recording, tmp_path / "file.rrd")
    live_entities, file_entities = (read_rrd(tmp_path / name) for name in ("live.rrd", "file.rrd"))
    for entity, component in (
        ("/camera/image", "Image:buffer"),
        ("/profile/path/o3", "LineStrips2D:strips"),
        ("/path/o3/mean", "Scalars:scalars"),
        ("/error/path/o1", "Scalars:scalars"),
        ("/status/o3", "StateChange:state"),
    ):
        for column in (component, "fast_step"):
            ours, theirs = (
                [v for v in each[entity][column] if v is not None] for each in (live_entities, file_entities)
            )
            assert ours == theirs, (entity, column)
            assert ours
    pages = [each["/camera/history/path/o3"]["LineStrips2D:strips"] for each in (live_entities, file_entities)]
    assert pages[0][-1] == pages[1][-1]
    assert len(pages[0]) == len(recording)


def test_a_live_view_takes_an_estimate_with_a_later_exposure(recorded: Session, tmp_path: Path) -> None:
    """An estimator that takes long is late: what it says is shown where it belongs."""
    from aolink.viewing import LiveView

    recording = Recording(recorded.path)
    exposures, late = list(recording.exposures())[:4], recording.estimates("o3")[:4]
    stream = rr.RecordingStream("test")
    stream.save(tmp_path / "live.rrd")
    live = LiveView(stream, recording.rig, ["o3"])
    for exposure, estimates in zip(exposures, ([], [], [late[0]], [late[1], late[3]]), strict=True):
        live.show(exposure, estimates)
    stream.disconnect()
    entities = read_rrd(tmp_path / "live.rrd")
    shown = scalars(entities["/path/o3/mean"])[:, 0]
    np.testing.assert_array_equal(shown, np.concatenate([late[k].path[0, SHOWN] for k in (0, 1, 3)]))
    steps = [step for step in entities["/path/o3/mean"]["fast_step"] if step is not None]
    assert steps == [e.first_step + k for e in (late[0], late[1], late[3]) for k in SHOWN]


def test_what_an_estimator_had_no_time_for_is_shown(tmp_path: Path) -> None:
    save_rrd(as_recording(StandIn(n=12, without_time=(7, 8))), tmp_path / "a.rrd")
    entities = read_rrd(tmp_path / "a.rrd")
    assert len(scalars(entities["/latency/estimation/o3"])) == 10
    lane = entities["/status/o3"]
    assert [state for (state,) in lane["StateChange:state"]] == ["OK", "SKIPPED", "OK"]
    assert lane["frame"] == [0, 7, 9]
    assert [text for (text,) in entities["/warnings"]["TextLog:text"]][-2:] == [
        "o3 had no time for frame 7", "o3 had no time for frame 8",
    ]  # fmt: skip
    (text,) = [each for each in entities["/session"]["TextDocument:text"] if each is not None]
    assert "skipped for want of time: o3 2" in str(text)
