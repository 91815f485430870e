"""Slopes of real frames: a telescope's Shack-Hartmann sensor, its reference, and two frames that show nothing."""

import json

import numpy as np
import pytest
from scipy import ndimage

from aolink.errors import FrameError
from aolink.frame_file import read_frame
from aolink.optics.lattice import find_lattice
from aolink.optics.maxima import cut_windows, flatten
from aolink.slopes import measure_files, measure_slopes


@pytest.fixture(scope="module")
def measured(mmirs):
    return measure_files(mmirs / "mmirs_wfs_0150.fits.gz", mmirs / "mmirs_camera2_ref.fits.gz")


def test_the_reference_has_its_lenslets(measured):
    reference = measured.reference
    assert reference.shape == (17, 17)
    assert len(reference.spots) == 241
    np.testing.assert_array_equal(reference.lit, reference.lit[::-1, ::-1])  # a round pupil
    assert np.abs(reference.displacements).max() < 1.5


def test_the_pitch_is_the_period_of_the_frame(mmirs, measured):
    # Independent of spots: the spectrum of the frame's sums has its line at one over the pitch.
    flat = np.clip(flatten(read_frame(mmirs / "mmirs_wfs_0150.fits.gz"))[0], 0, 300)
    for axis, step in ((0, measured.lattice.column_step[0]), (1, measured.lattice.row_step[1])):
        periods = np.linspace(18, 28, 1001)
        profile = flat.sum(axis=axis) - flat.sum(axis=axis).mean()
        power = np.abs(np.exp(-2j * np.pi * np.arange(512) / periods[:, None]) @ profile)
        assert periods[power.argmax()] == pytest.approx(step, rel=0.01)


def test_spots_are_where_another_library_sees_them(mmirs, measured):
    flat, _ = flatten(read_frame(mmirs / "mmirs_wfs_0150.fits.gz"))
    windows, corners = cut_windows(flat, measured.lattice.spots, 5)
    windows = np.where(windows > 0.3 * windows.max(axis=(1, 2), keepdims=True), windows, 0)
    theirs = corners + [ndimage.center_of_mass(w)[::-1] for w in windows]
    away = np.linalg.norm(theirs - measured.lattice.spots, axis=1)
    assert np.median(away) < 0.2
    assert np.quantile(away, 0.95) < 0.8


def test_the_telescope_is_out_of_focus(measured):
    # The frame's grid is smaller than the reference's: focus, whose wavefront is a paraboloid.
    assert len(measured.lattice.spots) == 156
    shrink = measured.lattice.pitch / measured.reference.pitch - 1
    assert shrink == pytest.approx(-0.027, abs=0.003)
    row, column = np.nonzero(np.isfinite(measured.wavefront))
    x, y = column - column.mean(), row - row.mean()
    design = np.stack([np.ones_like(x), x, y, x**2 + y**2, x**2 - y**2, x * y], axis=1)
    fit, *_ = np.linalg.lstsq(design, measured.wavefront[row, column], rcond=None)
    # A step's displacement is shrink x pitch, and the paraboloid's slope 2 a x; what is not focus shares in both.
    assert fit[3] == pytest.approx(shrink * measured.reference.pitch / 2, rel=0.2)
    left = measured.wavefront[row, column] - design @ fit
    assert left.std() < 0.2 * measured.rms


def test_the_wavefronts_differences_are_the_slopes(measured):
    w, s = measured.wavefront, measured.slopes
    difference = w[:, 1:] - w[:, :-1]
    mean = (s[:, 1:, 0] + s[:, :-1, 0]) / 2
    both = np.isfinite(difference)
    assert np.corrcoef(difference[both], mean[both])[0, 1] > 0.97


def test_real_units_scale_by_the_optics(mmirs, measured):
    paths = mmirs / "mmirs_wfs_0150.fits.gz", mmirs / "mmirs_camera2_ref.fits.gz"
    real = measure_files(*paths, pitch_m=600e-6, focal_m=40e-3)
    per_pixel = 600e-6 / measured.reference.pitch / 40e-3
    np.testing.assert_allclose(real.slopes, measured.slopes * per_pixel)
    np.testing.assert_allclose(real.wavefront, measured.wavefront * per_pixel * 600e-6)
    assert real.in_metres


@pytest.mark.parametrize("name", ["blank", "bogus"])
def test_frames_that_show_no_spots_are_refused(mmirs, name):
    with pytest.raises(FrameError, match="the frame: no grid"):
        measure_files(mmirs / f"mmirs_{name}.fits.gz", mmirs / "mmirs_camera2_ref.fits.gz")


def test_frames_of_two_cameras_are_refused():
    with pytest.raises(FrameError, match="one camera's"):
        measure_slopes(np.zeros((64, 64)), np.zeros((64, 65)))


def test_a_frame_against_itself_is_flat(mmirs):
    frame = read_frame(mmirs / "mmirs_camera2_ref.fits.gz")
    same = measure_slopes(frame, frame)
    assert np.nanmax(np.abs(same.wavefront)) < 1e-9
    moved = measure_slopes(np.roll(frame, (2, 3), (0, 1)), frame)
    np.testing.assert_allclose(moved.shift_px, [3, 2], atol=0.02)
    assert moved.rms < 0.05
    assert len(find_lattice(frame).spots) == len(moved.lattice.spots)


def test_the_command_prints_and_writes(aolink, mmirs, tmp_path):
    reference = str(mmirs / "mmirs_camera2_ref.fits.gz")
    done = aolink(
        "slopes", mmirs / "mmirs_wfs_0150.fits.gz", "--reference", reference, "-o", "s.npz", "--rrd", "s.rrd", "--json"
    )
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert said["spots"] == 156
    with np.load(tmp_path / "s.npz") as file:
        assert file["wavefront"].shape == (17, 17)
        assert np.nanstd(file["wavefront"]) == pytest.approx(said["wavefront_rms"])
    assert (tmp_path / "s.rrd").stat().st_size > 10_000
    refused = aolink("slopes", mmirs / "mmirs_blank.fits.gz", "--reference", reference)
    assert refused.returncode == 9
    assert refused.stderr.count("\n") == 1
    assert "no grid" in refused.stderr
