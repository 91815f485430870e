"""A viewer that is fed: by a session as it goes on, exposure by exposure, or by a recording as it is read."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from aolink.colours import by_rank
from aolink.errors import ViewerError
from aolink.estimation import Estimate
from aolink.exposure import Exposure
from aolink.restoration import deblur
from aolink.rig import Rig
from aolink.viewing import incidents, motion, scene
from aolink.viewing.blueprint import Contents, blueprint
from aolink.viewing.camera import HISTORY
from aolink.viewing.save import APPLICATION, Look, identity, send_camera, sent_parts
from aolink.viewing.series import Chosen, Drawing
from aolink.viewing.timebase import Timebase
from aolink.viewing.viewer import Server, has_display, serving, window

if TYPE_CHECKING:
    from aolink.recording.reader import Recording

_FLUSH_S = 60.0
"""For what the viewer has not taken yet at the end."""


class LiveView:
    """Sends exposures with their estimates to a viewer, one after the other.

    An estimate may come with a later exposure than its own, where it took long.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        rig: Rig,
        estimators: Sequence[str],
        true_scene: NDArray[np.uint16] | None = None,
    ) -> None:
        self._drawing = Drawing(stream=stream, chosen=Chosen.of(rig))
        self._rig, self._names = rig, by_rank(list(estimators))
        self._exposures: list[Exposure] = []
        """The last ones, as many as a page has."""
        self._estimates: dict[str, list[Estimate]] = {name: [] for name in self._names}
        self._timebase: Timebase | None = None
        self._top: float | None = None
        self._scenes: list[str] = []
        """What is shown of the scene."""
        self._measuring: set[str] = set()
        """Estimators that have an innovation."""
        self._true_scene = true_scene

    def show(self, exposure: Exposure, estimates: Sequence[Estimate]) -> None:
        """Show the next exposure."""
        self._exposures = [*self._exposures[-HISTORY + 1 :], exposure]
        for each in estimates:
            self._estimates[each.estimator] = [*self._estimates[each.estimator][-HISTORY + 1 :], each]
        if self._timebase is None:
            self._timebase = Timebase.of(self._rig, [exposure])
        drawing, timebase, first = self._drawing, self._timebase, self._top is None
        names = [*(["truth"] if exposure.truth is not None else ()), *self._names]
        known = {name: {e.frame_id: e for e in sequence} for name, sequence in self._estimates.items()}
        self._top = send_camera(
            drawing, self._rig, timebase, self._exposures, known, names, top=self._top, live=True
        )  # fmt: skip
        motion.log_truth(drawing, timebase, [exposure])
        truths = {exposure.frame_id: exposure.truth} if exposure.truth is not None else {}
        before = self._exposures[-2] if len(self._exposures) > 1 else None
        incidents.log_exposures(drawing, timebase, [exposure], before)
        now = {each.estimator: {each.frame_id: each} for each in estimates}
        incidents.log_warnings(drawing, timebase, [exposure], now, {}, before)
        for each in estimates:
            motion.log_estimates(drawing, timebase, [each])
            motion.log_errors(drawing, timebase, [each], truths)
            its = [e for e in self._exposures if e.frame_id == each.frame_id]
            incidents.log_status(drawing, timebase, each.estimator, its, now[each.estimator])
        shown = self._show_scene(exposure, estimates)
        measuring = {each.estimator for each in estimates if each.innovation.shape[1]} - self._measuring
        if first or measuring or shown != self._scenes:
            self._scenes = shown
            self._measuring |= measuring
            self._lay_out(exposure)

    def _show_scene(self, exposure: Exposure, estimates: Sequence[Estimate]) -> list[str]:
        """The scene as it came and restored with the last estimator's path; gives all that was shown of it by now."""
        sensor, timebase = self._rig.scene, self._timebase
        shown = set(self._scenes)
        if sensor is None or timebase is None or exposure.scene is None:
            return self._scenes
        scene.log_scenes(self._drawing, sensor, timebase, [exposure])
        shown.add(scene.SCENE)
        focus = [each for each in estimates if each.estimator == self._names[-1] and each.frame_id == exposure.frame_id]
        if focus:
            done = deblur(self._rig, exposure, focus[0])
            if scene.log_restored(self._drawing, timebase, [exposure], [done]):
                shown.add(scene.RESTORED_SCENE)
        if self._true_scene is not None and scene.TRUE_SCENE not in shown:
            scene.log_true_scene(self._drawing, sensor, self._true_scene)
            shown.add(scene.TRUE_SCENE)
        return [path for path in scene.SCENES if path in shown]

    def _lay_out(self, exposure: Exposure) -> None:
        contents = Contents(
            rig=self._rig,
            estimators=self._names,
            measuring=[name for name in self._names if name in self._measuring],
            density_top=self._top or 1.0,
            truth=exposure.truth is not None,
            scenes=self._scenes,
            drawn=self._drawing,
            warnings=True,
        )
        self._drawing.stream.send_blueprint(blueprint(contents), make_active=True, make_default=True)


@contextmanager
def live_viewer(
    rig: Rig, estimators: Sequence[str], true_scene: NDArray[np.uint16] | None = None
) -> Iterator[LiveView]:
    """Open the native viewer and give what feeds it; the viewer stays until its window is closed.

    Raises
    ------
    ViewerError
        There is no display, or the viewer does not start.
    """
    if not has_display():
        raise ViewerError("there is no display for --view: record or replay without it, then `aolink view --web`")
    with window() as server, fed(server) as stream:
        yield LiveView(stream, rig, estimators, true_scene)


@contextmanager
def fed(server: Server, recording_id: str | None = None) -> Iterator[rr.RecordingStream]:
    """A stream into a viewer, which stays after the block until it is closed.

    Raises `ViewerError` where the viewer takes nothing any more.
    """
    stream = rr.RecordingStream(APPLICATION, recording_id=recording_id)
    stream.connect_grpc(server.data_address)
    try:
        yield stream
        # Without a bound for it, a viewer that takes nothing would be waited for without end, and no signal heard.
        flushing = threading.Thread(target=stream.flush, daemon=True)
        flushing.start()
        flushing.join(_FLUSH_S)
        if flushing.is_alive() and server.process.poll() is None:
            server.process.kill()
            raise ViewerError(f"the viewer has taken nothing for {_FLUSH_S:g} s, and was ended")
        server.process.wait()
    finally:
        stream.disconnect()


def show(recording: Recording, look: Look | None = None, *, progress: Callable[[int], None] | None = None) -> None:
    """Open a recording in the native viewer while it is read, and wait until the window is closed.

    Parameters
    ----------
    look:
        A part of it, another spot, or another recording beside it; by default all of it alone.
    progress:
        Is told how many exposures have been sent.

    Raises
    ------
    ViewerError
        There is no display, the viewer does not start, or the recording has nothing to show.
    """
    with window() as server:
        _feed(server, recording, look or Look(), progress)


def serve(
    recording: Recording, look: Look | None = None, *, port: int | None = None,
    on_ready: Callable[[str], None] | None = None, progress: Callable[[int], None] | None = None,
) -> None:  # fmt: skip
    """Serve a recording with the web viewer on this machine's loopback until interrupted, from when it is being read.

    Parameters are those of `show` and of `serve_web`. Raises `ViewerError`.
    """
    with serving((), port) as server:
        if on_ready is not None:
            on_ready(server.address)
        _feed(server, recording, look or Look(), progress)


def _feed(server: Server, recording: Recording, look: Look, progress: Callable[[int], None] | None) -> None:
    with fed(server, identity(recording, look)) as stream:
        for done in sent_parts(stream, recording, look, at_once=True):
            if server.process.poll() is not None:
                return  # its window was closed
            if progress:
                progress(done)
