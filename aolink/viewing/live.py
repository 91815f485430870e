"""A viewer that a session feeds as it goes on, exposure by exposure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from aolink.colours import by_rank
from aolink.estimation import Estimate
from aolink.exposure import Exposure
from aolink.restoration import deblur
from aolink.rig import Rig
from aolink.series import Step
from aolink.viewing import entities, scene
from aolink.viewing.blueprint import blueprint
from aolink.viewing.camera import HISTORY
from aolink.viewing.feed import fed
from aolink.viewing.process import check_display, window
from aolink.viewing.sender import Sender
from aolink.viewing.series import Drawing


class LiveView:
    """Sends exposures with their estimates to a viewer, one after the other.

    An estimate that took long may come with a later exposure than its own, of the same page.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        rig: Rig,
        estimators: Sequence[str],
        true_scene: NDArray[np.uint16] | None = None,
    ) -> None:
        self._drawing = Drawing(stream=stream, rig=rig, estimators=by_rank(list(estimators)))
        self._sender = Sender(self._drawing)
        self._page: list[Step] = []
        """The last exposures, as many as a page has."""
        self._laid_out: set[str] = set()
        """The entities for which there is a layout."""
        self._true_scene = true_scene

    def show(self, exposure: Exposure, estimates: Sequence[Estimate]) -> None:
        """Show the next exposure."""
        step, drawing = Step(exposure.frame_id, exposure), self._drawing
        self._page = [*self._page[-HISTORY + 1 :], step]
        known, late = {each.exposure.frame_id: each for each in self._page}, []
        for each in estimates:
            if (its := known.get(each.frame_id)) is not None:
                its.estimates[each.estimator] = each
                if its is not step:
                    late.append(Step(its.number, its.exposure, {each.estimator: each}))
        timebase = self._sender.send([step], page=self._page, late=sorted(late, key=lambda each: each.number))
        if exposure.scene is not None and drawing.rig.scene is not None:
            if drawing.estimators and (focus := step.estimates.get(drawing.estimators[-1])) is not None:
                starts = {exposure.frame_id: exposure.first_step}
                scene.log_restored(drawing, timebase, starts, [deblur(drawing.rig, exposure, focus)])
            if not drawing.has(entities.TRUE_SCENE):
                scene.log_true_scene(drawing, self._true_scene)
        if drawing.sent != self._laid_out:
            self._laid_out = set(drawing.sent)
            drawing.stream.send_blueprint(blueprint(drawing), make_active=True, make_default=True)


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
    check_display("there is no display for --view: record or replay without it, then `aolink view --web`")
    with window() as server, fed(server) as stream:
        yield LiveView(stream, rig, estimators, true_scene)
