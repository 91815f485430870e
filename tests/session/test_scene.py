"""A session with two sensors: the picture sensor's frames over the wire, in the recording, restored, and shown."""

from __future__ import annotations

import io
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import Message
from typer.testing import CliRunner

import aolink
from aolink.cli.common import app
from aolink.errors import DeviceError, EstimatorError, RecordingError, RestorationError
from aolink.estimation.estimate import motion
from aolink.exposure import Exposure, Picture
from aolink.numerics.covariance import psd_root
from aolink.optics.camera import to_density
from aolink.optics.scene import SceneSensor, framed
from aolink.optics.sensor import SpotSensor
from aolink.recording import topics
from aolink.recording.compare import compare
from aolink.recording.deblur import write_deblurred
from aolink.recording.editing import cut, merge
from aolink.recording.reader import Recording
from aolink.recording.reestimate import first_difference, reestimate, write_reestimated
from aolink.restoration import deblur, motion_psf, motion_psf_by_root, restore
from aolink.restoration.deblur import blurred_psnr, estimated_psfs, psnr
from aolink.rig import load_rig
from aolink.rig.scene_table import read_scene_picture
from aolink.session import Report, record
from aolink.viewing import save_rrd
from aolink.viewing.live import drawn
from tests.commands import simulated_rig
from tests.kinds import must_be, truth_of
from tests.recording.small import copied
from tests.session.test_session import FAULTY
from tests.viewing.rrd import read_rrd
from tests.viewing.test_save import absent_from_views

Run = Callable[..., "subprocess.CompletedProcess[str]"]
RIG = load_rig("moving-scene")
SCENE = must_be(SceneSensor, RIG.scene)
EXPOSURES = 8


def take(path: Path, rig: str | Path = "moving-scene", exposures: int = EXPOSURES, **options: Any) -> Report:
    with simulated_rig(rig) as (camera, mirror):
        return record(load_rig(rig), camera, mirror, path, estimators=["o1"], exposures=exposures, **options)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "session.mcap"
    report = take(path)
    assert (report.scenes_received, report.scenes_incomplete, report.scenes_lost) == (EXPOSURES, 0, 0)
    return path


@pytest.fixture(scope="module")
def sharp(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sharp") / "sharp.mcap"
    write_deblurred(Recording(session), path, estimator="moments")
    return path


def data(recording: Recording, *wanted: str) -> list[tuple[str, int, bytes]]:
    return [(raw.topic, raw.log_time_ns, raw.data) for raw in recording.raw_messages(*wanted)]


def test_the_wire_gives_what_the_model_gives_in_memory(session: Path) -> None:
    exposures, expected = list(Recording(session).exposures()), aolink.simulate("moving-scene", EXPOSURES)
    for mine, other in zip(exposures, expected, strict=True):
        picture = must_be(Picture, mine.scene)
        np.testing.assert_array_equal(picture.pixels, must_be(Picture, other.scene).pixels)
        assert picture.mask.all()
        np.testing.assert_array_equal(mine.pixels, other.pixels)


def test_the_true_scene_is_in_the_recording_of_a_simulated_rig(session: Path) -> None:
    true = Recording(session).true_scene
    assert true is not None
    expected = SCENE.to_counts(framed(SCENE, read_scene_picture(SCENE, RIG.folder)))
    np.testing.assert_array_equal(true, expected)


def test_the_scene_delays_no_spot(session: Path) -> None:
    """The estimate of an exposure is made before its scene has come."""
    order = [each.topic for each in Recording(session).messages("/estimate/o1", topics.SCENE, topics.IMAGE)]
    assert order == [topics.IMAGE, "/estimate/o1", topics.SCENE] * EXPOSURES


@pytest.mark.slow
def test_a_bad_link_costs_scenes_their_own_pixels_and_is_reproducible(tmp_path: Path) -> None:
    rig = tmp_path / "faulty.toml"
    rig.write_text(RIG.toml + FAULTY)  # its picture comes with aolink
    reports = [take(tmp_path / name, rig, exposures=12) for name in ("a.mcap", "b.mcap")]
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    report, exposures = reports[0], list(Recording(tmp_path / "a.mcap").exposures())
    known = [(e, e.scene) for e in exposures if e.scene is not None]
    assert report.scenes_incomplete > 0
    assert report.scenes_lost == 12 - report.scenes_received
    assert len(known) <= report.scenes_received
    assert sum(not scene.mask.all() for _, scene in known) in range(1, report.scenes_incomplete + 1)
    truth = aolink.simulate(rig, 12)
    for e, scene in known:
        expected = must_be(Picture, truth[e.first_step // 200].scene)
        np.testing.assert_array_equal(scene.pixels[scene.mask], expected.pixels[scene.mask])
        assert not scene.pixels[~scene.mask].any()
        assert np.count_nonzero(~scene.mask) % 2048 == 0  # whole chunks
    # The spots of exposures whose scene was damaged are whole, and the other way round.
    assert any(e.complete and not scene.mask.all() for e, scene in known)
    summary = write_deblurred(Recording(tmp_path / "a.mcap"), tmp_path / "sharp.mcap", estimator="o1")
    assert summary.exposures == len(exposures)
    assert summary.scenes == len(known)
    missing = sum(number for reason, number in summary.reasons.items() if "the picture never came" in reason)
    assert missing == len(exposures) - len(known)


def test_a_camera_with_another_scene_is_refused(tmp_path: Path) -> None:
    other = replace(RIG, scene=replace(SCENE, pixels=(128, 64)))
    with simulated_rig("moving-scene") as (camera, mirror):
        for rig in (other, replace(RIG, scene=None)):
            with pytest.raises(DeviceError, match=r"scene\.pixels"):
                record(rig, camera, mirror, tmp_path / "a.mcap", exposures=1)


def test_cut_and_merged_again_scenes_stay_with_their_exposures(sharp: Path, tmp_path: Path) -> None:
    whole = list(Recording(sharp).exposures())
    middle = (Recording(sharp).end_ns - Recording(sharp).start_ns) / 2e9
    cut(sharp, tmp_path / "a.mcap", 0, middle)
    cut(sharp, tmp_path / "b.mcap", middle, 1e3)
    parts = [Recording(tmp_path / name) for name in ("a.mcap", "b.mcap")]
    assert all(0 < part.counts[topics.SCENE] < EXPOSURES for part in parts)
    for part in parts:
        own = list(part.exposures())
        assert [each.frame_id for each in part.restored()] == [e.frame_id for e in own]
        assert all(each.scene is not None for each in part.restored())
        assert part.true_scene is not None
    merge([part.path for part in parts], tmp_path / "c.mcap")
    merged = list(Recording(tmp_path / "c.mcap").exposures())
    assert [e.frame_id for e in merged] == [e.frame_id for e in whole]
    for one, two in zip(merged, whole, strict=True):
        np.testing.assert_array_equal(must_be(Picture, one.scene).pixels, must_be(Picture, two.scene).pixels)


def test_compare_names_the_exposure_of_a_scene(session: Path, tmp_path: Path) -> None:
    number = count(1)

    def dark_from_the_third_on(topic: str, message: Message) -> list[Message]:
        if topic == topics.SCENE and next(number) >= 3:
            picture = must_be(RawImage, message)
            picture.data = bytes(len(picture.data))
        return [message]

    copied(session, tmp_path / "b.mcap", dark_from_the_third_on)
    found = compare(Recording(session), Recording(tmp_path / "b.mcap"))
    assert {topic for topic, each in found.items() if not each.same} == {topics.SCENE}
    assert (found[topics.SCENE].frame_id, found[topics.SCENE].differ) == (3, EXPOSURES - 2)


def test_restored_pictures_come_close_to_the_true_scene(session: Path, sharp: Path) -> None:
    """With the estimated path they gain most of what the true path would give."""
    recording = Recording(sharp)
    true = SCENE.to_intensity(must_be(np.ndarray, recording.true_scene))
    gains, possible = [], []
    for exposure, restored in zip(recording.exposures(), recording.restored(), strict=True):
        assert restored.scene is not None
        assert restored.scene.dtype == np.float32
        assert 0 <= restored.scene.min() <= restored.scene.max() <= 1
        path = truth_of(exposure).path
        shift = np.rint(path.mean(axis=1) / SCENE.pixel_scale).astype(np.intp)
        blurred = blurred_psnr(SCENE, exposure, shift, true)
        best = restore(
            SCENE.to_intensity(must_be(Picture, exposure.scene).pixels),
            motion_psf(path, None, SCENE.kernel, SCENE.pixel_scale),
        )
        gains.append(psnr(restored.scene.astype(float), true) - blurred)
        possible.append(psnr(best.image, true) - blurred)
    assert np.mean(possible) > 9
    assert np.mean(gains) > 0.6 * np.mean(possible)


def test_a_restored_spot_is_light_in_one_place(sharp: Path) -> None:
    """Blurred over a third of the pixels, restored to about slope zero."""
    recording = Recording(sharp)
    shares = np.array([each.spots[0] for each in recording.restored() if each.spots is not None])
    assert len(shares) == EXPOSURES
    assert np.mean(shares[:, 18:22].sum(axis=1)) > 0.9


def test_everything_else_stays_as_it_was(session: Path, sharp: Path) -> None:
    source, target = Recording(session), Recording(sharp)
    new = set(target.counts) - set(source.counts)
    assert new == {"/estimate/moments", topics.RESTORATION, topics.RESTORED_SCENE, topics.RESTORED_SPOTS}
    assert data(target, *source.counts) == data(source)
    assert {k: v for k, v in target.attachments.items() if k in source.attachments} == source.attachments
    made = reestimate(source, ["moments"])["moments"]
    assert first_difference(target.estimates("moments"), made) is None
    for each, estimate in zip(target.restored(), made, strict=True):
        assert (each.frame_id, each.estimator, each.method) == (estimate.frame_id, "moments", "tv")
        assert 0 < each.scene_noise_sd < 0.05
        assert each.reason == ""


def test_the_truth_is_not_read(session: Path, sharp: Path, tmp_path: Path) -> None:
    copied(session, tmp_path / "bare.mcap", lambda topic, message: [message] if topic != topics.TRUTH else [])
    bare = Recording(tmp_path / "bare.mcap")
    assert bare.true_scene is None
    summary = write_deblurred(bare, tmp_path / "again.mcap", estimator="moments")
    assert summary.psnr_restored == []
    wanted = (topics.RESTORATION, topics.RESTORED_SCENE, topics.RESTORED_SPOTS)
    again = data(Recording(tmp_path / "again.mcap"), *wanted)
    assert again == data(Recording(sharp), *wanted)
    assert len(again) == 3 * EXPOSURES


@pytest.mark.slow
def test_recorded_estimates_are_used_and_old_results_replaced(session: Path, sharp: Path, tmp_path: Path) -> None:
    again, direct = tmp_path / "again.mcap", tmp_path / "direct.mcap"
    write_deblurred(Recording(sharp), again, estimator="o1")
    write_deblurred(Recording(session), direct, estimator="o1", workers=2)
    wanted = (topics.RESTORATION, topics.RESTORED_SCENE, topics.RESTORED_SPOTS)
    one, two = (list(Recording(path).restored()) for path in (again, direct))
    for a, b in zip(one, two, strict=True):
        assert (a.frame_id, a.estimator, a.method, a.reason) == (b.frame_id, b.estimator, b.method, b.reason)
        assert b.scene_noise_sd == pytest.approx(a.scene_noise_sd, rel=1e-9)
        # Two threads add up in another order than one, and the solver stops at 1e-4 of what it began with.
        np.testing.assert_allclose(must_be(np.ndarray, a.scene), must_be(np.ndarray, b.scene), atol=1e-4)
    assert Recording(again).counts[wanted[0]] == EXPOSURES
    new = tmp_path / "new.mcap"
    write_reestimated(Recording(sharp), ["o3"], new)
    assert data(Recording(new), *wanted) == data(Recording(sharp), *wanted)
    # Estimated anew, the path is no longer the one that the pictures were restored with.
    write_reestimated(Recording(sharp), ["moments"], new, overwrite=True)
    assert not set(wanted) & set(Recording(new).counts)
    assert Recording(new).true_scene is not None


@pytest.mark.slow
def test_motion_and_its_covariance_are_those_of_the_path(session: Path) -> None:
    """For one output they are the estimate's own; for a mean of spots, what all of its coefficients say together."""
    estimate = reestimate(Recording(session), ["moments"])["moments"][-1]
    path, root = motion(estimate, np.eye(1), psd_root(estimate.coefficient_covariance))
    np.testing.assert_array_equal(path, estimate.path)
    np.testing.assert_allclose(np.linalg.norm(root, axis=1), estimate.path_sd[0], rtol=1e-9)
    exposures = aolink.simulate("sh-4x4", 2)
    estimate = aolink.estimate(exposures, "o3").estimates("o3")[-1]
    mix = np.tile(np.eye(2), (1, 16)) / 16
    path, own = motion(estimate, mix, psd_root(estimate.coefficient_covariance))
    covariance = own @ own.T
    np.testing.assert_allclose(path, estimate.path.reshape(16, 2, -1).mean(axis=0))
    n_steps, rng = path.shape[1], np.random.default_rng(1)
    roots = [np.linalg.cholesky(each + 1e-15 * np.eye(len(each))) for each in estimate.coefficient_covariance]
    basis = estimate.model.basis[:, :, : roots[0].shape[1]]
    drawn = []
    for _ in range(4000):
        moved = np.stack([basis @ (each @ rng.standard_normal(each.shape[1])) for each in roots])
        drawn.append((mix @ moved.reshape(len(estimate.path), n_steps))[:, [0, n_steps - 1]].ravel())
    some = [0, n_steps - 1, n_steps, 2 * n_steps - 1]
    expected = covariance[np.ix_(some, some)]
    np.testing.assert_allclose(np.cov(np.array(drawn).T), expected, atol=0.1 * expected.max())


@pytest.mark.parametrize("name", ["moving-scene", "tip-tilt"])
def test_an_exposure_that_starts_late_ends_in_the_step_after_its_last(name: str) -> None:
    """Its share of that step is in the PSF, with what is known of the end state."""
    rig = load_rig(name)
    late = replace(rig, timing=replace(rig.timing, exposure_offset=0.4))
    exposures = aolink.simulate(late, 3)
    exposure, estimate = exposures[-1], aolink.estimate(exposures, "moments").estimates("moments")[-1]
    assert exposure.start_offset == 0.4
    mix, count = np.eye(rig.n_outputs), estimate.coefficients.shape[1]
    path, root = motion(estimate, mix, psd_root(estimate.coefficient_covariance), after=True)
    rows, n = root.reshape(len(mix), exposure.n_steps + 1, -1), exposure.n_steps
    end = estimate.model.plant.C @ estimate.end_state[0]
    np.testing.assert_allclose(path, np.concatenate([estimate.path, end[:, None]], axis=1))
    np.testing.assert_allclose(np.linalg.norm(rows, axis=2)[:, :n], estimate.path_sd, rtol=1e-6)
    C, E = estimate.model.plant.C, estimate.model.end_rows[:, :count]
    known = C @ E @ estimate.coefficient_covariance[0] @ E.T @ C.T
    np.testing.assert_allclose(rows[:, n] @ rows[:, n].T, known, rtol=1e-6, atol=1e-12)
    pixel = rig.sensor.pixel_width
    (psf,) = estimated_psfs(exposure, estimate, [mix], rig.sensor.kernel, pixel)
    # In tenths of steps, of which the first four are another exposure's.
    fine, fine_root = np.repeat(path, 10, axis=1)[:, 4:-6], np.repeat(rows, 10, axis=1)[:, 4:-6]
    expected = motion_psf_by_root(fine, fine_root.reshape(-1, rows.shape[2]), rig.sensor.kernel, pixel)
    np.testing.assert_allclose(psf.values, expected.values, atol=1e-12)
    np.testing.assert_allclose(psf.sd, expected.sd, atol=1e-12)
    (punctual,) = estimated_psfs(replace(exposure, start_offset=0.0), estimate, [mix], rig.sensor.kernel, pixel)
    assert punctual.values.shape != psf.values.shape or abs(punctual.values - psf.values).max() > 1e-6


def test_spots_are_restored_in_the_windows_that_have_one() -> None:
    """Dark windows stay dark, and spots are counted without them."""
    exposures = aolink.simulate("sh-4x4", 2)
    rig, exposure = exposures.rig, exposures[-1]
    estimate = aolink.estimate(exposures, "o3").estimates("o3")[-1]
    assert isinstance(rig.sensor, SpotSensor)
    sensor = replace(rig.sensor, light=(0.0, 0.0, 1.0) + 13 * (0.0,))
    done = deblur(replace(rig, sensor=sensor), exposure, estimate)
    assert done.spots is not None
    window = np.s_[: sensor.window[0], 2 * sensor.window[1] : 3 * sensor.window[1]]
    path, root = motion(estimate, np.eye(32)[:2], psd_root(estimate.coefficient_covariance))
    psf = motion_psf(path, root @ root.T, sensor.kernel, sensor.pixel_width)
    alone = restore(to_density(sensor, exposure.pixels[window]) * sensor.pixel_size, psf).image
    np.testing.assert_allclose(done.spots[window], np.clip(alone, 0, 1), atol=1e-6)
    assert done.spots.sum() == pytest.approx(done.spots[window].sum())


@pytest.mark.slow
def test_all_spots_of_a_bench_are_restored() -> None:
    """48 of them behind a pupil: each has its light in fewer pixels than it came in."""
    exposures = aolink.simulate("sh-8x8", 2)
    rig, exposure = exposures.rig, exposures[-1]
    sensor = rig.sensor
    assert isinstance(sensor, SpotSensor)
    done = deblur(rig, exposure, aolink.estimate(exposures, "o3").estimates("o3")[-1])
    assert done.reason == ""
    assert done.spots is not None
    came = np.clip(to_density(sensor, exposure.pixels) * sensor.pixel_size, 0, 1)

    def windows(frame: np.ndarray) -> np.ndarray:
        rows, columns = sensor.grid
        cut = frame.reshape(rows, sensor.window[0], columns, sensor.window[1]).swapaxes(1, 2)
        return cut.reshape(rows * columns, -1)

    dark = np.setdiff1d(np.arange(64), sensor.lit)
    assert not windows(done.spots)[dark].any()
    before, after = (windows(frame)[sensor.lit] for frame in (came, done.spots))
    assert (after.max(axis=1) / after.sum(axis=1) > 1.5 * before.max(axis=1) / before.sum(axis=1)).all()


def test_saturated_pixels_are_left_out(session: Path) -> None:
    """As if they had never come, on both sensors."""
    recording = Recording(session)
    exposure, estimate = next(recording.exposures()), recording.estimates("o1")[0]
    assert exposure.scene is not None
    assert RIG.scene is not None
    scene, spot = exposure.scene.pixels.copy(), exposure.pixels.copy()
    scene[40:43, 60:64], spot[0, 20] = RIG.scene.full_scale, RIG.sensor.full_scale
    seen, lit = exposure.scene.mask.copy(), exposure.mask.copy()
    seen[40:43, 60:64] = lit[0, 20] = False
    saturated = replace(exposure, pixels=spot, scene=replace(exposure.scene, pixels=scene))
    absent = replace(saturated, mask=lit, scene=replace(exposure.scene, pixels=scene, mask=seen))
    one, other = (deblur(RIG, each, estimate) for each in (saturated, absent))
    np.testing.assert_array_equal(one.scene, other.scene)
    np.testing.assert_array_equal(one.spots, other.spots)


def test_what_cannot_be_restored_says_why(session: Path, tmp_path: Path) -> None:
    recording = Recording(session)
    exposure = next(recording.exposures())
    estimate = recording.estimates("o1")[0]
    dark: Exposure = replace(exposure, mask=np.zeros_like(exposure.mask), scene=None)
    done = deblur(RIG, dark, estimate)
    assert done.scene is None
    assert done.spots is None
    assert "never came" in done.reason
    with pytest.raises(EstimatorError, match="nonsense"):
        write_deblurred(recording, tmp_path / "x.mcap", estimator="nonsense")
    assert not (tmp_path / "x.mcap").exists()
    with pytest.raises(RecordingError, match="made from"):
        write_deblurred(recording, session, estimator="o1", overwrite=True)
    broken = tmp_path / "broken.mcap"
    copied(session, broken, attachments={topics.TRUE_SCENE_ATTACHMENT: b"nonsense"})
    with pytest.raises(RecordingError, match="scene"):
        _ = Recording(broken).true_scene


@pytest.mark.slow
def test_the_command_deblurs_a_recording(aolink: Run, session: Path, tmp_path: Path) -> None:
    shutil.copy(session, tmp_path / "a.mcap")
    done = aolink("deblur", "a.mcap", "-e", "o1", "--method", "gauss_markov", "-o", "b.mcap")
    assert done.returncode == 0, done.stderr
    assert f"{EXPOSURES} scenes of {EXPOSURES} exposures restored" in done.stdout
    assert "not restored" not in done.stdout
    worse = aolink("deblur", "a.mcap", "-e", "o1", "--method", "predictor", "-o", "worse.mcap")
    assert "predictor leaves more error than the blurred picture has, by its own model" in worse.stdout
    again = aolink("deblur", "a.mcap", "-e", "o1", "-o", "b.mcap")
    assert again.returncode == 5
    assert "exists" in again.stderr


@pytest.mark.parametrize(
    "wrong", [[], ["a.mcap", "--noise-sd", "1"], ["--psf", "p"], ["a.mcap", "--psf", "p", "--path", "l"]]
)
def test_the_command_takes_a_recording_or_a_picture(wrong: list[str]) -> None:
    refused = CliRunner().invoke(app, ["deblur", *wrong, "-o", "c.mcap"])
    assert refused.exit_code == 2
    assert "--psf" in refused.stderr


def test_a_method_that_does_not_exist(session: Path, tmp_path: Path) -> None:
    refused = CliRunner().invoke(app, ["deblur", str(session), "-o", str(tmp_path / "c.mcap"), "--method", "best"])
    assert isinstance(refused.exception, RestorationError)
    assert "'best'" in str(refused.exception)


@pytest.mark.rare
def test_the_demo_from_a_rig_file_with_a_picture_and_slopes_beside_it(aolink: Run, tmp_path: Path) -> None:
    """What a rig file names is relative to it, wherever the demo's folder is."""
    folder = tmp_path / "mine"
    folder.mkdir()
    rows = np.random.default_rng(2).random((300, 300))
    np.save(folder / "mine.npy", rows)
    np.save(folder / "slopes.npy", 0.3 * np.sin(np.arange(400) / 30)[:, None])
    text = RIG.toml.replace("moving-scene.png", "mine.npy").replace("picture_pixels = 4", "picture_pixels = 2")
    (folder / "my.toml").write_text(text + '\n[disturbance]\nrecorded = "slopes.npy"\n')
    done = aolink("demo", "--rig", "mine/my.toml", "--exposures", "4", "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    (made,) = (tmp_path / "out").glob("demo-*")
    assert "; the scene goes from " in done.stdout
    assert (made / "rig.toml").read_text() == (folder / "my.toml").read_text()
    shutil.rmtree(folder)  # the recording needs nothing but itself
    recording = Recording(made / "deblurred.mcap")
    assert [e.frame_id for e in recording.exposures()] == [each.frame_id for each in recording.restored()]
    assert {"/scene/image", "/restored/image", "/restored/spot", "/scene/true"} <= set(read_rrd(made / "session.rrd"))


def test_rerun_shows_blurred_restored_and_true(sharp: Path, tmp_path: Path) -> None:
    recording = Recording(sharp)
    path = save_rrd(recording, tmp_path / "a.rrd")
    entities = read_rrd(path)
    assert absent_from_views(path) == []
    sensor = recording.rig.scene
    assert sensor is not None
    for k, (exposure, restored) in enumerate(zip(recording.exposures(), recording.restored(), strict=True)):
        assert exposure.scene is not None
        assert restored.scene is not None
        assert entities["/scene/image"]["frame"][k] == exposure.frame_id
        seen = np.rint(255 * np.clip(sensor.to_intensity(exposure.scene.pixels), 0, 1)).astype(np.uint8)
        shown = np.array(entities["/scene/image"]["Image:buffer"][-EXPOSURES:][k][0], dtype=np.uint8)
        np.testing.assert_array_equal(shown.reshape(128, 128, 3), np.repeat(seen[..., None], 3, axis=2))
        shown = np.array(entities["/restored/image"]["Image:buffer"][-EXPOSURES:][k][0], dtype=np.uint8)
        np.testing.assert_array_equal(shown.reshape(128, 128), np.rint(255 * restored.scene).astype(np.uint8))
    assert len(entities["/restored/spot"]["frame"]) == EXPOSURES


@pytest.mark.slow
def test_a_live_view_shows_the_same(sharp: Path, tmp_path: Path) -> None:
    from aolink.session.replay import replay

    recording = Recording(sharp)
    with drawn(str(tmp_path / "live.rrd"), recording.rig, ["o1", "moments"], recording.true_scene) as live:
        for _ in replay(recording, ["o1", "moments"], sinks=[live]):
            pass
    ours, theirs = read_rrd(tmp_path / "live.rrd"), read_rrd(save_rrd(recording, tmp_path / "file.rrd"))
    for entity in ("/scene/image", "/restored/image", "/restored/spot", "/scene/true"):
        shown = [[buffer for buffer in each[entity]["Image:buffer"] if buffer] for each in (ours, theirs)]
        assert shown[0] == shown[1], entity
        assert shown[0]


def test_the_true_scene_is_numpy_s_own_format(session: Path) -> None:
    counts = np.load(io.BytesIO(Recording(session).attachments["true_scene.npy"]), allow_pickle=False)
    assert (counts.shape, counts.dtype) == ((128, 128), np.uint16)
