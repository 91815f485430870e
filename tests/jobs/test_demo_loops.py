"""The demo with a controller: three sessions of one disturbance, and what each loop leaves of it in the viewer."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from aolink.exposure import residual_rms
from aolink.recording.reader import Recording
from tests.viewing.rrd import read_blueprint, read_rrd, scalars

EXPOSURES = 6
LOOPS = {"open": "open", "integrator": "integrator", "lqg": "session"}
"""The recording's name by what closed the loop."""


@pytest.mark.rare
def test_the_demo_shows_what_each_loop_leaves(
    aolink: Callable[..., subprocess.CompletedProcess[str]], tmp_path: Path
) -> None:
    done = aolink(
        "demo", "--rig", "tip-tilt", "--control", "lqg", "--exposures", str(EXPOSURES), "-o", tmp_path
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (folder,) = tmp_path.glob("demo-*")
    entities = read_rrd(folder / "session.rrd")
    starts = entities["/path/truth"]["time"][0] + 50_000_000 * np.arange(EXPOSURES)
    colours = set()
    for name, stem in LOOPS.items():
        drawn = entities[f"/residual/{name}"]
        paths = [each.truth.path for each in Recording(folder / f"{stem}.mcap") if each.truth is not None]
        left = [np.sqrt(np.mean(path**2)) for path in paths]
        assert len(left) == EXPOSURES
        np.testing.assert_allclose(scalars(drawn)[:, 0], left, rtol=1e-12)
        assert drawn["time"] == starts.tolist()
        assert [label for row in drawn["SeriesLines:names"] for label in row or []] == [name]
        colours |= {colour for row in drawn["SeriesLines:colors"] for colour in row or []}
        printed = residual_rms(Recording(folder / f"{stem}.mcap"))
        assert f"{name} {printed:.4g}" in done.stdout
    assert len(colours) == len(LOOPS)
    (shown,) = [
        row
        for view in read_blueprint(folder / "session.rrd").values()
        for row in view.get("ViewContents:query", [])
        if any("/residual/" in each for each in row)
    ]
    assert shown == ["+ /residual/**"]
