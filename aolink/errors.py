"""The errors that aolink raises on purpose, with one class for each kind.

Every message says what was found, what was expected and what to do; the command line prints it as
one line and exits with its ``exit_code``.
"""

from typing import TypeVar


class AolinkError(Exception):
    """Base of every error that aolink raises on purpose."""

    exit_code = 1


_Error = TypeVar("_Error", bound=AolinkError)


def wrong_usage(error: _Error) -> _Error:
    """The same error with the exit code of a wrong argument, for a name that does not exist."""
    error.exit_code = RigError.exit_code
    return error


class RigError(AolinkError):
    """A rig file that cannot be read, or that describes something that cannot work."""

    exit_code = 2


class PortError(AolinkError):
    """A port that cannot be opened, or that was lost while it was in use."""

    exit_code = 3


class DeviceError(AolinkError):
    """A device that does not answer, is another one than expected, or refuses a request."""

    exit_code = 4


class RecordingError(AolinkError):
    """A recording that cannot be written or read."""

    exit_code = 5


class EstimatorError(AolinkError):
    """An estimator that does not exist or cannot work on this rig."""

    exit_code = 6


class ViewerError(AolinkError):
    """A viewer that is not available on this machine, or a file that it cannot show."""

    exit_code = 7


class CalibrationError(AolinkError):
    """Frames that a calibration cannot use."""

    exit_code = 8


class FrameError(AolinkError):
    """A frame that cannot be measured: it has no spots, no grid of them, or is not a picture."""

    exit_code = 9


class RestorationError(AolinkError):
    """A picture that cannot be restored with this point spread function, or by this method."""

    exit_code = 10


class ImportingError(AolinkError):
    """A film or a telemetry file that cannot be read, or that does not fit the rig file."""

    exit_code = 11


class ExportError(AolinkError):
    """Exposures that cannot be exported in the requested form."""

    exit_code = 12


class ControlError(AolinkError):
    """A controller that does not exist, cannot work on this rig, or whose loop would be unstable."""

    exit_code = 13


class IdentificationError(AolinkError):
    """A model that cannot be identified from this recording, or with this kind of process."""

    exit_code = 14
