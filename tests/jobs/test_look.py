"""What `aolink look` says of films whose motion is known."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import ImportingError
from aolink.estimation import Scorer
from aolink.estimation.verdict import Fit, Verdict
from aolink.films.film import array_film
from aolink.identification import readings
from aolink.identification.models import Process, ProcessSum
from aolink.importing.frames import FilmSettings, film_times
from aolink.jobs.look import heeding, line_left, look
from aolink.jobs.look_scene import Scene
from aolink.jobs.look_spots import find_spots
from aolink.jobs.look_words import paragraph
from aolink.recording.reader import Recording
from aolink.rig import load_rig, parse_rig
from tests.jobs.test_look_spots import FRAMES, shaken

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
    # What is explained is not searched again.
    assert not x.unexplained
    film = shaken(angle=0.0)
    assert look(film, FilmSettings(exposure_s=EXPOSURE), "shaken", thorough=True, before=looked).directions[0] is x


@pytest.mark.slow
def test_sharp_frames_leave_aliases_and_say_so() -> None:
    looked = look(shaken(cycles=0.02, angle=0.0), FilmSettings(exposure_s=0.02 / 37.3), "sharp")
    assert not looked.blurred
    assert "cannot tell what happens inside an exposure" in looked.unknown
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
    # What the whole recording says of the rig file is a doubt, where it refuses it.
    some = replace(Scorer().result(), estimated=60)
    assert heeding(looked, replace(some, gated=6)).doubts == looked.doubts
    (*_, doubt) = heeding(looked, replace(some, gated=7)).doubts
    assert "7 of 60 frames do not fit the rig file" in doubt
    wrong = Verdict(fit=Fit.DOES_NOT_FIT, kind="pixels", widening=1.4)
    assert heeding(looked, replace(some, verdict=wrong)).doubts == looked.doubts
    (*_, doubt) = heeding(looked, replace(some, verdict=replace(wrong, widening=1.6))).doubts
    assert "give its width with --kernel" in doubt
    assert "aolink calibrate" not in doubt


@pytest.mark.slow
def test_a_drift_is_no_vibration() -> None:
    drift = np.stack([frame for k, frame in enumerate(shaken(amplitude=2.0, cycles=0.0, step=0.25 / FRAMES).frames())])
    looked = look(array_film(drift, "drift"), FilmSettings(rate_hz=RATE, exposure_s=EXPOSURE), "drift")
    (x, _) = looked.directions
    assert x.moves
    assert x.found is not None
    assert "resonance" not in x.found.model.name


@pytest.mark.slow
def test_a_line_that_a_model_leaves_is_found_and_one_that_it_has_is_not() -> None:
    film, settings = shaken(cycles=0.02, angle=0.0), FilmSettings(rate_hz=RATE, exposure_s=0.02 / 37.3)
    spots = find_spots(film, settings, FRAMES)
    seen = [readings(*Scene(film, spots, film_times(film, settings), RATE, 0.02 / 37.3, "x").along(0, 0, spots.sd))]
    size = float(np.std(seen[0].mean))
    walk = ProcessSum((Process("ornstein-uhlenbeck", (0.02, size)),))
    left = line_left(seen, walk, RATE)
    assert left == pytest.approx(RATE - 37.3, abs=0.5)
    swing = ProcessSum((Process("resonance", (RATE - 37.3, 1e-3, size)),))
    assert line_left(seen, swing, RATE) is None


@pytest.mark.parametrize(
    ("rate", "exposure", "named"), [(None, None, "--rate HZ and --exposure S"), (50.0, None, "give --exposure S")]
)
def test_what_the_film_does_not_say_is_asked_for(rate: float | None, exposure: float | None, named: str) -> None:
    film = array_film(np.stack(list(shaken().frames())), "film")
    with pytest.raises(ImportingError, match=named):
        look(film, FilmSettings(rate_hz=rate, exposure_s=exposure), "film")


@pytest.mark.slow
def test_the_command_writes_a_rig_file_a_recording_and_a_page(aolink: Run, tmp_path: Path) -> None:
    np.savez(tmp_path / "film.npz", frames=np.stack(list(shaken().frames())), rate_hz=RATE, exposure_s=EXPOSURE)
    done = aolink("look", "film.npz", "--quick", "--json")
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert any(low <= 37.3 <= high for low, high in said["directions"]["x"]["parameters"]["frequency_hz"]["set"])
    # It moves aslant, and the smaller motion along y alone would leave the alias too.
    ((low, high),) = said["directions"]["y"]["parameters"]["frequency_hz"]["set"]
    assert low <= 37.3 <= high
    folder = tmp_path / "film-look"
    recording = Recording(folder / "film.mcap")
    assert recording.estimators == ["profile"]
    assert len(recording) == 60
    assert load_rig(str(folder / "rig.toml")).sensor.spots == 1
    page = (folder / "page.html").read_text()
    assert page.count("<figure>") == 4
    assert said["text"][:40] in page
    assert sorted(each.name for each in folder.iterdir()) == ["film.mcap", "page.html", "rig.toml"]
    again = aolink("look", "film.npz", "--quick")
    assert again.returncode != 0
    assert "exists already" in again.stderr


@pytest.mark.slow
def test_an_alias_that_would_blur_the_spot_is_left_out_of_the_set() -> None:
    """At 3.3 Hz the exposures hardly blur; at 46.7 or 53.3 Hz, which the centroids allow too, they would."""
    looked = look(
        shaken(cycles=0.9 * 3.3 / RATE, step=3.3 / RATE, angle=0.0), FilmSettings(exposure_s=0.9 / RATE), "slow"
    )
    found = looked.directions[0].found
    assert not looked.blurred
    assert found is not None
    hz = next(each for each in found.parameters if each.name == "frequency_hz")
    assert hz.holds(3.3)
    assert len(hz.pieces) == 1


@pytest.mark.slow
@pytest.mark.parametrize("apart", [False, pytest.param(True, marks=pytest.mark.rare)])
def test_spots_with_one_motion_are_told_from_those_with_their_own(apart: bool) -> None:
    """The likelihood says it; a hot pixel in a window costs no exposure."""
    middles = ((14.0, 24.0), (48.0, 24.0))
    film = shaken(middles=middles, amplitude=2.0, angle=0.0, phases=(0.0, 1.9) if apart else (0.0, 0.0))
    frames = np.stack(list(film.frames()))
    frames[:, 24, 52] = 3000
    looked = look(array_film(frames, "two", rate_hz=RATE), FilmSettings(exposure_s=EXPOSURE), "two")
    assert looked.together is not apart
    assert len(looked.spots.corners) == 2
    rig = parse_rig(looked.text)
    assert (rig.plant.axes, rig.n_outputs) == ((2, 4) if apart else (1, 4))
    assert looked.directions[0].found is not None


@pytest.mark.slow
def test_without_matplotlib_there_is_an_answer_and_no_page(tmp_path: Path) -> None:
    np.savez(
        tmp_path / "film.npz", frames=np.stack(list(shaken(amplitude=0.0).frames())), rate_hz=RATE, exposure_s=EXPOSURE
    )
    hidden = "import sys; sys.modules['matplotlib'] = None; from aolink.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", hidden, "look", "film.npz"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "nothing moves" in done.stdout
    assert "no page with pictures" in done.stdout
    assert sorted(each.name for each in (tmp_path / "film-look").iterdir()) == ["film.mcap", "rig.toml"]
