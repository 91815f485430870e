"""The job of `aolink demo`, from end to end: a rig, a session, the estimates again, restored scenes, the picture."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path

from aolink.colours import by_rank
from aolink.control.integrator import INTEGRATOR
from aolink.errors import AolinkError, DeviceError, ExportError
from aolink.estimation import Score, estimator_row
from aolink.estimation.registry import BASELINE_ESTIMATOR, DEFAULT_ESTIMATOR
from aolink.exposure import residual_rms
from aolink.files import writing
from aolink.polling import wait_readable
from aolink.recording.deblur import RestoredCounts, write_deblurred
from aolink.recording.reader import Recording
from aolink.recording.reestimate import first_difference, reestimate, scored
from aolink.rig import Rig
from aolink.session import Report, record

_RIG_START_S = 60.0
_RIG_END_S = 5.0


@dataclass(frozen=True, kw_only=True)
class DemoResult:
    """The results of the demo."""

    recording: Path
    """The session's recording, with the restored pictures where the rig has a picture sensor."""
    rrd: Path | None = None
    """The Rerun file; None if the demo was interrupted before."""
    picture: Path | None = None
    no_picture: str = ""
    """The reason why there is no picture."""
    report: Report
    scores: Mapping[str, Score] = field(default_factory=dict)
    """The estimators' scores against the truth, by rank."""
    residuals: Mapping[str, float] = field(default_factory=dict)
    """True slopes at the fast rate where the loop was closed, root mean square, slope units, by the controller's name;
    "open" for none. Each controller has a recording of its name beside the session's."""
    deblurred: RestoredCounts | None = None
    """Summary of the restored pictures; None where the rig has no picture sensor."""
    differences: Mapping[str, str] = field(default_factory=dict)
    """The first difference of online and offline estimates, by estimator; empty if there is none."""
    seconds: dict[str, float]
    """Wall time of each part."""


def usual_estimators(rig: Rig, control: str = "") -> list[str]:
    """The estimators of a demo that names none: no camera, the centroid and the blur, as far as they can work on the
    rig; with a controller, the one that serves it comes first."""
    usual = ("open-loop", BASELINE_ESTIMATOR, DEFAULT_ESTIMATOR)
    possible = [name for name in usual if estimator_row(name).refusal(rig) is None]
    return possible[::-1] if control else possible


@contextlib.contextmanager
def simulated_rig(rig: str | Path, *options: str) -> Iterator[tuple[str, str]]:
    """A simulated rig as a process of its own, `aolink sim` with ``options``; gives the ports of camera and mirror.

    Raises
    ------
    DeviceError
        The process does not start.
    """
    command = [sys.executable, "-P", "-m", "aolink", "sim", str(rig), "--json", "--tied", *options]
    # It has a process group of its own: Ctrl-C goes to the session, which still has to park the mirror.
    # Its input is a pipe that ends with this process, however that ends, and the rig ends with the pipe.
    started = False
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.PIPE, start_new_session=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline() if wait_readable([process.stdout], _RIG_START_S) else b""
        if not line:
            raise DeviceError(f"the simulated rig did not start; try it by hand: {' '.join(command)}")
        ports, started = json.loads(line), True
        yield ports["camera"], ports["mirror"]
    finally:
        if process.stdin is not None:
            process.stdin.close()  # a serving rig then ends silently; otherwise it is killed
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(_RIG_END_S if started else 0)
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def new_folder(parent: Path) -> Path:
    """A dated folder that did not exist before."""
    name = time.strftime("demo-%Y%m%d-%H%M%S")
    for suffix in ("", *(f"-{n}" for n in range(2, 1000))):
        folder = parent / (name + suffix)
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise AolinkError(f"cannot create {folder}: {error.strerror}; give another -o") from None
        return folder
    raise AolinkError(f"{parent} is full of folders named {name}: give another -o")


def run_demo(
    rig: Rig, source: str | Path, folder: Path, *, estimators: Sequence[str], exposures: int, control: str = "",
    stoppable: Callable[[], AbstractContextManager[Callable[[], bool]]] = lambda: contextlib.nullcontext(lambda: False),
    progress: Callable[[str, int], None] = lambda part, done: None,
) -> DemoResult:  # fmt: skip
    """Run the demo in ``folder``. Raises AolinkError; the recording up to then stays.

    The rig runs from its ``source``, a file or a name; paths in the file are relative to it. ``stoppable`` is entered
    for the session alone, which ends in good order when the function that it gives returns True; nothing else is made
    then. With ``control`` the session's loop is closed by that controller, and two others are recorded before, from the
    same seed: with the loop open, and closed by the integrator. The Rerun file has the residual slopes of all of them.
    The picture is about the exposure in which the spot moved most.
    """
    from aolink import plotting, viewing

    with writing(folder / "rig.toml") as partial:
        partial.write_text(rig.toml)
    path, rrd, picture = folder / "session.mcap", folder / "session.rrd", folder / "session.png"
    seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def part(name: str) -> Iterator[Callable[[int], None]]:
        start = time.monotonic()
        progress(name, 0)
        yield lambda done: progress(name, done)
        seconds[name] = time.monotonic() - start

    sessions: list[tuple[str, Path, Sequence[str]]] = [(control, path, estimators)]
    if control:
        others = [each for each in ("", INTEGRATOR.name) if each != control]
        sessions = [(of, folder / f"{of or 'open'}.mcap", ()) for of in others] + sessions
    residuals: dict[str, float] = {}
    for of, where, names in sessions:
        what = f"record {of or 'open'}" if control else "record"
        with part(what) as tell, stoppable() as stop, simulated_rig(source) as (camera, mirror):
            report = record(
                rig, camera, mirror, where, estimators=names, exposures=exposures, note="aolink demo", control=of,
                stop=stop, progress=tell,
            )  # fmt: skip
        if stop():
            return DemoResult(recording=where, report=report, seconds=seconds)
        if control:
            residuals[of or "open"] = residual_rms(Recording(where).exposures())
    with part("estimate again") as tell:
        recording = Recording(path)
        offline = reestimate(recording, estimators, tell, as_recorded=True)
        differences = {
            name: difference
            for name, again in offline.items()
            if (difference := first_difference(recording.estimates(name), again))
        }
        ranked = by_rank(list(estimators))
        scores = scored(recording, ranked)
    deblurred = None
    if rig.scene is not None:
        with part("deblur") as tell:
            # A few scenes take less time than other processes take to start.
            deblurred = write_deblurred(recording, folder / "deblurred.mcap", estimator=ranked[-1], progress=tell)
        recording = Recording(folder / "deblurred.mcap")
    with part("write .rrd"):
        loops = {of or "open": Recording(where) for of, where, _ in sessions} if control else {}
        viewing.save_rrd(recording, rrd, look=viewing.Look(loops=loops))
    drawn, no_picture = None, ""
    with part("draw"):
        try:
            drawn = plotting.draw_session(recording, picture)
        except ExportError as error:
            no_picture = str(error)
    return DemoResult(
        recording=recording.path, rrd=rrd, picture=drawn, no_picture=no_picture, report=report, scores=scores,
        residuals=residuals, deblurred=deblurred, differences=differences,
        seconds=seconds,
    )  # fmt: skip
