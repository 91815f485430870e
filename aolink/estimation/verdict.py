"""The verdict whether the rig file's model fits the frames: plain data, and its words."""

from __future__ import annotations

import enum
from dataclasses import dataclass


class Fit(enum.IntEnum):
    """Whether the model fits. The numbers are those of the recording's schema."""

    UNKNOWN = 0
    """There were too few exposures, or the evidence is between the two."""
    FITS = 1
    DOES_NOT_FIT = 2


ADVICE = {
    "at fixed places": "a hot pixel, a second object or a background: `sensor.defects`, or subtract it",
    "in a ring about the spot": "the kernel: `aolink calibrate`",
    "at the ends of the blur": "light that changes in the exposure, or its timing: check the lamp and the trigger",
    "everywhere in the spot": "the noise or the light: `aolink calibrate`",
    "to one side of the prediction": "the zero: `aolink calibrate`",
    "from exposure to exposure": "the plant, a missing vibration or the timing: `aolink identify`, check the trigger",
}
"""What to do, by where the evidence is; the first four are of the pixels, the others of the motion."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Of the newest exposures of one estimator."""

    fit: Fit
    where: str = ""
    """Where the evidence is, a key of `ADVICE`; empty unless the model does not fit."""
    pixels: float = 0.0
    """The pixels' residuals beyond those of frames drawn from the fitted paths, in standard errors."""
    motion: float = 0.0
    """The squared errors with which the spot's positions were predicted, beyond what is expected, in standard errors;
    or those of their mean, if larger."""
    nis: float = 0.0
    """The estimator's NIS beyond what is expected, in the standard deviations that its sum has where the model fits."""
    since: int = 0
    """Number of the frame with which ``fit`` became what it is."""
    exposures: int = 0
    """Exposures whose pixels were compared."""
    widening: float = 1.0
    """Factor of this estimate's standard deviations; one unless the model does not fit."""

    @property
    def kind(self) -> str:
        """ "pixels" or "motion" where the model does not fit, otherwise empty."""
        return "" if not self.where else "pixels" if self.where in [*ADVICE][:4] else "motion"

    def begins_with(self, frame_id: int) -> bool:
        """Whether it is this exposure with which the model no longer fits, or fits at last."""
        return self.fit is not Fit.UNKNOWN and self.since == frame_id

    @property
    def text(self) -> str:
        """The verdict in words."""
        if self.fit is Fit.UNKNOWN:
            return f"cannot tell yet whether the model fits ({self.exposures} exposures compared)"
        if self.fit is Fit.FITS:
            return "the model fits"
        where = f"residuals {self.where}" if self.kind == "pixels" else f"positions are off {self.where}"
        what = f"the model does not fit ({self.kind}: {where}): {ADVICE[self.where]}"
        return f"{what}; intervals are {self.widening:.2g} times as wide"
