"""A session or a replay as it goes on, in a viewer: the functions that show a file, fed exposure by exposure."""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from aolink.errors import ViewerError
from aolink.estimation import Estimate
from aolink.exposure import Exposure
from aolink.recording.deblur import deblur
from aolink.rig import Rig
from aolink.viewing import motion, scene
from aolink.viewing.blueprint import Contents, blueprint
from aolink.viewing.camera import HISTORY
from aolink.viewing.palette import by_rank
from aolink.viewing.save import APPLICATION, send_camera
from aolink.viewing.timebase import Timebase
from aolink.viewing.viewer import HOST, free_port, running_rerun, wait_for_server


class LiveView:
    """Sends exposures with their estimates to a viewer, one after the other."""

    def __init__(
        self,
        stream: rr.RecordingStream,
        rig: Rig,
        estimators: Sequence[str],
        true_scene: NDArray[np.uint16] | None = None,
    ) -> None:
        self._stream, self._rig, self._names = stream, rig, by_rank(list(estimators))
        self._exposures: list[Exposure] = []
        """The last ones, as many as the picture of the last exposures shows."""
        self._estimates: dict[str, list[Estimate]] = {name: [] for name in self._names}
        self._timebase: Timebase | None = None
        self._top: float | None = None
        self._scenes: list[str] = []
        """What is shown of the scene."""
        self._true_scene = true_scene

    def show(self, exposure: Exposure, estimates: Sequence[Estimate]) -> None:
        """Show the next exposure."""
        self._exposures = [*self._exposures[-HISTORY + 1 :], exposure]
        for each in estimates:
            self._estimates[each.estimator] = [*self._estimates[each.estimator][-HISTORY + 1 :], each]
        if self._timebase is None:
            self._timebase = Timebase.of(self._rig, [exposure])
        since, stream, timebase = len(self._exposures) - 1, self._stream, self._timebase
        first = self._top is None
        self._top = send_camera(
            stream, self._rig, timebase, self._exposures, self._estimates, top=self._top, since=since
        )  # fmt: skip
        motion.log_truth(stream, timebase, [exposure])
        truths = {exposure.frame_id: exposure.truth} if exposure.truth is not None else {}
        for each in estimates:
            motion.log_estimates(stream, timebase, [each])
            motion.log_errors(stream, timebase, [each], truths)
        shown = self._show_scene(exposure, estimates)
        if first or shown != self._scenes:
            self._scenes = shown
            self._lay_out(exposure, estimates)

    def _show_scene(self, exposure: Exposure, estimates: Sequence[Estimate]) -> list[str]:
        """The scene as it came and restored with the last estimator's path; gives all that was shown of it by now."""
        sensor, timebase = self._rig.scene, self._timebase
        shown = set(self._scenes)
        if sensor is None or timebase is None or exposure.scene is None:
            return self._scenes
        scene.log_scenes(self._stream, sensor, timebase, [exposure])
        shown.add(scene.SCENE)
        focus = [each for each in estimates if self._names and each.estimator == self._names[-1]]
        if focus:
            done = deblur(self._rig, exposure, focus[0])
            if scene.log_restored(self._stream, timebase, [exposure], [done]):
                shown.add(scene.RESTORED_SCENE)
        if self._true_scene is not None and scene.TRUE_SCENE not in shown:
            scene.log_true_scene(self._stream, sensor, self._true_scene)
            shown.add(scene.TRUE_SCENE)
        return [path for path in (scene.SCENE, scene.RESTORED_SCENE, scene.TRUE_SCENE) if path in shown]

    def _lay_out(self, exposure: Exposure, estimates: Sequence[Estimate]) -> None:
        contents = Contents(
            rig=self._rig,
            estimators=self._names,
            measuring=[each.estimator for each in estimates if each.innovation.shape[1]],
            density_top=self._top or 1.0,
            truth=exposure.truth is not None,
            scenes=self._scenes,
            restored_spots=False,
            commands=False,
            clock=False,
            link=False,
            latency=False,
            log=False,
        )
        self._stream.send_blueprint(blueprint(contents), make_active=True, make_default=True)


class Decimating:
    """Shows on a thread of its own what it has time for; whoever hands over never waits.

    Of what comes while it is busy it shows the newest, and counts the rest.
    """

    def __init__(self, view: LiveView) -> None:
        self.skipped = 0
        """Exposures that were not shown."""
        self._view = view
        self._next: tuple[Exposure, Sequence[Estimate]] | None = None
        self._changed = threading.Condition()
        self._closed = False
        self._failed: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="aolink-viewer", daemon=True)
        self._thread.start()

    def show(self, exposure: Exposure, estimates: Sequence[Estimate]) -> None:
        """Hand over the next exposure."""
        with self._changed:
            self.skipped += self._next is not None
            self._next = (exposure, estimates)
            self._changed.notify()

    def close(self) -> None:
        """Show what is waiting, and end. Raises what went wrong while showing."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        if self._failed is not None:
            raise ViewerError(f"the live view ended: {self._failed}") from self._failed

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._next is not None or self._closed)
                waiting, self._next = self._next, None
            if waiting is None:
                return
            try:
                self._view.show(*waiting)
            except Exception as error:  # a session must not end for its picture
                self._failed = self._failed or error


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
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError("there is no display for --view: record or replay without it, then `aolink view --web`")
    port = free_port()
    with tempfile.TemporaryFile() as said, running_rerun(["--port", str(port)], said) as process:
        wait_for_server(port, process, said)
        stream = rr.RecordingStream(APPLICATION)
        stream.connect_grpc(f"rerun+http://{HOST}:{port}/proxy")
        try:
            yield LiveView(stream, rig, estimators, true_scene)
            stream.flush()
            process.wait()
        finally:
            stream.disconnect()
