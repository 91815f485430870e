"""A recording as Rerun entities, part by part, and as a Rerun file with its layout inside."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr

from aolink.colours import by_rank
from aolink.errors import ViewerError
from aolink.estimation.estimate import Estimate
from aolink.estimation.score import Scorer, score_table
from aolink.exposure import Exposure
from aolink.plotting.overview import limits_of
from aolink.plotting.pupil import has_pupil
from aolink.recording import topics
from aolink.recording.reader import Restorations
from aolink.recording.side_files import check_stands_alone
from aolink.rig import Rig
from aolink.series import Also
from aolink.viewing import camera, devices, entities, incidents, motion, scene
from aolink.viewing.blueprint import PATH_WINDOW, Contents, blueprint
from aolink.viewing.look import APPLICATION, Look, identity
from aolink.viewing.palette import series_colour
from aolink.viewing.pupil import log_maps
from aolink.viewing.rrd_file import new_rrd
from aolink.viewing.series import POINTS, Chosen, Drawing
from aolink.viewing.timebase import Timebase

if TYPE_CHECKING:
    from aolink.recording.messages import RecordedMessage
    from aolink.recording.reader import Recording
    from aolink.restoration import RestoredPictures


_PAGES = 16
"""Pages of exposures in a part of a recording, which is in memory as a whole; the first part has one page, so that it
is there soon."""
_BYTES_IN_PART = 100e6
"""The most bytes that a part's frames, or each estimator's paths, may take."""
_BESIDE_NS = 1_000_000_000
"""How long before and after its exposures a part's messages may have come, ns."""


def save_rrd(
    recording: Recording, path: str | Path, *, look: Look | None = None, overwrite: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Path:  # fmt: skip
    """Write a recording as an .rrd file that any Rerun viewer opens with aolink's layout.

    Its recording id in Rerun is the digest of the recording's bytes: the same recording opened twice is one there.

    Parameters
    ----------
    recording:
        A recording, as `aolink.read` opens it.
    path:
        The file to write; it appears only when it is whole.
    look:
        A part of it, another spot, or another recording beside it; by default the whole recording alone.
    overwrite:
        Whether a file of that name may be replaced.
    progress:
        Called with the number of exposures written.

    Raises
    ------
    ViewerError
        The file exists already or cannot be written, or the recording has nothing to show.
    """
    path, look = Path(path), look or Look()
    beside = [*([look.compared] if look.compared else ()), *look.loops.values()]
    sources = [file for each in (recording, *beside) for file in each.files]
    with new_rrd(APPLICATION, path, overwrite=overwrite, sources=sources, identity=identity(recording, look)) as stream:
        for done in sent_parts(stream, recording, look):
            if progress:
                progress(done)
    return path


def sent_parts(
    stream: rr.RecordingStream, recording: Recording, look: Look, *, at_once: bool = False,
) -> Iterator[int]:  # fmt: skip
    """Send a recording to a stream part by part, and its layout at the end; gives how many exposures have been sent.

    With ``at_once`` a layout comes after the first part too, for a viewer that shows the data so far.

    Raises
    ------
    ViewerError
        There is nothing to show, or the frames are not those of the rig's sensor.
    RecordingError
        It is a side file.
    """
    sender = Sender(stream, recording, look)
    other = None
    if look.compared is not None:
        other = Sender(stream, look.compared, Look(exposures=look.exposures, spot=look.spot), root=entities.COMPARED)
    stream.send_recording_name(f"{recording.rig.name} · {recording.path.name}")

    def lay_out() -> None:
        # Active too: a viewer that gets the data over the network would otherwise keep a layout of its own.
        stream.send_blueprint(blueprint(sender.contents(other)), make_active=True, make_default=True)

    theirs = other.parts() if other else iter(())
    for done in sender.parts():
        next(theirs, None)
        if at_once:
            lay_out()
            at_once = False
        yield done
    for _ in theirs:
        pass
    lay_out()


class Sender:
    """Sends a recording to a stream, part by part, so that the memory does not grow with its length."""

    def __init__(self, stream: rr.RecordingStream, recording: Recording, look: Look, root: str = "") -> None:
        check_stands_alone(recording)
        self._recording, self._look, self._rig = recording, look, recording.rig
        self._numbers = range(len(recording)) if look.exposures is None else look.exposures
        self._names = by_rank(list(recording.estimators))
        chosen = Chosen.of(recording.rig, look.spot)
        self._about = None if look.about is None else recording[look.about]
        near = self._near(chosen.outputs[0])
        every_step = near is not None or len(self._numbers) <= 2 * PATH_WINDOW + 1
        self._drawing = Drawing(
            stream=stream, chosen=chosen, root=root, points=None if every_step else POINTS, near=near
        )
        self._skipped: dict[str, set[int]] = {name: set() for name in self._names}
        self._runs: deque[Any] = deque()
        """Commands and reports that have not been sent."""
        self._others: list[RecordedMessage] = []
        """Messages of other topics, which are sent at the end."""
        self._restorations = Restorations()
        self._starts: dict[int, int] = {}
        """First steps by frame id of the exposures sent, where pictures may have been restored."""
        self._scorers = {name: Scorer() for name in self._names}
        self._measuring: set[str] = set()
        self._shown = [topic for topic in recording.counts if _shows_messages(topic) is not None]
        self._known: set[str] = set()
        """Entities and kinds of data that have been sent."""
        self._scales: dict[str, float] = {}
        self._timebase: Timebase | None = None
        self._top: float | None = None
        self._last: Exposure | None = None
        self._lost = self._warnings = 0
        self._finished = False
        self.done = 0
        """Exposures that have been sent."""

    def _near(self, output: int) -> tuple[float, float] | None:
        """The part of the field that the paths of the exposure that the layout is about, and their blur, are in."""
        if (about := self._look.about) is None:
            return None
        exposure, found = next(self._recording[about : about + 1].walk(self._names))
        paths = [each.path[output] for each in (exposure.truth, *found.values()) if each is not None]
        return limits_of(self._rig.sensor.profile, paths)

    def parts(self) -> Iterator[int]:
        """Send the exposures with all that belongs to them, then the devices; gives after each part how many exposures
        are sent."""
        recording = self._recording
        if self._look.exposures is not None:
            for each in self._messages(list(self._shown)):
                self._see(each)
        for exposures, estimates, following in self._read():
            self._send(exposures, estimates, following)
            self._send_messages(self._runs_before(following))
            self.done += len(exposures)
            yield self.done
        if self._timebase is None:
            raise ViewerError(
                f"there is no exposure in {recording.path}, so nothing to view; `aolink info` says what it holds"
            )
        self._send_messages([*self._runs, *self._others])
        self._send_restored(list(self._restorations.taken(ended=True)))
        part = self._look.exposures
        for k, (name, loop) in enumerate(self._look.loops.items()):
            series = loop[part.start : part.stop] if part is not None else loop
            motion.log_residual(self._drawing, self._timebase, name, series, series_colour(k))
        true_scene = recording.true_scene
        if self._rig.scene is not None and true_scene is not None:
            scene.log_true_scene(self._drawing, self._rig.scene, true_scene)
            self._known.add(entities.TRUE_SCENE)
        text = rr.TextDocument(self._summary(), media_type="text/markdown")
        self._drawing.log(entities.SESSION, text)
        self._finished = True

    def _read(self) -> Iterator[tuple[list[Exposure], dict[str, dict[int, Estimate]], Exposure | None]]:
        """Read parts: whole pages of exposures, their estimates by name and frame, and the exposure after them."""
        rig = self._rig
        series = self._recording[self._numbers.start : self._numbers.stop] if self._look.exposures else self._recording
        steps = rig.timing.exposure_steps * rig.n_outputs * 8 * (1 + 2 * len(self._names))
        pages = int(max(1, min(_PAGES, _BYTES_IN_PART // (camera.HISTORY * (steps + 4 * np.prod(rig.sensor.shape))))))
        exposures: list[Exposure] = []
        estimates: dict[str, dict[int, Estimate]] = {name: {} for name in self._names}
        first: int | None = None
        for step in series.steps(self._names, also=self._also()):
            exposure = step.exposure
            for name in step.skipped:
                self._skipped[name].add(exposure.frame_id)
            if exposure.pixels.shape != rig.sensor.shape:
                raise ViewerError(
                    f"frame {exposure.frame_id} of {self._recording.path} has {exposure.pixels.shape} pixels, the"
                    f" sensor of the rig file in it {rig.sensor.shape}: it was recorded with another rig file"
                )
            first = exposure.frame_id if first is None else first
            part, last = (-(-camera.page_of(e, first) // pages) for e in (exposure, (exposures or [exposure])[0]))
            if part != last:
                yield exposures, estimates, exposure
                exposures, estimates = [], {name: {} for name in self._names}
            exposures.append(exposure)
            for name, estimate in step.estimates.items():
                estimates[name][exposure.frame_id] = estimate
        if exposures:
            yield exposures, estimates, None

    def _send(
        self, exposures: list[Exposure], estimates: dict[str, dict[int, Estimate]], following: Exposure | None
    ) -> None:
        drawing, rig = self._drawing, self._rig
        known = self._timebase
        self._timebase = timebase = known.followed_by(exposures) if known else Timebase.of(rig, exposures)
        names = [*(["truth"] if any(e.truth is not None for e in exposures) else ()), *self._names]
        self._top = send_camera(drawing, rig, timebase, exposures, estimates, names, top=self._top, following=following)
        motion.log_truth(drawing, timebase, exposures)
        truths = {e.frame_id: e.truth for e in exposures if e.truth is not None}
        self._known |= {"truth"} if truths else set()
        for name, by_frame in estimates.items():
            found = list(by_frame.values())
            motion.log_estimates(drawing, timebase, found)
            motion.log_errors(drawing, timebase, found, truths)
            incidents.log_status(drawing, timebase, name, exposures, by_frame, self._skipped[name])
            self._measuring |= {name} if any(e.innovation.shape[1] for e in found) else set()
            for exposure in exposures:
                if exposure.frame_id in by_frame:
                    self._scorers[name].add(exposure, by_frame[exposure.frame_id])
        incidents.log_exposures(drawing, timebase, exposures, self._last)
        self._warnings += incidents.log_warnings(drawing, timebase, exposures, estimates, self._skipped, self._last)
        before = self._last.frame_id if self._last else exposures[0].frame_id - 1
        self._lost += exposures[-1].frame_id - before - len(exposures)
        self._last = exposures[-1]
        if has_pupil(self._recording):
            best = estimates[self._names[-1]] if self._names else {}
            log_maps(drawing, timebase, rig, exposures, best, self._scales)
        if rig.scene is not None and scene.log_scenes(drawing, rig.scene, timebase, exposures):
            self._known.add(entities.SCENE)
        if topics.RESTORATION in self._recording.counts:
            self._starts |= {each.frame_id: each.first_step for each in exposures}
            self._send_restored(list(self._restorations.taken()))

    def _send_restored(self, restored: list[RestoredPictures]) -> None:
        """Send pictures; they come after their exposures."""
        assert self._timebase is not None
        known = [each for each in restored if each.frame_id in self._starts]
        if scene.log_restored(self._drawing, self._timebase, self._starts, known):
            self._known.add(entities.RESTORED_SCENE)
        if any(each.spots is not None for each in known):
            self._known.add(entities.RESTORED_SPOTS)

    def _also(self) -> Also:
        """The functions that get the messages that are shown, by topic."""
        restored = dict.fromkeys(Restorations.TOPICS, self._restorations.see)
        return restored if self._look.exposures is not None else restored | dict.fromkeys(self._shown, self._see)

    def _see(self, recorded: RecordedMessage) -> None:
        """Keep a message until it is sent."""
        (self._runs if recorded.topic in topics.RUNS else self._others).append(recorded)

    def _runs_before(self, following: Exposure | None) -> list[RecordedMessage]:
        """Take out the commands and reports of steps before an exposure."""
        found: list[RecordedMessage] = []
        while self._runs and (following is None or self._runs[0].message.first_step < following.first_step):
            found.append(self._runs.popleft())
        return found

    @cached_property
    def _ends(self) -> tuple[Exposure, Exposure]:
        """The first and the last exposure of a part of the recording."""
        first = self._recording[self._numbers[0]]
        return first, first if len(self._numbers) == 1 else self._recording[self._numbers[-1]]

    def _messages(self, wanted: Sequence[str]) -> Iterator[RecordedMessage]:
        """Messages of some topics that belong to the part of the recording."""
        recording = self._recording
        if not (there := [topic for topic in wanted if recording.counts.get(topic)]):
            return
        first, last = self._ends
        period = self._rig.timing.frame_period_steps * self._rig.timing.fast_step_ns
        low, high = first.host_start_ns - _BESIDE_NS, last.host_start_ns + period + _BESIDE_NS
        if high < recording.start_ns or low > recording.end_ns:  # the log has other times than its frames
            low, high = recording.start_ns, recording.end_ns + 1
        end, ended_ns = last.first_step + last.n_steps, last.host_start_ns + period
        for each in recording.messages(*there, start_ns=max(low, 0), end_ns=high):
            message: Any = each.message
            if each.topic in topics.RUNS:
                inside = message.first_step < end and message.first_step + message.n_steps > first.first_step
            else:
                frame = getattr(message, "frame_id", None)
                inside = frame is not None and first.frame_id <= frame <= last.frame_id
                inside = inside or (frame is None and first.host_start_ns <= each.log_time_ns < ended_ns)
            if inside:
                yield each

    def _send_messages(self, messages: list[RecordedMessage]) -> None:
        by_topic: dict[str, list[RecordedMessage]] = {}
        for record in messages:
            by_topic.setdefault(record.topic, []).append(record)
        assert self._timebase is not None
        for topic, records in by_topic.items():
            if (shows := _shows_messages(topic)) is not None:
                shows(self._drawing, self._timebase, records)
        self._known |= by_topic.keys()

    def contents(self, other: Sender | None = None) -> Contents:
        """The contents that have been sent, for the layout."""
        known = self._known
        return Contents(
            rig=self._rig, estimators=self._names, measuring=[name for name in self._names if name in self._measuring],
            density_top=self._top or 1.0, truth="truth" in known,
            scenes=[each for each in entities.SCENES if each in known],
            restored_spots=entities.RESTORED_SPOTS in known, loops=list(self._look.loops),
            topics=frozenset(known.intersection(self._shown) if self._finished else self._shown), drawn=self._drawing,
            maps=self._scales, warnings=self._warnings > 0, alone=len(self._numbers) == 1, about=self._row(),
            compared=other.contents() if other else None,
        )  # fmt: skip

    def _row(self) -> int | None:
        """The row, on its page, of the exposure that the layout is about."""
        if self._about is None or self._timebase is None:
            return None
        return (self._about.frame_id - self._timebase.frame_id) % camera.HISTORY

    def _summary(self) -> str:
        """A page of Markdown about a session, with the data that it lacks and, where the truth is known, the
        estimators' scores."""
        rig, recording, last = self._rig, self._recording, self._last
        assert last is not None
        assert self._timebase is not None
        steps = rig.timing.exposure_steps
        part = ""
        if self._look.exposures is not None:
            part = f" ({self._numbers.start} to {self._numbers.stop - 1} of {len(recording)}, counted from 0)"
        lines = [
            f"## {rig.name}",
            f"{self.done} exposure{'s' if self.done != 1 else ''}{part} of {steps} fast steps,"
            f" {steps * rig.timing.fast_step_s:g} s each; {self._lost} frames lost. The first began at"
            f" {self._timebase.origin_ns / 1e9:.6f} s of the camera's clock.",
            "",
        ]
        if self._names:
            found = score_table({name: scorer.result() for name, scorer in self._scorers.items()})
            heads = ["estimator", *found.heads]
            table = [heads, ["---"] * len(heads), *([name, *cells] for name, cells in found.rows.items())]
            lines += [*(f"| {' | '.join(cells)} |" for cells in table), "", *found.notes]
        skipped = {name: len(frames) for name, frames in self._skipped.items() if frames}
        if skipped:
            lines += ["", "Exposures skipped for want of time: " + ", ".join(f"{k} {n}" for k, n in skipped.items())]
        if self._look.compared is not None:
            other = self._look.compared.path.name
            lines += ["", f"Fainter lines are of {other}, from its own first exposure on."]
        if missing := self._missing():
            lines += ["", "It lacks: " + "; ".join(missing) + "."]
        if recording.damage:
            lines += ["", f"Damaged: {recording.damage}"]
        return "\n".join([*lines, "", rig.summary])

    def _missing(self) -> list[str]:
        """The data that other recordings have and this one lacks, and how to make it."""
        known, found = self._known, []
        if not self._names:
            found.append(f"no estimates (`aolink estimate {self._recording.path.name}` makes them)")
        if "truth" not in known:
            found.append("no truth, which only a simulated rig knows")
        if topics.COMMAND not in known and topics.APPLIED not in known:
            found.append("no commands and no report of a mirror")
        if topics.LATENCY not in known:
            found.append("no latencies")
        return found


def _shows_messages(topic: str) -> Callable[[Drawing, Timebase, Sequence[RecordedMessage]], None] | None:
    """The function of `devices` that a topic's messages are handed to; None for what is shown as exposures, estimates
    or pictures, or not at all."""
    module, _, function = topics.named(topic).shown_by.partition(".")
    shows: Callable[[Drawing, Timebase, Sequence[RecordedMessage]], None] | None
    shows = getattr(devices, function) if module == "devices" else None
    return shows


def send_camera(
    drawing: Drawing, rig: Rig, timebase: Timebase, exposures: Sequence[Exposure],
    estimates: Mapping[str, Mapping[int, Estimate]], names: Sequence[str], *, top: float | None = None,
    following: Exposure | None = None, live: bool = False,
) -> float:  # fmt: skip
    """Send frames, pages and profiles of exposures; in a live session those of the last exposure and its page.

    Gives the density at the top of the profile's plot, found from the exposures if ``top`` is not given.
    """
    sensor, output = rig.sensor, drawing.chosen.outputs[0]
    new = exposures[-1:] if live else exposures
    outputs = {"truth": {e.frame_id: e.truth.path for e in exposures if e.truth is not None}}
    outputs |= {name: {k: e.path for k, e in by_frame.items()} for name, by_frame in estimates.items()}
    camera.log_frames(drawing, timebase, new)
    if sensor.directions == 2:
        for name, by_frame in outputs.items():
            camera.log_spot_paths(drawing, sensor, timebase, new, name, by_frame)
    # The following is about one slope over time.
    paths = {
        name: {k: path[output] for k, path in by_frame.items() if np.isfinite(path[output]).all()}
        for name, by_frame in outputs.items()
    }
    line, seen = sensor.profile, camera.one_profile(sensor, exposures, output)
    if top is None:
        top = camera.density_top(line, seen, alone=drawing.near is not None)
        camera.log_profile_axes(drawing, line, top, names)
    first, at = timebase.frame_id, seen[-1] if live else None
    pages: dict[int, list[Exposure]] = {}
    for each in seen:
        pages.setdefault(camera.page_of(each, first), []).append(each)
    for number, page in list(pages.items())[-1 if live else 0 :]:
        after = next((p[0] for k, p in pages.items() if k > number), following)
        camera.log_page(drawing, line, timebase, page, paths, top, until=after.frame_id if after else None, at=at)
    shown = seen[-1:] if live else seen
    camera.log_now(drawing, line, timebase, shown)
    camera.log_measured_profile(drawing, line, timebase, shown, top)
    for name, by_frame in paths.items():
        camera.log_path_profile(drawing, line, timebase, shown, name, by_frame, top, sensor.light_of(output))
    return top
