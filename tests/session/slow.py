"""An estimator of another package that takes a quarter of a second for an exposure."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from aolink.estimation import BlurFilter, EstimatorRow, PathMoments, Posterior
from aolink.extensions import installed

SLOW = "slow"
TAKES_S = 0.25


class _SlowFilter(BlurFilter):
    def step(self, *arguments: Any, **named: Any) -> Posterior:
        time.sleep(TAKES_S)
        return super().step(*arguments, **named)


ROW = EstimatorRow(
    name=SLOW, rank=5, colour=(90, 90, 90),
    build=lambda rig, options: _SlowFilter(rig.plant, PathMoments(rig.plant, (1, 2))),
)  # fmt: skip


@contextmanager
def slow_installed(folder: Path) -> Iterator[None]:
    """Its package is installed in this process, and in those that it starts."""
    metadata = folder / "slow-0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: slow\nVersion: 0\n")
    (metadata / "entry_points.txt").write_text(f"[aolink.estimators]\n{SLOW} = {__name__}:ROW\n")
    places = [str(folder), str(Path(__file__).parents[2])]
    with pytest.MonkeyPatch.context() as patched:
        for each in places:
            patched.syspath_prepend(each)
        patched.setenv("PYTHONPATH", os.pathsep.join(places))
        installed.cache_clear()
        yield
    installed.cache_clear()
