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
    "pixels": "the frames are not what kernel, light and noise make: `aolink calibrate`; a hot pixel: `sensor.defects`",
    "motion": "positions are not as predicted: the plant, a missing vibration or the timing: `aolink identify`",
    "zero": "positions are off to one side of the prediction: the zero: `aolink calibrate`",
    "": "`aolink calibrate` for the sensor, `aolink identify` for the plant, and check the trigger",
}
"""What to do, by the kind of the evidence."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Of the newest exposures of one estimator."""

    fit: Fit
    kind: str = ""
    """The kind of the evidence, a key of `ADVICE`; empty unless the model does not fit, or where it cannot be told."""
    pixels: float = 0.0
    """How far the pixels' residuals and the light are from what is expected, in standard errors."""
    motion: float = 0.0
    """The squared errors of the predicted mean positions beyond what is expected, in standard errors."""
    zero: float = 0.0
    """The mean of these errors, in standard errors."""
    nis: float = 0.0
    """The estimator's NIS beyond what is expected, in standard errors."""
    since: int = 0
    """Number of the frame with which ``fit`` became what it is."""
    exposures: int = 0
    """Exposures that were judged together."""
    widening: float = 1.0
    """Factor of this estimate's standard deviations; one unless the model does not fit."""

    def begins_with(self, frame_id: int) -> bool:
        """Whether it is this exposure with which the model no longer fits, or fits at last."""
        return self.fit is not Fit.UNKNOWN and self.since == frame_id

    @property
    def text(self) -> str:
        """The verdict in words."""
        if self.fit is Fit.UNKNOWN:
            return f"cannot tell yet whether the model fits ({self.exposures} exposures judged)"
        if self.fit is Fit.FITS:
            return "the model fits"
        kind = f" ({self.kind})" if self.kind else ""
        return f"the model does not fit{kind}: {ADVICE[self.kind]}; intervals are {self.widening:.2g} times as wide"
