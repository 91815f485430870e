"""What `aolink look` says of films whose motion is known: spots, and parts of pictures of anything."""

from __future__ import annotations

import asyncio
import json
import subprocess
import wave
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from aolink.errors import ImportingError
from aolink.films.film import array_film
from aolink.identification.vibration import PathMoments
from aolink.importing.frames import FilmSettings
from aolink.jobs.look import GRADES, Looked, look, vibrations
from aolink.jobs.look_page import write_page
from aolink.jobs.look_words import as_json, paragraph
from aolink.optics.sensor import RegionSensor
from aolink.recording.reader import Recording
from aolink.recording.reestimate import reestimate
from aolink.rig import load_rig, parse_rig
from tests.jobs.test_look_spots import shaken
from tests.needs import missing, needed
from tests.viewing import browser

RATE, EXPOSURE = 50.0, 0.67 / 37.3
"""With .67 cycles in an exposure and .746 from frame to frame: 37.3 Hz at 50 frames a second."""
Run = Callable[..., subprocess.CompletedProcess[str]]


def holds(looked: Looked, hz: float, line: int = 0) -> bool:
    return any(part.low - 0.02 <= hz <= part.high + 0.02 for part in looked.found.sets[line])


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_a_vibration_beyond_half_the_frame_rate_is_found_in_the_blur(angle: float) -> None:
    looked = look(shaken(angle=angle), FilmSettings(exposure_s=EXPOSURE), "shaken")
    assert GRADES[looked.grade] == "believe it"
    (line,) = looked.lines
    assert holds(looked, 37.3)
    assert not holds(looked, 12.7)
    assert line.ellipse[0] == pytest.approx(3.2, rel=0.06)
    assert line.ellipse[2] == pytest.approx(angle, abs=0.03)
    assert looked.sd == pytest.approx(1.8, rel=0.05)
    assert looked.plain_hz == pytest.approx(12.7, abs=0.1)
    rig = parse_rig(looked.text)
    assert rig.sensor.spots == 1
    # The path inside the exposures, against the truth.
    inside = (np.arange(16) + 0.5) / 16
    phase = 2 * np.pi * (0.746 * np.arange(60)[:, None] + 0.67 * inside)
    truth = 3.2 * np.sin(phase)[..., None] * (np.cos(angle), np.sin(angle))
    found = looked.path(looked.seen.times_s[:, None] + (inside - 0.5) * EXPOSURE)
    assert np.abs(found - truth).max() < 0.4
    assert json.loads(json.dumps(as_json(looked)))["lines"][0]["harmonic"] == 1


@pytest.mark.slow
def test_sharp_frames_leave_aliases_and_say_so() -> None:
    looked = look(shaken(cycles=0.02, angle=0.0), FilmSettings(exposure_s=0.02 / 37.3), "sharp")
    assert GRADES[looked.grade] == "believe the frequency, not the path"
    assert holds(looked, 12.7)
    assert holds(looked, 37.3)
    assert "alias" in looked.because


@pytest.mark.slow
def test_a_film_without_motion_has_no_answer() -> None:
    looked = look(shaken(amplitude=0.0), FilmSettings(exposure_s=EXPOSURE), "still")
    assert not looked.moves
    assert GRADES[looked.grade] == "no answer"
    assert "multiple of 50 Hz" in paragraph(looked)
    assert "vibrates at 3" not in paragraph(looked)


@pytest.mark.slow
def test_a_drift_is_no_vibration() -> None:
    drift = shaken(amplitude=2.0, cycles=0.0, step=0.25 / 60)
    looked = look(drift, FilmSettings(rate_hz=RATE, exposure_s=EXPOSURE), "drift")
    assert looked.moves
    assert not looked.lines


@pytest.mark.slow
@pytest.mark.parametrize("apart", [False, True])
def test_spots_with_one_motion_are_told_from_those_with_their_own(apart: bool) -> None:
    """A hot pixel in a window costs no exposure."""
    middles = ((14.0, 24.0), (48.0, 24.0))
    film = shaken(middles=middles, amplitude=2.0, angle=0.0, phases=(0.0, 1.9) if apart else (0.0, 0.0))
    frames = np.stack(list(film.frames()))
    frames[:, 24, 52] = 3000
    looked = look(array_film(frames, "two", rate_hz=RATE), FilmSettings(exposure_s=EXPOSURE), "two")
    assert looked.together is not apart
    rig = parse_rig(looked.text)
    assert (rig.plant.axes, rig.n_outputs) == ((2, 4) if apart else (1, 4))
    assert holds(looked, 37.3)


@pytest.mark.slow
def test_saturated_spots_have_no_answer() -> None:
    frames = np.minimum(np.stack(list(shaken(cycles=0.02).frames())) // 6, 255).astype(np.uint8)
    settings = FilmSettings(rate_hz=RATE, exposure_s=0.02 / 37.3)
    looked = look(array_film(frames, "bright"), settings, "bright")
    assert GRADES[looked.grade] == "no answer"
    assert "saturated" in looked.because


def scene(hz: float, amplitude: float, *, edge: bool = False, camera: bool = False, count: int = 80) -> Any:
    """Frames (count, rows, columns) of a texture, of which a part, or all, vibrates along 20 degrees at 25 frames/s,
    exposed throughout, and their direction."""
    rng = np.random.default_rng(8)
    angle, shape = np.radians(20.0), (96, 128)
    y, x = np.indices(shape, dtype=np.float64)
    if edge:
        texture = 90 / (1 + np.exp(-(x - 64.0) / 1.2))
    else:
        texture = 60 * ndimage.gaussian_filter(rng.normal(size=shape), 2.0) * 4
    part = np.ones(shape) if camera else ndimage.gaussian_filter(((abs(x - 64) < 26) & (abs(y - 48) < 26)) * 1.0, 1.0)
    still = 60 * ndimage.gaussian_filter(rng.normal(size=shape), 2.0) * 4
    frames = np.zeros((count, *shape))
    for k in range(count):
        for t in (k + (np.arange(24) + 0.5) / 24) / 25:
            moved = amplitude * np.sin(2 * np.pi * hz * t)
            shift = (moved * np.sin(angle), moved * np.cos(angle))
            frames[k] += ndimage.shift(texture, shift, order=3, mode="nearest") * part + still * (1 - part)
    frames = 120 + frames / 24 + rng.normal(0, 1.0, frames.shape)
    return np.clip(np.rint(frames), 0, 255).astype(np.uint8)


@pytest.mark.slow
def test_a_part_of_a_picture_of_anything_is_measured_by_its_texture() -> None:
    looked = look(array_film(scene(32.0, 1.2), "plate"), FilmSettings(rate_hz=25.0, exposure_s=0.04), "plate")
    assert GRADES[looked.grade] == "believe it"
    (line,) = looked.lines
    assert line.hz == pytest.approx(32.0, abs=0.02)
    assert line.ellipse[0] == pytest.approx(1.2, rel=0.1)
    assert np.degrees(line.ellipse[2]) == pytest.approx(20, abs=3)
    assert not looked.camera
    assert parse_rig(looked.text).sensor.shape == (48, 48)
    settings = FilmSettings(rate_hz=25.0, exposure_s=0.04)
    chosen = look(array_film(scene(32.0, 1.2), "plate"), settings, "plate", at=(64, 48), size=32)
    assert chosen.lines[0].hz == pytest.approx(32.0, abs=0.02)


@pytest.mark.slow
def test_an_edge_says_what_it_does_not_show_and_a_camera_that_moves_is_named() -> None:
    settings = FilmSettings(rate_hz=25.0, exposure_s=0.04)
    edge = look(array_film(scene(32.0, 1.2, edge=True, camera=True), "edge"), settings, "edge", at=(64, 48))
    assert edge.lines[0].hz == pytest.approx(32.0, abs=0.05)
    assert "across itself" in paragraph(edge)
    camera = look(array_film(scene(32.0, 1.2, camera=True), "shaken"), settings, "shaken")
    assert camera.camera
    assert any("camera" in each for each in camera.doubts)


@pytest.mark.parametrize(
    ("rate", "exposure", "named"), [(None, None, "--rate HZ and --exposure S"), (50.0, None, "give --exposure S")]
)
def test_what_the_film_does_not_say_is_asked_for(rate: float | None, exposure: float | None, named: str) -> None:
    film = array_film(np.stack(list(shaken().frames())), "film")
    with pytest.raises(ImportingError, match=named):
        look(film, FilmSettings(rate_hz=rate, exposure_s=exposure), "film")


def test_a_part_beyond_the_picture_is_refused() -> None:
    film = array_film(np.zeros((30, 40, 60), np.uint8), "film")
    with pytest.raises(ImportingError, match="edge"):
        look(film, FilmSettings(rate_hz=25.0, exposure_s=0.04), "film", at=(3, 3), size=20)


@pytest.mark.slow
def test_the_command_writes_a_rig_file_a_recording_a_page_the_path_and_a_tone(aolink: Run, tmp_path: Path) -> None:
    np.savez(tmp_path / "film.npz", frames=np.stack(list(shaken().frames())), rate_hz=RATE, exposure_s=EXPOSURE)
    done = aolink("look", "film.npz", "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["grade"] == "believe it"
    ((low, high),) = said["lines"][0]["set"]
    assert low <= 37.3 <= high
    folder = tmp_path / "film-look"
    recording = Recording(folder / "film.mcap")
    assert recording.estimators == ["profile"]
    assert len(recording) == 60
    assert load_rig(str(folder / "rig.toml")).sensor.spots == 1
    page = (folder / "page.html").read_text()
    assert page.count("<figure>") == 4
    assert said["text"][:40] in page
    assert len(page) < 2e6
    assert {"film.mcap", "page.html", "path.csv", "rig.toml", "tone.wav"} == {each.name for each in folder.iterdir()}
    path = np.loadtxt(folder / "path.csv", delimiter=",", skiprows=1)
    assert path.shape == (60 * 16, 4)
    with wave.open(str(folder / "tone.wav")) as tone:
        assert (tone.getframerate(), tone.getsampwidth(), tone.getnframes()) == (44_100, 2, 88_200)
        sound = np.frombuffer(tone.readframes(88_200), "<i2")
    assert np.argmax(np.abs(np.fft.rfft(sound))) / 2 == pytest.approx(37.3, abs=0.5)
    again = aolink("look", "film.npz")
    assert again.returncode != 0
    assert "exists already" in again.stderr
    assert aolink("look", "film.npz", "--exposure", "1", "-o", "none").returncode != 0
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_the_page_shows_all_its_pictures_in_a_browser_without_network(tmp_path: Path) -> None:
    if browser.program() is None:
        missing("chromium", FileNotFoundError("chromium: apt-get install chromium"))
    looked = look(array_film(scene(32.0, 1.2), "plate"), FilmSettings(rate_hz=25.0, exposure_s=0.04), "plate")
    write_page(looked, page := tmp_path / "page.html", "plate.npy", [], overwrite=False)
    assert page.stat().st_size < 2_000_000

    async def seen() -> tuple[list[int], str, list[str]]:
        async with browser.browser() as tab:
            await tab.open(page.as_uri())
            widths = await tab.run("[...document.images].map(each => each.complete ? each.naturalWidth : 0)")
            return widths, await tab.run("document.body.innerText"), tab.errors

    widths, text, errors = asyncio.run(seen())
    assert len(widths) >= 3
    assert all(width > 100 for width in widths)
    assert "Believe it" in text
    assert "32.0" in text
    assert not errors
    assert "://" not in page.read_text().replace("http://www.w3.org", "")


@pytest.mark.slow
def test_without_matplotlib_there_is_an_answer_and_no_page(tmp_path: Path) -> None:
    import sys

    np.savez(
        tmp_path / "film.npz", frames=np.stack(list(shaken(amplitude=0.0).frames())), rate_hz=RATE, exposure_s=EXPOSURE
    )
    hidden = "import sys; sys.modules['matplotlib'] = None; from aolink.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", hidden, "look", "film.npz"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "No answer" in done.stdout
    assert "no page with pictures" in done.stdout
    assert sorted(each.name for each in (tmp_path / "film-look").iterdir()) == ["film.mcap", "rig.toml"]


def fork(summed: int, opened: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Frames of a real film at 1000 frames/s averaged, and themselves."""
    av = needed("av")
    with av.open(str(Path(__file__).parents[1] / "data" / "fork_32_hz.mp4")) as film:
        frames = np.stack([each.to_ndarray(format="gray")[60:140, 310:406] for each in film.decode(video=0)])
    count = len(frames) // summed
    frames = frames[: count * summed]
    slow = frames.reshape(count, summed, *frames.shape[1:])[:, :opened].mean(axis=1)
    return np.rint(slow).astype(np.uint8), frames


def single_frames(recording: Recording, frames: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Where the region of a recording is in each frame, pixels, (frames, 2)."""
    sensor = recording.rig.sensor
    assert isinstance(sensor, RegionSensor)
    # Where the region is: where the mean of the frames is most like its reference.
    mean, side = frames.mean(axis=0), len(sensor.at_rest)
    places = [(y, x) for y in range(mean.shape[0] - side + 1) for x in range(mean.shape[1] - side + 1)]
    like = [np.corrcoef(mean[y : y + side, x : x + side].ravel(), sensor.at_rest.ravel())[0, 1] for y, x in places]
    y, x = places[int(np.argmax(like))]
    cut = frames[:, y : y + side, x : x + side] * (256 / sensor.counts_per_density)
    seen = [sensor.texture.seen(each) for each in cut]
    return np.array([each.mean @ sensor.texture.axes for each in seen if each])


@pytest.mark.slow
def test_the_path_of_a_fork_is_that_of_its_single_frames(aolink: Run, tmp_path: Path) -> None:
    """What `look` records of a real film of 25 frames/s, against the frames at 1000 frames/s that it was made of."""
    slow, frames = fork(40, 40)
    np.savez(tmp_path / "fork.npz", frames=slow, rate_hz=25.0, exposure_s=0.04)
    done = aolink("look", "fork.npz", "-o", "fork")
    assert done.returncode == 0, done.stderr
    recording = Recording(tmp_path / "fork" / "film.mcap")
    truth = single_frames(recording, frames).reshape(-1, 40, 2)
    at = (np.arange(40) + 0.5) / 40 * recording.rig.timing.exposure_steps - 0.5
    for name in ("o3", "moments"):
        made = reestimate(recording, [name])[name]
        steps = np.arange(made[0].path.shape[1])
        paths = np.array([[np.interp(at, steps, row) for row in each.path] for each in made]).swapaxes(1, 2)
        error = paths[5:] - truth[5:]
        assert np.sqrt((error**2).mean(axis=(0, 1))).max() < 0.1
        assert np.mean([each.nis for each in made]) == pytest.approx(5.0, abs=1.5)
    assert truth[..., 0].std() > 0.9
    for command in (
        ("deblur", "fork/film.mcap", "-o", "sharp.mcap"),
        ("view", "sharp.mcap", "-o", "sharp.rrd"),
        ("report", "sharp.mcap", "-o", "sharp.html"),
        ("import", "fork.npz", "--rig", "fork/rig.toml", "--at", "51.5,40.5", "-o", "again.mcap"),
        ("estimate", "again.mcap", "-e", "o3", "-o", "estimated.mcap"),
    ):
        done = aolink(*command)
        assert done.returncode == 0, done.stderr
    restored = aolink("info", "sharp.mcap")
    assert "83" in restored.stdout


@pytest.mark.slow
@pytest.mark.parametrize(("summed", "opened"), [(40, 40), (40, 20), (30, 30)])
def test_a_fork_of_32_hz_is_found_in_films_of_slow_cameras(summed: int, opened: int) -> None:
    """25 exposures a second see 32 Hz as 7."""
    slow, _ = fork(summed, opened)
    settings = FilmSettings(rate_hz=1000 / summed, exposure_s=opened / 1000)
    looked = look(array_film(slow, "fork"), settings, "fork")
    assert looked.grade < 2
    assert looked.lines[0].hz == pytest.approx(31.97, abs=0.05)
    assert looked.lines[0].ellipse[0] == pytest.approx(1.5, abs=0.15)


def line_film(hz: float = 437.0, amplitude: float = 0.6) -> Any:
    """Frames of a line of light, and the time from row to row: 192 rows read in 19.2 ms, 30 frames/s of 1 ms."""
    rng, rows, row_time = np.random.default_rng(2), np.arange(192)[:, None], 1e-4
    inside = (np.arange(20) + 0.5) / 20 * 1e-3
    frames = np.empty((48, 192, 64))
    for k, frame in enumerate(frames):
        t = k / 30 + rows * row_time + inside
        place = 30 + 0.02 * rows + amplitude * np.sin(2 * np.pi * hz * t)
        shown = np.exp(-((np.arange(64) - place[..., None]) ** 2) / (2 * 1.5**2)).mean(axis=1)
        frame[:] = 20 + 160 * (shown + 0.05 * rng.normal(size=shown.shape))
    return np.clip(np.rint(frames), 0, 255).astype(np.uint8)


@pytest.mark.slow
def test_rows_that_are_exposed_one_after_the_other_are_a_clock(aolink: Run, tmp_path: Path) -> None:
    """437 Hz is an alias of 13 Hz for the frames alone."""
    np.save(tmp_path / "line.npy", line_film())
    done = aolink("look", "line.npy", "--rate", "30", "--exposure", "1ms", "--film", "row_time=100us", "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["grade"] == "believe it"
    (line,) = said["lines"]
    assert line["hz"] == pytest.approx(437.0, rel=1e-4)
    ((low, high),) = line["set"]
    assert low < 437 < high
    assert line["half_axes_pixels"][0] == pytest.approx(0.6, rel=0.02)
    assert said["plain_hz"] == pytest.approx(13.0, abs=0.1)
    assert "frame rate alone" in said["text"]
    assert said["rows"] == [0, 192]
    folder = tmp_path / "line-look"
    assert {each.name for each in folder.iterdir()} == {"page.html", "path.csv", "tone.wav"}
    assert (folder / "page.html").read_text().count("<figure>") == 4
    path = np.loadtxt(folder / "path.csv", delimiter=",", skiprows=1)
    true = 0.6 * np.sin(2 * np.pi * 437 * path[:, 0])
    assert np.abs(path[:, 1] - path[:, 1].mean() - true).max() < 0.05


@pytest.mark.slow
def test_without_the_row_time_a_frequency_goes_with_one(aolink: Run, tmp_path: Path) -> None:
    np.save(tmp_path / "line.npy", line_film())
    options = ("--rate", "30", "--exposure", "1ms", "--film", "row_time=unknown", "--json")
    done = aolink("look", "line.npy", *options)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["grade"] == "believe the frequency, not the path"
    assert "row time" in said["because"]
    ((row_time,),) = [[each] for hz, each in said["pairs"] if abs(hz - 437) < 1]
    assert row_time == pytest.approx(1e-4, rel=2e-3)
    assert any(low < 437 < high for low, high in said["lines"][0]["set"])
    refused = aolink("import", "line.npy", "-o", "line.mcap", "--rig", "no.toml", *options[:-1])
    assert "row_time" in refused.stderr


@pytest.mark.slow
def test_a_tone_at_a_multiple_of_the_frame_rate_is_told_from_no_bent_line() -> None:
    settings = FilmSettings(rate_hz=30.0, exposure_s=1e-3, row_time_s=1e-4)
    looked = look(array_film(line_film(600.0), "line"), settings, "line")
    assert looked.lines[0].hz == pytest.approx(600.0, rel=1e-4)
    assert GRADES[looked.grade] == "believe the frequency, not the path"
    assert "bent" in looked.because
    still = look(array_film(line_film(600.0, 0.0), "line"), settings, "line")
    assert GRADES[still.grade] == "no answer"
    assert "1000 Hz" in still.because


def by_hand(hz: float, amplitude: float, *, shakes: bool = False, count: int = 80) -> Any:
    """Frames of a texture by a camera in the hand, which wanders by 15 pixels; a part of it, or the camera, vibrates
    along 20 degrees at 25 frames/s, exposed throughout."""
    rng, fine, pad, shape = np.random.default_rng(3), 8, 30, (150, 190)
    big = (shape[0] + 2 * pad, shape[1] + 2 * pad)
    target, ground = (ndimage.spline_filter(240 * ndimage.gaussian_filter(rng.normal(size=big), 2.0)) for _ in range(2))
    y, x = np.indices(big)
    part = ndimage.gaussian_filter(((abs(x - pad - 100) < 26) & (abs(y - pad - 80) < 26)) * 1.0, 1.0)
    hand = ndimage.gaussian_filter1d(rng.normal(size=(count * fine, 2)).cumsum(axis=0), 3.0 * fine, axis=0)
    hand = 15 * (hand - hand[0]) / np.abs(hand - hand[0]).max()
    t = (np.arange(count * fine) + 0.5) / fine / 25
    swing = amplitude * np.sin(2 * np.pi * hz * t)[:, None] * np.sin(np.radians([20.0, 110.0]))

    def moved(picture: Any, by: Any, order: Any = 3) -> Any:
        return ndimage.shift(picture, by, order=order, mode="nearest", prefilter=False)

    frames = np.zeros((count, *shape))
    for k, (camera, own) in enumerate(zip(hand, swing, strict=True)):
        seen = camera + own if shakes else camera
        share = moved(part, camera + own, 1)
        shown = moved(target, camera + own) * share + moved(ground, seen) * (1 - share)
        frames[k // fine] += shown[pad:-pad, pad:-pad] / fine
    return np.clip(np.rint(120 + frames + rng.normal(0, 1.0, frames.shape)), 0, 255).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize("shakes", [False, True])
def test_what_travels_is_followed_and_a_camera_in_the_hand_is_told_from_the_target(shakes: bool) -> None:
    settings = FilmSettings(rate_hz=25.0, exposure_s=0.04)
    looked = look(array_film(by_hand(32.0, 1.2, shakes=shakes), "hand"), settings, "hand")
    assert looked.grade < 2
    assert holds(looked, 32.0)
    assert looked.camera is shakes
    assert looked.lines[0].ellipse[0] == pytest.approx(1.2, rel=0.1 if looked.grade == 0 else 0.3)
    still = look(array_film(by_hand(32.0, 0.0), "hand"), settings, "hand")
    assert still.camera
    assert still.grade == 2


def wandering(seed: int, amplitude: float, count: int = 150, fine: int = 16) -> PathMoments:
    """A wandering of 20 pixels and a vibration of 32 Hz, 25 frames/s exposed throughout."""
    rng = np.random.default_rng(seed)
    walk = ndimage.gaussian_filter1d(rng.normal(size=(count * fine, 2)).cumsum(axis=0), 3.0 * fine, axis=0)
    walk = 20 * (walk - walk[0]) / np.abs(walk - walk[0]).max()
    t = (np.arange(count * fine) + 0.5) / fine / 25
    path = walk + amplitude * np.sin(2 * np.pi * 32 * t)[:, None] * (0.94, 0.34)
    inside = path.reshape(count, fine, 2)
    mean = inside.mean(axis=1)
    C = np.einsum("kfi,kfj->kij", inside - mean[:, None], inside - mean[:, None]) / fine
    spread = np.stack([C[:, 0, 0], C[:, 0, 1], C[:, 1, 1]], axis=1)
    return PathMoments(
        times_s=(np.arange(count) + 0.5) / 25, exposure_s=0.04, rate_hz=25.0,
        mean=(mean + 0.01 * rng.normal(size=mean.shape))[:, None], mean_variance=np.full((count, 1, 2), 1e-4),
        spread=(spread + 0.02 * rng.normal(size=spread.shape))[:, None], spread_variance=np.full((count, 1, 3), 4e-4),
        constant_sd=np.ones((1, 3)), axes=np.eye(2)[None],
    )  # fmt: skip


@pytest.mark.slow
def test_a_vibration_beside_a_wandering_is_found_and_none_in_that_alone() -> None:
    for seed in range(100, 108):
        found = vibrations(wandering(seed, 1.2), 2)
        assert any(abs(part.best - 32) < 0.1 for part in found.sets[0]), seed
        assert not vibrations(wandering(seed, 0.0), 2).lines


@pytest.mark.slow
def test_of_a_region_with_two_motions_the_quarter_that_moves_is_described() -> None:
    """Half of it is still: as one motion, blur and means would contradict each other."""
    settings = FilmSettings(rate_hz=25.0, exposure_s=0.04)
    looked = look(array_film(scene(32.0, 1.2), "plate"), settings, "plate", at=(88, 48))
    assert [(each.x, each.y, each.columns) for each in looked.regions] == [(68, 28, 20)]
    assert any("quarter" in each for each in looked.doubts)
    assert looked.lines[0].hz == pytest.approx(32.0, abs=0.02)
    assert looked.lines[0].ellipse[0] == pytest.approx(1.2, rel=0.1)


@pytest.mark.slow
def test_light_that_flickers_is_said_and_taken_out() -> None:
    lamp = 1 + 0.1 * np.sin(2 * np.pi * 100.3 * np.arange(80) / 25)
    frames = np.clip(np.rint(scene(32.0, 1.2) * lamp[:, None, None] * 0.8), 0, 255).astype(np.uint8)
    looked = look(array_film(frames, "lamp"), FilmSettings(rate_hz=25.0, exposure_s=0.04), "lamp")
    assert holds(looked, 32.0)
    assert any("flickers" in each for each in looked.doubts)
