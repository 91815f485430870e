"""python-microscope's own simulated deformable mirror, which keeps a record of what it held since when."""

from __future__ import annotations

import time
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tests.needs import needed

needed("microscope")

from microscope.simulators import SimulatedDeformableMirror  # noqa: E402


class WatchedMirror(SimulatedDeformableMirror):  # type: ignore[misc]
    """The latest one that was made is ``WatchedMirror.latest``."""

    latest: ClassVar[WatchedMirror]

    def __init__(self, **settings: Any) -> None:
        self.held: list[tuple[int, tuple[float, ...]]] = []
        self.is_shut_down = False
        super().__init__(**settings)
        WatchedMirror.latest = self

    def _do_apply_pattern(self, pattern: NDArray[np.float64]) -> None:
        super()._do_apply_pattern(pattern)
        self.held.append((time.monotonic_ns(), tuple(pattern.tolist())))

    def _do_shutdown(self) -> None:
        super()._do_shutdown()
        self.is_shut_down = True
