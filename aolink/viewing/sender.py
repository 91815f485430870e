"""Sends exposures with what belongs to them: some at once, or one after the other."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from aolink.exposure import Exposure
from aolink.gathered import has_pupil, lost_before
from aolink.series import Step
from aolink.viewing import camera, incidents, motion, pupil, scene
from aolink.viewing.series import Drawing
from aolink.viewing.timebase import Timebase


class Sender:
    """Sends what is drawn of exposures and their estimates; a drawing's estimators are those that are sent."""

    def __init__(self, drawing: Drawing) -> None:
        self.drawing = drawing
        self.timebase: Timebase | None = None
        self.last: Exposure | None = None
        """The last exposure that was sent."""
        self.sent = self.lost = 0
        """Exposures that have been sent, and frames lost between them."""

    def send(
        self, steps: Sequence[Step], *, following: Exposure | None = None, page: Sequence[Step] = (),
        late: Collection[Step] = (),
    ) -> Timebase:  # fmt: skip
        """Send the next exposures; gives their timebase.

        Parameters
        ----------
        following:
            The exposure after them, where it is known.
        page:
            In a live session the last exposures, as many as a page has, with this one.
        late:
            Earlier exposures with the estimates that have come since.
        """
        drawing, exposures = self.drawing, [each.exposure for each in steps]
        before = self.timebase
        timebase = self.timebase = before.followed_by(exposures) if before else Timebase.of(drawing.rig, exposures)
        camera.log_camera(drawing, timebase, page or steps, following=following, live=bool(page))
        motion.log_truth(drawing, timebase, steps)
        incidents.log_exposures(drawing, timebase, exposures, self.last)
        incidents.log_warnings(drawing, timebase, steps, self.last)
        for name in drawing.estimators:
            for some in (*([each] for each in late), steps):  # one by one: what is between may come later still
                motion.log_estimates(drawing, timebase, name, some)
                incidents.log_status(drawing, timebase, name, some)
        if has_pupil(drawing.rig) and not page:
            pupil.log_maps(drawing, timebase, steps)
        scene.log_scenes(drawing, timebase, exposures)
        self.lost += lost_before(exposures, self.last)
        self.last, self.sent = exposures[-1], self.sent + len(exposures)
        return timebase
