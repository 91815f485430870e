"""Slopes of real frames: a telescope's Shack-Hartmann sensor, its reference, and two frames that show nothing."""

import json

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image
from scipy import ndimage
from scipy.special import ndtr

from aolink.errors import FrameError
from aolink.films.pictures import read_frame
from aolink.optics.lattice import find_lattice
from aolink.optics.maxima import cut_windows, flatten
from aolink.optics.slopes import measure_files, measure_slopes
from aolink.optics.zernike import zernike, zernike_gradient
from tests.spot_frames import as_dtype, nodes_and_places, spots_frame


@pytest.fixture(scope="module")
def measured(mmirs):
    return measure_files(mmirs / "mmirs_wfs_0150.fits.gz", mmirs / "mmirs_camera2_ref.fits.gz")


@pytest.mark.slow
def test_the_reference_has_its_lenslets(measured):
    reference = measured.reference
    assert reference.shape == (17, 17)
    assert len(reference.spots) == 241
    np.testing.assert_array_equal(reference.lit, reference.lit[::-1, ::-1])  # a round pupil
    assert np.abs(reference.spots - reference.node_positions(reference.nodes)).max() < 1.5


def test_the_pitch_is_the_period_of_the_frame(mmirs, measured):
    # Independent of spots: the spectrum of the frame's sums has its line at one over the pitch.
    flat = np.clip(flatten(read_frame(mmirs / "mmirs_wfs_0150.fits.gz", FrameError))[0], 0, 300)
    for axis, step in ((0, measured.lattice.column_step[0]), (1, measured.lattice.row_step[1])):
        periods = np.linspace(18, 28, 1001)
        profile = flat.sum(axis=axis) - flat.sum(axis=axis).mean()
        power = np.abs(np.exp(-2j * np.pi * np.arange(512) / periods[:, None]) @ profile)
        assert periods[power.argmax()] == pytest.approx(step, rel=0.01)


def test_spots_are_where_another_library_sees_them(mmirs, measured):
    flat, _ = flatten(read_frame(mmirs / "mmirs_wfs_0150.fits.gz", FrameError))
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


@pytest.mark.slow
def test_real_units_scale_by_the_optics(mmirs, measured):
    paths = mmirs / "mmirs_wfs_0150.fits.gz", mmirs / "mmirs_camera2_ref.fits.gz"
    real = measure_files(*paths, pitch_m=600e-6, focal_m=40e-3)
    per_pixel = 600e-6 / measured.reference.pitch / 40e-3
    np.testing.assert_allclose(real.slopes, measured.slopes * per_pixel)
    np.testing.assert_allclose(real.wavefront, measured.wavefront * per_pixel * 600e-6)
    assert real.in_metres


@pytest.mark.slow
@pytest.mark.parametrize("name", ["blank", "bogus"])
def test_frames_that_show_no_spots_are_refused(mmirs, name):
    with pytest.raises(FrameError, match="the frame: no grid"):
        measure_files(mmirs / f"mmirs_{name}.fits.gz", mmirs / "mmirs_camera2_ref.fits.gz")


def test_frames_of_two_cameras_are_refused():
    with pytest.raises(FrameError, match="one camera's"):
        measure_slopes(np.zeros((64, 64)), np.zeros((64, 65)))


@pytest.mark.slow
def test_a_frame_against_itself_is_flat(mmirs):
    frame = read_frame(mmirs / "mmirs_camera2_ref.fits.gz", FrameError)
    same = measure_slopes(frame, frame)
    assert np.nanmax(np.abs(same.wavefront)) < 1e-9
    moved = measure_slopes(np.roll(frame, (2, 3), (0, 1)), frame)
    np.testing.assert_allclose(moved.shift_px, [3, 2], atol=0.02)
    assert moved.rms < 0.05
    assert len(find_lattice(frame).spots) == len(moved.lattice.spots)


SIDE, PITCH, PUPIL = 320, 16.0, 130.0
"""Frames below: pixels, pixels, and the radius within which lenslets have their middles."""


def pair(kind, turn, gradient, pupil="round", dtype="float32", brightness=1.0):
    """A frame and its reference in a camera's type, and where the lenslets are from the middle, pixels."""
    rng = np.random.default_rng(2)
    _, places = nodes_and_places(kind, PITCH, turn, SIDE, PUPIL, pupil)
    heights = np.exp(rng.uniform(-np.log(brightness), 0, len(places)))
    frames = []
    for moved in (places + gradient(places), places):
        light = 0.1 + spots_frame(SIDE, moved + (SIDE - 1) / 2, 1.8, heights)
        frames.append(as_dtype(light + rng.normal(0, 0.005, light.shape), dtype))
    return frames[0], frames[1], places


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32", "float64"])
@pytest.mark.parametrize(("kind", "turn"), [("square", 0), ("square", 31), ("hexagonal", 0), ("hexagonal", -77)])
def test_known_wavefronts_come_back_zonally_and_by_their_modes(kind, turn, dtype):
    # Zernike polynomials whose gradients are the spots' displacements, in pixels; heights of the spots 1 to 5.
    true, radius = {4: 25.0, 5: -12.0, 7: 10.0, 9: 6.0, 11: -4.0}, 140.0
    frame, reference, places = pair(
        kind, turn, lambda p: sum(c * zernike_gradient(i, p / radius) / radius for i, c in true.items()), dtype=dtype,
        brightness=5.0,
    )  # fmt: skip
    result = measure_slopes(frame, reference)
    assert result.lattice.kind == result.reference.kind == kind
    assert len(result.lattice.spots) == len(places)
    assert result.pieces.max() == 0
    known = np.isfinite(result.wavefront)
    middle = result.positions_px[known] - (SIDE - 1) / 2
    value = sum(c * zernike(i, middle / radius) for i, c in true.items()) / PITCH
    # Tilt of the whole is taken out with the shift of the spots.
    design = np.column_stack([np.ones(len(middle)), middle])
    expected = value - design @ np.linalg.lstsq(design, value, rcond=None)[0]
    for found in (result.wavefront[known], result.zernikes.wavefront[known]):
        left = found - design @ np.linalg.lstsq(design, found, rcond=None)[0] - expected
        assert left.std() < 0.02 * expected.std()
    assert result.wavefront[known].mean() == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_a_turned_grid_in_real_units_has_the_slopes_of_its_optics(kind):
    pitch_m, focal_m, curvature = 300e-6, 8e-3, 0.004  # pixels of displacement for a pixel from the middle
    frame, reference, _ = pair(kind, 20, lambda p: curvature * p)
    result = measure_slopes(frame, reference, pitch_m=pitch_m, focal_m=focal_m)
    known = np.isfinite(result.wavefront)
    metres = (result.positions_px[known] - (SIDE - 1) / 2) * pitch_m / PITCH
    paraboloid = curvature / focal_m * (metres**2).sum(axis=1) / 2
    assert (result.wavefront[known] - paraboloid).std() < 0.01 * paraboloid.std()
    focus = curvature / focal_m * (result.zernikes.radius_px * pitch_m / PITCH) ** 2 / (4 * np.sqrt(3))
    assert result.zernikes.coefficients[2] == pytest.approx(focus, rel=0.01)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
def test_a_pupil_in_two_halves_is_reconstructed_half_by_half(kind):
    frame, reference, _ = pair(kind, 90, lambda p: 0.01 * p, "halves")
    result = measure_slopes(frame, reference)
    known = result.pieces >= 0
    np.testing.assert_array_equal(known, np.isfinite(result.wavefront))
    assert result.pieces.max() == 1
    for piece in (0, 1):
        mine = result.pieces == piece
        assert result.wavefront[mine].mean() == pytest.approx(0, abs=1e-9)
        assert len(set(np.sign(result.positions_px[mine][:, 0] - SIDE / 2))) == 1


def test_the_picture_has_each_lenslet_where_it_lies():
    from aolink.viewing.slopes import lenslet_map

    frame, reference, places = pair("hexagonal", 10, lambda p: 0.01 * p)
    result = measure_slopes(frame, reference)
    picture = lenslet_map(result)
    lit = np.isfinite(picture)
    # A hexagon's area is the pitch squared times root three halves; a point is a twelfth of a pitch.
    assert lit.sum() / 12**2 == pytest.approx(len(places) * np.sqrt(3) / 2, rel=0.01)
    y, x = np.nonzero(lit)
    away = np.stack([x - x.mean(), y - y.mean()], axis=1)
    focus = (away**2).sum(axis=1)
    assert np.corrcoef(picture[lit], focus)[0, 1] > 0.98  # each hexagon has one value


@pytest.mark.slow
def test_the_command_takes_a_hexagonal_sensor(aolink, tmp_path):
    frame, reference, places = pair("hexagonal", 25, lambda p: 0.01 * p, dtype="uint8")
    np.save(tmp_path / "frame.npy", frame)
    np.save(tmp_path / "flat.npy", reference)
    done = aolink("slopes", "frame.npy", "--reference", "flat.npy", "-o", "out.npz", "-o", "out.rrd")
    assert done.returncode == 0, done.stderr
    assert "hexagonal" in done.stdout
    assert f"{len(places)}, the reference has {len(places)}" in done.stdout
    assert "the reference's 16.00" in done.stdout
    assert "25.0" in done.stdout
    with np.load(tmp_path / "out.npz") as file:
        assert str(file["grid"]) == "hexagonal"
        assert np.isfinite(file["wavefront"]).sum() == len(places)
        assert file["zernike_coefficients"].shape == file["zernike_indices"].shape == (14,)
    assert (tmp_path / "out.rrd").stat().st_size > 10_000
    np.save(tmp_path / "noise.npy", np.random.default_rng(0).normal(0.5, 0.01, frame.shape).astype(np.float32))
    np.save(tmp_path / "stack.npy", np.zeros((2, *frame.shape), dtype=np.uint8))
    for name, says in (("noise", "no usable spots"), ("stack", "holds 2 pictures, expected one")):
        refused = aolink("slopes", f"{name}.npy", "--reference", "flat.npy")
        assert refused.returncode == 9
        assert refused.stderr.count("\n") == 1
        assert says in refused.stderr


@pytest.mark.slow
def test_the_command_prints_and_writes(aolink, mmirs, tmp_path):
    reference = str(mmirs / "mmirs_camera2_ref.fits.gz")
    done = aolink(
        "slopes", mmirs / "mmirs_wfs_0150.fits.gz", "--reference", reference, "-o", "s.npz", "-o", "s.rrd", "--json"
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


def sharp_spots(sd: float, moves: np.ndarray, pitch: int = 20) -> np.ndarray:
    """Spots of a square grid, integrated over pixels, moved by (n, n, 2) as (x, y)."""
    n = len(moves)
    edges = np.arange(n * pitch + 17) - 0.5

    def along(middle: float) -> np.ndarray:
        return np.diff(ndtr((edges - middle) / sd))

    light = np.full((len(edges) - 1,) * 2, 100.0)
    for j, i in np.ndindex(n, n):
        x, y = moves[j, i]
        light += 20_000 * np.outer(along(14 + j * pitch + y), along(14 + i * pitch + x))
    return light + np.random.default_rng(3).normal(0, 3, light.shape)


@pytest.mark.slow
@pytest.mark.parametrize(("sd", "most"), [(0.4, 0.03), (0.55, 0.01), (0.7, 0.004), (1.0, 0.004)])
def test_undersampled_spots_are_measured(sd, most):
    moves = np.random.default_rng(9).uniform(-1, 1, (8, 8, 2))
    found = measure_slopes(sharp_spots(sd, moves), sharp_spots(sd, np.full((8, 8, 2), 0.3)))
    error = found.displacements_px - (moves - moves.mean(axis=(0, 1)))
    assert np.sqrt(np.mean(error**2)) < most


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["tif", "png", "bmp", "fits"])
def test_frames_of_other_formats_and_bad_pixels(kind, tmp_path):
    moves = np.random.default_rng(9).uniform(-1, 1, (8, 8, 2))
    pictures = [np.rint(sharp_spots(1.2, each) / 16).astype(np.uint8) for each in (moves, 0 * moves)]
    bad = np.random.default_rng(2).uniform(size=pictures[0].shape) < 1e-3
    paths = [tmp_path / f"{name}.{kind}" for name in ("frame", "flat", "bad")]
    for path, picture in zip(paths, [*(np.where(bad, 200, each) for each in pictures), bad], strict=True):
        if kind == "fits":
            fits.PrimaryHDU(picture[None].astype(np.int16)).writeto(path)
        else:
            Image.fromarray(picture.astype(np.uint8)).save(path)
    found = measure_files(paths[0], paths[1], bad=paths[2])
    error = found.displacements_px - (moves - moves.mean(axis=(0, 1)))
    assert np.sqrt(np.mean(error**2)) < 0.03
    holes = [np.where(bad, np.nan, each) for each in pictures]
    np.testing.assert_array_equal(measure_slopes(*holes).displacements_px, found.displacements_px)
