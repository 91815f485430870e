"""A recording as Rerun entities, part by part, and as a Rerun file with its layout inside."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr

from aolink.errors import ViewerError
from aolink.exposure import Exposure
from aolink.gathered import lacks
from aolink.recording import topics
from aolink.recording.reader import Restorations
from aolink.recording.side_files import check_stands_alone
from aolink.series import Also, Step
from aolink.viewing import camera, motion, scene
from aolink.viewing.blueprint import PATH_WINDOW
from aolink.viewing.look import APPLICATION, Look, identity
from aolink.viewing.palette import series_colour
from aolink.viewing.rrd_file import new_rrd
from aolink.viewing.sender import Sender, is_drawn
from aolink.viewing.series import Drawing

if TYPE_CHECKING:
    from aolink.recording.messages import RecordedMessage
    from aolink.recording.reader import Recording


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
        A part of it, or another spot; by default the whole recording.
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
    sources = [file for each in (recording, *look.loops.values()) for file in each.files]
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
    sender = RecordingSender(stream, recording, look)
    stream.send_recording_name(f"{recording.rig.name} · {recording.path.name}")
    alone = len(sender.numbers) == 1
    for done in sender.parts():
        if at_once:
            sender.lay_out(alone=alone)
            at_once = False
        yield done
    sender.lay_out(alone=alone)


class RecordingSender(Sender):
    """Sends a recording to a stream, part by part: no more than a part is in memory. Rerun itself keeps the places of
    what it has written, some 2 kB for each exposure."""

    def __init__(self, stream: rr.RecordingStream, recording: Recording, look: Look) -> None:
        check_stands_alone(recording)
        names = list(recording.estimators)
        super().__init__(Drawing(stream=stream, rig=recording.rig, estimators=names, spot=look.spot))
        self._recording, self._look = recording, look
        self.numbers = range(len(recording)) if look.exposures is None else look.exposures
        if len(self.numbers) <= 2 * PATH_WINDOW + 1:
            self.drawing.points = None

    def parts(self) -> Iterator[int]:
        """Send the exposures with all that belongs to them, then the devices; gives after each part how many exposures
        are sent."""
        recording, look, drawing = self._recording, self._look, self.drawing
        restorations, starts = Restorations(), dict[int, int]()
        shown = [topic for topic in recording.counts if is_drawn(topic)]
        also: dict[str, Callable[[str, int, Any], None]] = dict.fromkeys(Restorations.TOPICS, restorations.take)
        if look.exposures is None:
            also |= dict.fromkeys(shown, self.see)
        else:
            for each in self._messages_of_part(shown):
                self.see(each.topic, each.log_time_ns, each.message)
        for steps, following in self._read(also):
            timebase = self.send(steps, following=following)
            if topics.RESTORATION in recording.counts:
                starts |= {each.exposure.frame_id: each.exposure.first_step for each in steps}
                scene.log_restored(drawing, timebase, starts, list(restorations.whole()))
            yield self.sent
        if self.timebase is None:
            raise ViewerError(
                f"there is no exposure in {recording.path}, so nothing to view; `aolink info` says what it holds"
            )
        self.send(())
        scene.log_restored(drawing, self.timebase, starts, list(restorations.whole(ended=True)))
        for k, (name, loop) in enumerate(look.loops.items()):
            part = loop[look.exposures.start : look.exposures.stop] if look.exposures is not None else loop
            motion.log_residual(drawing, self.timebase, name, part, series_colour(k))
        scene.log_true_scene(drawing, recording.true_scene)
        part_of = ""
        if look.exposures is not None:
            part_of = f" ({self.numbers.start} to {self.numbers.stop - 1} of {len(recording)}, counted from 0)"
        self.say(part_of, lacks(recording))

    def _read(self, also: Also) -> Iterator[tuple[list[Step], Exposure | None]]:
        """Read parts: the exposures of whole pages, and the exposure after them."""
        rig, recording = self.drawing.rig, self._recording
        series = recording[self.numbers.start : self.numbers.stop] if self._look.exposures else recording
        size = rig.timing.exposure_steps * rig.n_outputs * 8 * (1 + 2 * len(self.drawing.estimators))
        pages = int(max(1, min(_PAGES, _BYTES_IN_PART // (camera.HISTORY * (size + 4 * np.prod(rig.sensor.shape))))))
        first: int | None = None
        part: list[Step] = []
        for step in series.steps(self.drawing.estimators, also=also):
            exposure = step.exposure
            if exposure.pixels.shape != rig.sensor.shape:
                raise ViewerError(
                    f"frame {exposure.frame_id} of {recording.path} has {exposure.pixels.shape} pixels, the"
                    f" sensor of the rig file in it {rig.sensor.shape}: it was recorded with another rig file"
                )
            first = exposure.frame_id if first is None else first
            ours, theirs = (-(-camera.page_of(e, first) // pages) for e in (exposure, (part or [step])[0].exposure))
            if ours != theirs:
                yield part, exposure
                part = []
            part.append(step)
        if part:
            yield part, None

    def _messages_of_part(self, wanted: Sequence[str]) -> Iterator[RecordedMessage]:
        """Messages of some topics that belong to the part of the recording."""
        recording, timing = self._recording, self.drawing.rig.timing
        if not wanted:
            return
        first, last = (recording[self.numbers[k]] for k in (0, -1))
        period = timing.frame_period_steps * timing.fast_step_ns
        low, high = first.host_start_ns - _BESIDE_NS, last.host_start_ns + period + _BESIDE_NS
        if high < recording.start_ns or low > recording.end_ns:  # the log has other times than its frames
            low, high = recording.start_ns, recording.end_ns + 1
        end, ended_ns = last.first_step + last.n_steps, last.host_start_ns + period
        for each in recording.messages(*wanted, start_ns=max(low, 0), end_ns=high):
            message: Any = each.message
            if each.topic in topics.RUNS:
                inside = message.first_step < end and message.first_step + message.n_steps > first.first_step
            elif (frame := getattr(message, "frame_id", None)) is not None:
                inside = first.frame_id <= frame <= last.frame_id
            else:
                inside = first.host_start_ns <= each.log_time_ns < ended_ns
            if inside:
                yield each
