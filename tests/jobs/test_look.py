"""What `aolink look` says of films whose motion is known."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import ImportingError
from aolink.films.film import array_film
from aolink.importing.frames import FilmSettings
from aolink.jobs.look import look, paragraph
from aolink.recording.reader import Recording
from aolink.rig import load_rig, parse_rig
from tests.importing.test_blurred import shaken

RATE, EXPOSURE = 50.0, 0.67 / 37.3
"""With .67 cycles in an exposure and .746 from frame to frame: 37.3 Hz at 50 frames a second."""
Run = Callable[..., subprocess.CompletedProcess[str]]


@pytest.mark.slow
def test_a_vibration_beyond_half_the_frame_rate_is_found_in_the_blur() -> None:
    looked = look(shaken(angle=0.0), FilmSettings(exposure_s=EXPOSURE), "shaken")
    x, y = looked.directions
    assert looked.blurred
    assert not y.moves
    assert x.found is not None
    (hz,) = (each for each in x.found.parameters if each.name == "frequency_hz")
    assert hz.holds(37.3)
    assert not hz.holds(12.7)
    assert looked.sd == pytest.approx(1.8, rel=0.05)
    # The path inside an exposure, in pixels of the window, against the truth.
    assert x.path is not None
    phase = 2 * np.pi * (0.746 * np.arange(60)[:, None] + 0.67 * (np.arange(x.path.shape[-1]) + 0.5) / x.path.shape[-1])
    truth = 30.3 + 3.2 * np.sin(phase) - looked.spots.corners[0, 0]
    error = float(np.sqrt(np.mean((x.path[10:, 0] - truth[10:]) ** 2)))
    assert error < 3 * x.known
    assert error < 0.3
    assert x.held == pytest.approx(float(truth.std(axis=1).mean()), rel=0.1)
    parse_rig(looked.text)


@pytest.mark.slow
def test_sharp_frames_leave_aliases_and_say_so() -> None:
    looked = look(shaken(cycles=0.02, angle=0.0), FilmSettings(exposure_s=0.02 / 37.3), "sharp")
    assert not looked.blurred
    assert "cannot tell what happens inside an exposure" in " ".join(looked.doubts)
    found = looked.directions[0].found
    assert found is not None
    hz = next(each for each in found.parameters if each.name.endswith("frequency_hz"))
    assert hz.holds(12.7)
    assert hz.holds(37.3)
    assert "which these frames cannot tell from it" in paragraph(looked)


@pytest.mark.slow
def test_a_film_without_motion_is_said_to_have_none() -> None:
    looked = look(shaken(amplitude=0.0), FilmSettings(exposure_s=EXPOSURE), "still")
    assert not looked.moves
    assert paragraph(looked).count("nothing moves by more than") == 2


@pytest.mark.parametrize(
    ("rate", "exposure", "named"), [(None, None, "--rate HZ and --exposure S"), (50.0, None, "give --exposure S")]
)
def test_what_the_film_does_not_say_is_asked_for(rate: float | None, exposure: float | None, named: str) -> None:
    film = array_film(np.stack(list(shaken().frames())), "film")
    with pytest.raises(ImportingError, match=named):
        look(film, FilmSettings(rate_hz=rate, exposure_s=exposure), "film")


@pytest.mark.slow
def test_the_command_writes_a_rig_file_a_recording_and_a_page(aolink: Run, tmp_path: Path) -> None:
    np.savez(
        tmp_path / "film.npz", frames=np.stack(list(shaken(angle=0.0).frames())), rate_hz=RATE, exposure_s=EXPOSURE
    )
    done = aolink("look", "film.npz", "--quick", "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert any(low <= 37.3 <= high for low, high in said["directions"]["x"]["parameters"]["frequency_hz"]["set"])
    folder = tmp_path / "film-look"
    recording = Recording(folder / "film.mcap")
    assert recording.estimators == ["moments"]
    assert len(recording) == 60
    assert load_rig(str(folder / "rig.toml")).sensor.spots == 1
    page = (folder / "page.html").read_text()
    assert page.count("<figure>") == 4
    assert said["text"][:40] in page
    assert sorted(each.name for each in folder.iterdir()) == ["film.mcap", "page.html", "rig.toml"]
    again = aolink("look", "film.npz", "--quick")
    assert again.returncode != 0
    assert "exists already" in again.stderr
