"""A viewer that a session feeds as it goes on, exposure by exposure."""

from __future__ import annotations

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
from aolink.viewing import entities, incidents, motion, scene
from aolink.viewing.blueprint import Contents, blueprint
from aolink.viewing.camera import HISTORY
from aolink.viewing.feed import fed
from aolink.viewing.process import has_display, window
from aolink.viewing.save import send_camera
from aolink.viewing.series import Chosen, Drawing
from aolink.viewing.timebase import Timebase


class LiveView:
    """Sends exposures with their estimates to a viewer, one after the other.

    An estimate that took long may come with a later exposure than its own.
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
        """The last exposures, as many as a page has."""
        self._estimates: dict[str, list[Estimate]] = {name: [] for name in self._names}
        self._timebase: Timebase | None = None
        self._top: float | None = None
        self._scenes: list[str] = []
        """The entities that are shown of the scene."""
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
        """Show the scene as it came, and restored with the last estimator's path; gives all entities of it that were
        shown so far."""
        sensor, timebase = self._rig.scene, self._timebase
        shown = set(self._scenes)
        if sensor is None or timebase is None or exposure.scene is None:
            return self._scenes
        scene.log_scenes(self._drawing, sensor, timebase, [exposure])
        shown.add(entities.SCENE)
        focus = [each for each in estimates if each.estimator == self._names[-1] and each.frame_id == exposure.frame_id]
        if focus:
            done = deblur(self._rig, exposure, focus[0])
            if scene.log_restored(self._drawing, timebase, {exposure.frame_id: exposure.first_step}, [done]):
                shown.add(entities.RESTORED_SCENE)
        if self._true_scene is not None and entities.TRUE_SCENE not in shown:
            scene.log_true_scene(self._drawing, sensor, self._true_scene)
            shown.add(entities.TRUE_SCENE)
        return [path for path in entities.SCENES if path in shown]

    def _lay_out(self, exposure: Exposure) -> None:
        contents = Contents(
            rig=self._rig, estimators=self._names,
            measuring=[name for name in self._names if name in self._measuring], density_top=self._top or 1.0,
            truth=exposure.truth is not None, scenes=self._scenes, drawn=self._drawing, warnings=True,
        )  # fmt: skip
        self._drawing.stream.send_blueprint(blueprint(contents), make_active=True, make_default=True)


@contextmanager
def live_viewer(
    rig: Rig, estimators: Sequence[str], true_scene: NDArray[np.uint16] | None = None
) -> Iterator[LiveView]:
    """Open the native viewer and give a `LiveView` that feeds it; the viewer stays open until its window is closed.

    Raises
    ------
    ViewerError
        There is no display, or the viewer does not start.
    """
    if not has_display():
        raise ViewerError("there is no display for --view: record or replay without it, then `aolink view --web`")
    with window() as server, fed(server) as stream:
        yield LiveView(stream, rig, estimators, true_scene)
