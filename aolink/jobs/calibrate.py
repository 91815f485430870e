"""The job of `aolink calibrate`: it makes a rig file from frames of recordings, which are made on the spot or
before."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aolink.calibration import KINDS, Calibration, Frames, calibrate, calibrated_text
from aolink.calibration.interaction import Interaction, check_spots, measure_interaction, poke_inputs, rest_exposures
from aolink.calibration.measure import LEAST_FRAMES, line_sensor
from aolink.calibration.row_time import RowTime, row_time
from aolink.devices.opening import open_devices
from aolink.errors import AolinkError, CalibrationError, RigError
from aolink.estimation import make_estimator
from aolink.files import check_target
from aolink.recording import topics
from aolink.recording.reader import Recording
from aolink.rig import Rig
from aolink.rig.edit import with_value
from aolink.session import record

_ASKED = (
    ("dark", "dark", "cover the camera"),
    ("flat-1", "flat", "light the sensor evenly, without the spot, to about half of full scale"),
    ("flat-2", "flat", "change that light by a factor of two or so"),
    ("still", "still", "let the spot rest, with nothing else that shines"),
)
"""Name and kind of each recording, and what to do before it; in this order."""
_SAME = ("kind", "pixels", "field", "bit_depth")
"""Keys whose values a recording's sensor and the rig file's must share."""


@dataclass(frozen=True, kw_only=True)
class Calibrated:
    """A calibration and the text of the rig file that it makes."""

    rig: Rig
    """The rig before the calibration."""
    calibration: Calibration
    text: str


def calibrate_recordings(rig: Rig, text: str, paths: Sequence[Path]) -> Calibrated:
    """Calibrate from recordings that were made with ``aolink record --calibration``.

    Parameters
    ----------
    text:
        The rig file's text with its own line ends, for the new one.

    Raises
    ------
    RecordingError
        A recording cannot be read.
    CalibrationError
        A recording is of another sensor, is not marked, or its frames are not of the kind that it is marked with.
    """
    frames = [read_frames(path, rig) for path in paths]
    calibration = calibrate(rig, frames)
    order = sorted(range(len(paths)), key=lambda k: KINDS.index(frames[k].kind))
    sources = [f"{frames[k].kind} {paths[k].name} sha256:{_digest(paths[k])}" for k in order]
    return Calibrated(rig=rig, calibration=calibration, text=calibrated_text(text, rig, calibration, sources))


def read_frames(path: Path, rig: Rig) -> Frames:
    """The whole frames of a recording that is marked as one for calibration."""
    recording = Recording(path)
    kind = next((each for each in KINDS if each == recording.metadata.get(topics.CALIBRATION)), None)
    if kind is None:
        raise CalibrationError(
            f"{path} is not marked as a recording for calibration: make one with `aolink record --calibration"
            " dark|flat|still`"
        )
    ours, theirs = line_sensor(rig), recording.rig.sensor
    pairs = [(f"sensor.{name}", getattr(ours, name), getattr(theirs, name, None)) for name in _SAME]
    for name in ("exposure_steps", "fast_step_s"):
        pairs.append((f"timing.{name}", getattr(rig.timing, name), getattr(recording.rig.timing, name)))
    for key, mine, found in pairs:
        if mine != found:
            raise CalibrationError(
                f"{path} is of another rig: its {key} is {found}, the rig file has {mine}; give that rig's file"
                " (--rig), or record it again"
            )
    whole = [exposure.pixels.ravel() for exposure in recording.exposures() if exposure.complete]
    counts = np.array(whole, dtype=np.uint16).reshape(len(whole), line_sensor(rig).pixels)
    return Frames(kind=kind, counts=counts, source=path.name)


def record_frames(
    rig: Rig, camera: str | None, mirror: str | None, folder: Path, *, frames: int, overwrite: bool,
    ask: Callable[[str], str], stoppable: Callable[[], AbstractContextManager[Callable[[], bool]]],
    progress: Callable[[], AbstractContextManager[Callable[[str, int], None]]],
) -> list[Path]:  # fmt: skip
    """Try both ports, and then ask for each kind of light in turn and record it.

    Parameters
    ----------
    folder:
        Where the recordings go.
    ask:
        Puts a question; gives the answer: an empty text to go on, "s" to skip. EOFError if nobody is there.
    stoppable:
        For each recording, a context that gives the function ``stop``; leaving the context raises the error that ends
        the job, if it was stopped.
    progress:
        For each recording, takes its name and the number of frames so far.

    Raises
    ------
    AolinkError
        A recording failed, or nobody answers.
    """
    line_sensor(rig)
    if frames < LEAST_FRAMES:
        raise CalibrationError(
            f"{frames} frames of a light are too few: at least {LEAST_FRAMES} are needed, better 100"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise AolinkError(f"cannot create {folder}: {(error.strerror or '').lower()}; give another -o") from None
    for name, _, _ in _ASKED:
        check_target(folder / f"{name}.mcap", overwrite=overwrite)
    with open_devices(rig, camera, mirror):
        pass  # the user is asked for no light before the devices have answered
    paths: list[Path] = []
    skipped = ""
    for name, kind, what in _ASKED:
        if kind == skipped:
            continue
        try:
            skip = "" if kind == "dark" else "; s to skip"
            answer = ask(f"{kind}: {what}, then press Enter{skip}: ").strip().lower()
        except EOFError:
            raise CalibrationError(
                "nobody answers: run `aolink calibrate` on a terminal, or give it recordings made with"
                " `aolink record --calibration`"
            ) from None
        if answer == "s" and kind != "dark":  # without the dark frames nothing can be measured
            skipped = kind
            continue
        path = folder / f"{name}.mcap"
        with stoppable() as stop, progress() as tell:  # not while it asks
            record(
                rig, camera, mirror, path, exposures=frames, calibration=kind, overwrite=overwrite, stop=stop,
                progress=partial(tell, name),
            )  # fmt: skip
        paths.append(path)
    return paths


@dataclass(frozen=True, kw_only=True)
class Poked:
    """A measured interaction matrix, and the one of the rig file's plant for the same inputs."""

    measured: Interaction
    modelled: Interaction

    @property
    def noise(self) -> float:
        """Expected rms error of the measured matrix, as a share of its rms."""
        error = np.sqrt(len(self.measured.matrix) * (self.measured.sd**2).sum())
        return float(error / max(np.linalg.norm(self.measured.matrix), 1e-300))

    @property
    def difference(self) -> float:
        """Rms of the measured matrix less the plant's, as a share of its rms."""
        apart = self.measured.matrix - self.modelled.matrix
        return float(np.linalg.norm(apart)) / max(float(np.linalg.norm(self.measured.matrix)), 1e-300)


def record_pokes(
    rig: Rig, camera: str | None, mirror: str | None, path: Path, *, share: float, repeats: int, overwrite: bool,
    stop: Callable[[], bool], progress: Callable[[int], None], hold_s: float = 0.0,
) -> None:  # fmt: skip
    """Record a session in which each input is pushed and pulled by ``share`` of its range, ``repeats`` times.

    Each poke rests for ``hold_s``, one frame period at least, before it is measured.

    Raises
    ------
    CalibrationError
        The sensor has no spots, or the pokes go beyond the mirror's limits.
    AolinkError
        As `aolink.session.record`.
    """
    check_spots(rig)
    size = share * (rig.mirror.input_max - rig.mirror.input_min)
    pokes = np.tile(poke_inputs(rig, size, rest_exposures(rig, hold_s)), (repeats, 1))

    def inputs(first_step: int, n_steps: int) -> NDArray[np.float64]:
        rows = pokes[first_step : first_step + n_steps]
        return np.concatenate([rows, np.tile(rig.mirror.park, (n_steps - len(rows), 1))])

    record(
        rig, camera, mirror, path, exposures=len(pokes) // rig.timing.frame_period_steps, inputs=inputs,
        note="pokes for an interaction matrix", overwrite=overwrite, stop=stop, progress=progress,
    )  # fmt: skip


def interaction(rig: Rig, path: Path, hold_s: float = 0.0) -> Poked:
    """The interaction matrix of a recording with pokes, and that of the rig file's plant for the same inputs.

    Only pokes that have rested for ``hold_s``, one frame period at least, are measured. Raises RecordingError and
    CalibrationError.
    """
    recording, rest = Recording(path), rest_exposures(rig, hold_s)
    plant = make_estimator(rig, "open-loop")
    return Poked(
        measured=measure_interaction(rig, recording.exposures(), rest_exposures=rest),
        modelled=measure_interaction(
            rig, recording.exposures(), lambda exposure: plant.step(exposure).path.mean(axis=1), rest
        ),
    )  # fmt: skip


def rig_text(path_or_name: str, rig: Rig) -> str:
    """The text of the file that ``rig`` was loaded from, with its own line ends. Raises RigError."""
    path = Path(path_or_name)
    if not path.exists():  # a rig that comes with aolink
        return rig.toml
    try:
        with path.open(newline="") as file:
            return file.read()
    except OSError as error:
        raise RigError(f"cannot read the rig file {path}: {error.strerror}") from None


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def film_row_time(rig: Rig, path: Path, blink_hz: float) -> RowTime:
    """The row time from a film of light that blinks at a rate, Hz; the rig's frame rate is that of a film without one.

    Raises
    ------
    CalibrationError
        The film does not show it; the message says what to film.
    ImportingError
        The film cannot be read, or its times contradict each other.
    """
    from aolink.films.formats import open_film
    from aolink.films.whole import whole_frames
    from aolink.importing.frames import FilmSettings, film_times

    if not 0 < blink_hz < math.inf:
        raise CalibrationError(f"blink_hz={blink_hz:g} must be the light's blinks in a second, above 0")
    film = whole_frames(open_film(path))
    if film.slopes:
        raise CalibrationError(f"{film.name} has slopes and no pictures")
    times = film_times(film, FilmSettings())
    period_s = rig.timing.frame_period_steps * rig.timing.fast_step_s if times.rate_hz is None else 1 / times.rate_hz
    light = np.array([frame.astype(np.float64).mean(axis=1) for frame in film.frames()])
    return row_time(light, times.periods, period_s, blink_hz)


def with_row_time(text: str, found: RowTime, film: str) -> str:
    """The text of a rig file with a measured row time, and its standard deviation beside it."""
    value, digits = found.row_time_s, max(2, 2 - math.floor(math.log10(max(found.sd_s, 1e-15))))
    comment = f"+- {found.sd_s:.2g}, from {found.frames} frames of {film}"
    text = with_value(text, "sensor.row_time_s", round(value, digits), may_be_new=True)
    return with_value(text, "sensor.row_time_s", round(value, digits), comment=comment)
