"""A session or a replay as it goes on, in a viewer: the functions that show a file, fed exposure by exposure."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from aolink.colours import by_rank
from aolink.errors import ViewerError
from aolink.estimation import Estimate
from aolink.exposure import Exposure
from aolink.restoration import deblur
from aolink.rig import Rig
from aolink.viewing import motion, scene
from aolink.viewing.blueprint import Contents, blueprint
from aolink.viewing.camera import HISTORY
from aolink.viewing.save import APPLICATION, send_camera
from aolink.viewing.timebase import Timebase
from aolink.viewing.viewer import HOST, free_port, has_display, running_rerun, wait_for_server

_FLUSH_S = 5.0
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
        self._stream, self._rig, self._names = stream, rig, by_rank(list(estimators))
        self._exposures: list[Exposure] = []
        """The last ones, as many as the picture of the last exposures shows."""
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
        scene.log_scenes(self._stream, sensor, timebase, [exposure])
        shown.add(scene.SCENE)
        focus = [each for each in estimates if each.estimator == self._names[-1] and each.frame_id == exposure.frame_id]
        if focus:
            done = deblur(self._rig, exposure, focus[0])
            if scene.log_restored(self._stream, timebase, [exposure], [done]):
                shown.add(scene.RESTORED_SCENE)
        if self._true_scene is not None and scene.TRUE_SCENE not in shown:
            scene.log_true_scene(self._stream, sensor, self._true_scene)
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
        )
        self._stream.send_blueprint(blueprint(contents), make_active=True, make_default=True)


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
    port = free_port()
    with tempfile.TemporaryFile() as said, running_rerun(["--port", str(port)], said) as process:
        wait_for_server(port, process, said)
        stream = rr.RecordingStream(APPLICATION)
        stream.connect_grpc(f"rerun+http://{HOST}:{port}/proxy")
        try:
            yield LiveView(stream, rig, estimators, true_scene)
            # Without a bound for it, a viewer that takes nothing would be waited for without end, and no signal heard.
            flushing = threading.Thread(target=stream.flush, daemon=True)
            flushing.start()
            flushing.join(_FLUSH_S)
            if flushing.is_alive():
                process.kill()
                raise ViewerError(f"the viewer has taken nothing for {_FLUSH_S:g} s, and was ended")
            process.wait()
        finally:
            stream.disconnect()
