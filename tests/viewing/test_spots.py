"""What is shown of two-dimensional frames, read back from the file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from aolink.estimation import run
from aolink.estimation.estimate import Status
from aolink.restoration import deblur
from aolink.rig import Rig, load_rig
from aolink.series import NOTHING, Also, Series, Step
from aolink.simulation.model import simulate
from aolink.viewing import save_rrd
from tests.viewing.rrd import read_rrd
from tests.viewing.stand_in import as_recording
from tests.viewing.test_save import absent_from_views

N = 4
NAMES = ["o1", "open-loop"]


@dataclass
class Simulated(Series):
    """What `aolink.recording.reader.Recording` offers, of a rig that no device was part of."""

    rig: Rig
    names: list[str] = field(default_factory=lambda: NAMES)
    path: Path = Path("session.mcap")
    metadata: dict[str, str] = field(default_factory=dict)
    digest: str = "1" * 64
    files: tuple[Path, ...] = ()
    side_of: str = ""

    def __post_init__(self) -> None:
        Series.__init__(self, self)
        self._exposures = simulate(self.rig, N)
        self.made = run(self.rig, self._exposures, self.names)

    damage = ""
    has_truth = True

    @property
    def estimators(self) -> list[str]:
        return self.names

    def __len__(self) -> int:
        return N

    def steps(
        self, names: Sequence[str] = (), start: int = 0, stop: int | None = None, *, also: Also = NOTHING
    ) -> Iterator[Step]:
        for number in range(N)[start:stop]:
            its = {name: self.made[name][number] for name in names}
            yield Step(number, self._exposures[number], its)

    def messages(self, *topics: str) -> Iterator[Any]:
        return iter(())

    @property
    def counts(self) -> dict[str, int]:
        return {}

    def restored(self) -> Iterator[Any]:
        yield deblur(self.rig, self._exposures[0], self.made["o1"][0])

    true_scene = None


@pytest.fixture(scope="module")
def recording() -> Simulated:
    return Simulated(load_rig("sh-4x4"))


@pytest.fixture(scope="module")
def saved(recording: Simulated, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_rrd(as_recording(recording), tmp_path_factory.mktemp("rrd") / "spots.rrd")


def test_paths_of_all_spots_lie_in_their_blur(recording: Simulated, saved: Path) -> None:
    """Where the light of a window is, there the true path is: their means agree within a fraction of a pixel."""
    strips = read_rrd(saved)["/camera/image/path/truth"]["LineStrips2D:strips"]
    sensor = recording.rig.sensor
    assert [len(each) for each in strips] == [16] * N
    for exposure, paths in zip(recording.exposures(), strips, strict=True):
        light = np.maximum(exposure.pixels - sensor.black_level - 300.0, 0)  # above the noise
        for spot, (row, column) in enumerate(np.ndindex(4, 4)):
            window = light[24 * row : 24 * row + 24, 24 * column : 24 * column + 24]
            y, x = (np.indices(window.shape) * window).sum(axis=(1, 2)) / window.sum() + 0.5
            np.testing.assert_allclose(np.mean(paths[spot], axis=0), [x + 24 * column, y + 24 * row], atol=0.7)


def test_frames_are_whole_and_every_estimator_has_its_paths(recording: Simulated, saved: Path) -> None:
    entities = read_rrd(saved)
    buffers = entities["/camera/image"]["Image:buffer"]
    for exposure, (buffer,) in zip(recording.exposures(), buffers, strict=True):
        assert np.array_equal(np.array(buffer, dtype=np.uint8).view("<u2").reshape(96, 96), exposure.pixels)
    for name in NAMES:
        assert len(entities[f"/camera/image/path/{name}"]["LineStrips2D:strips"]) == N


def test_the_profile_is_that_of_the_first_spot_along_x(recording: Simulated, saved: Path) -> None:
    (strip,) = read_rrd(saved)["/profile/measured"]["LineStrips2D:strips"][0]
    assert len(strip) == 2 * 24
    line = recording.rig.sensor.profile
    counts = recording[0].pixels[:24, :24].sum(axis=0, dtype=np.int64)
    density = (counts - line.black_level) / line.counts_per_density
    drawn = -np.array(strip)[::2, 1]
    np.testing.assert_allclose(drawn / drawn.max(), density / density.max(), atol=1e-6)


def test_no_view_is_empty(saved: Path) -> None:
    missing = [each for each in absent_from_views(saved) if not each.startswith(("/connection", "/mirror"))]
    assert missing == []


@pytest.mark.slow
def test_windows_in_the_dark_have_no_paths(tmp_path: Path) -> None:
    rig = load_rig("sh-8x8")
    saved = save_rrd(as_recording(Simulated(rig, ["o1"])), tmp_path / "pupil.rrd")
    (strips, *_) = read_rrd(saved)["/camera/image/path/truth"]["LineStrips2D:strips"]
    assert rig.optics is not None
    lit = np.argwhere(rig.optics.lenslets.light.reshape(8, 8) >= 0.4)
    where = np.array([np.mean(path, axis=0) for path in strips]) // 16
    np.testing.assert_array_equal(where[:, ::-1], lit)


def test_the_session_page_says_how_many_exposures_were_gated(tmp_path: Path) -> None:
    recording = Simulated(load_rig("sh-4x4"))
    o1 = recording.made["o1"]
    o1[1:3] = [replace(o1[1], status=Status.GATED), replace(o1[2], status=Status.DIVERGED)]
    entities = read_rrd(save_rrd(as_recording(recording), tmp_path / "gated.rrd"))
    rows = [row.split("|") for row in entities["/session"]["TextDocument:text"][0][0].splitlines() if "|" in row]
    gated = {row[1].strip(): row[-2].strip() for row in rows}
    assert gated["estimator"] == "gated"
    assert gated["o1"] == "2 of 4"
    assert gated["open-loop"] == "0 of 4"
