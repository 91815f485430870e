"""What is shown of two-dimensional frames, read back from the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from aolink.recording.deblur import write_deblurred
from aolink.recording.reader import Recording
from aolink.recording.reestimate import write_reestimated
from aolink.rig import load_rig
from aolink.viewing import save_rrd
from tests.recording.small import write_small
from tests.viewing.rrd import read_rrd
from tests.viewing.test_save import absent_from_views

N = 4
NAMES = ["o1", "open-loop"]


def spots(folder: Path, rig: str, names: list[str]) -> Recording:
    """A few exposures with estimates and restored frames."""
    bare = Recording(write_small(folder / "bare.mcap", N, rig=rig, truth=True))
    write_reestimated(bare, names, folder / "estimated.mcap")
    write_deblurred(Recording(folder / "estimated.mcap"), folder / "session.mcap", estimator="o1")
    return Recording(folder / "session.mcap")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return spots(tmp_path_factory.mktemp("spots"), "sh-4x4", NAMES)


@pytest.fixture(scope="module")
def saved(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_rrd(recording, tmp_path_factory.mktemp("rrd") / "spots.rrd")


def test_paths_of_all_spots_lie_in_their_blur(recording: Recording, saved: Path) -> None:
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


def test_frames_are_whole_and_every_estimator_has_its_paths(recording: Recording, saved: Path) -> None:
    entities = read_rrd(saved)
    buffers = entities["/camera/image"]["Image:buffer"]
    for exposure, (buffer,) in zip(recording.exposures(), buffers, strict=True):
        assert np.array_equal(np.array(buffer, dtype=np.uint8).view("<u2").reshape(96, 96), exposure.pixels)
    for name in NAMES:
        assert len(entities[f"/camera/image/path/{name}"]["LineStrips2D:strips"]) == N


def test_the_profile_is_that_of_the_first_spot_along_x(recording: Recording, saved: Path) -> None:
    (strip,) = read_rrd(saved)["/profile/measured"]["LineStrips2D:strips"][0]
    assert len(strip) == 2 * 24
    line = recording.rig.sensor.profile
    counts = recording[0].pixels[:24, :24].sum(axis=0, dtype=np.int64)
    density = (counts - line.black_level) / line.counts_per_density
    drawn = -np.array(strip)[::2, 1]
    np.testing.assert_allclose(drawn / drawn.max(), density / density.max(), atol=1e-6)


def test_no_view_is_empty(saved: Path) -> None:
    assert absent_from_views(saved) == []


@pytest.mark.slow
def test_windows_in_the_dark_have_no_paths(tmp_path: Path) -> None:
    rig = load_rig("sh-8x8")
    saved = save_rrd(spots(tmp_path, rig.name, ["o1"]), tmp_path / "pupil.rrd")
    (strips, *_) = read_rrd(saved)["/camera/image/path/truth"]["LineStrips2D:strips"]
    assert rig.optics is not None
    lit = np.argwhere(rig.optics.lenslets.light.reshape(8, 8) >= 0.4)
    where = np.array([np.mean(path, axis=0) for path in strips]) // 16
    np.testing.assert_array_equal(where[:, ::-1], lit)
