"""python-microscope's own simulated deformable mirror, which can fail and keeps a record of what it held since when."""

from __future__ import annotations

import time
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tests.needs import needed

needed("microscope")

from microscope.simulators import SimulatedDeformableMirror  # noqa: E402


class WatchedMirror(SimulatedDeformableMirror):  # type: ignore[misc]
    """The latest one that was made is ``WatchedMirror.latest``.

    Parameters
    ----------
    fails:
        First pattern, counted from 0, that it does not take, and the first one after that which it takes again.
    keeps_on:
        Whether it cannot be shut down at the first try.
    """

    latest: ClassVar[WatchedMirror]

    def __init__(self, fails: tuple[int, float] = (0, 0), keeps_on: bool = False, **settings: Any) -> None:
        self._fails_within, self._keeps_on, self._n_sent = fails, keeps_on, 0
        self.held: list[tuple[int, tuple[float, ...]]] = []
        self.is_shut_down = False
        super().__init__(**settings)
        WatchedMirror.latest = self

    def _do_apply_pattern(self, pattern: NDArray[np.float64]) -> None:
        first, end = self._fails_within
        self._n_sent += 1
        if first < self._n_sent <= end:
            raise RuntimeError("the vendor's library: no answer from the electronics")
        super()._do_apply_pattern(pattern)
        self.held.append((time.monotonic_ns(), tuple(pattern.tolist())))

    def _do_shutdown(self) -> None:
        super()._do_shutdown()
        self.is_shut_down = True
        if self._keeps_on:
            self._keeps_on = False  # the library tries again as it is thrown away
            raise RuntimeError("the vendor's library: cannot be shut down")
