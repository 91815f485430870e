"""A film becomes exposures: light to counts, times to fast steps, several frames to one exposure."""

from __future__ import annotations

import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import aolink
from aolink.errors import AolinkError, EstimatorError, ImportingError
from aolink.films.film import array_film
from aolink.films.formats import open_film
from aolink.importing.frames import FilmAccount, FilmSettings
from aolink.importing.recording import import_film
from aolink.recording.reader import Recording
from aolink.rig import Rig, load_rig, parse_rig
from aolink.rig.rows import possible_skew_ns
from tests.importing import others
from tests.importing.others import numbers
from tests.importing.rigs import small_rig

PLAIN = FilmSettings()


def made(
    tmp_path: Path, frames: NDArray[Any], rig: Rig | None = None, settings: FilmSettings = PLAIN, **known: Any,
) -> tuple[Recording, FilmAccount]:  # fmt: skip
    """The recording of a film in memory, and the account of how it was read."""
    rig = rig or small_rig()
    path = tmp_path / "film.mcap"
    account = import_film(array_film(frames, "film", **known), rig, settings, path, overwrite=True)
    return Recording(path), account


def refused(
    tmp_path: Path, frames: NDArray[Any], rig: Rig | None = None, settings: FilmSettings = PLAIN, **known: Any
) -> str:
    """The one line with which a film is refused; nothing is left of the recording."""
    with pytest.raises(ImportingError) as caught:
        made(tmp_path, frames, rig, settings, **known)
    assert list(tmp_path.iterdir()) == []
    assert "\n" not in str(caught.value)
    return str(caught.value)


def film(dtype: Any = np.uint16, count: int = 6) -> NDArray[Any]:
    return numbers(dtype, count, 8, 8)


def applied(rig: Rig, exposures: Any) -> NDArray[np.float64]:
    """What the mirror held in each fast step from step 0 on, (steps, n_inputs)."""
    return np.concatenate([part for each in exposures for part in (each.lead_inputs, each.inputs)])


RIGS = {
    "a line": lambda: load_rig("section-vi-lively"),
    "spots": lambda: load_rig("sh-4x4"),
    "dead time": lambda: small_rig(10, 17),
    "exposures that start inside a step": lambda: small_rig(10, 17, offset=0.3),
}


@pytest.mark.parametrize("name", RIGS)
def test_frames_in_memory_give_the_estimates_of_the_simulation_bit_for_bit(name):
    rig = RIGS[name]()
    simulated = aolink.simulate(rig, 5, seed=3)
    frames = np.array([each.pixels for each in simulated])
    given = aolink.exposures(frames, rig, applied(rig, simulated))
    starts = aolink.exposures(frames, rig, applied(rig, simulated), [each.first_step for each in simulated])
    for estimator in ("o1", "moments"):
        expected = aolink.estimate(simulated, estimator).estimates(estimator)
        for exposures in (given, starts):
            found = aolink.estimate(exposures, estimator).estimates(estimator)
            assert len(found) == len(expected)
            for one, other in zip(found, expected, strict=True):
                for each in fields(one):
                    if each.name != "model" and not each.name.startswith("_"):
                        np.testing.assert_array_equal(getattr(one, each.name), getattr(other, each.name), each.name)
                np.testing.assert_array_equal(one.path, other.path)


def test_a_film_of_a_simulation_gives_its_estimates_through_a_recording(tmp_path):
    rig = small_rig()
    simulated = aolink.simulate(rig, 8, seed=3)
    recording, account = made(
        tmp_path, np.array([each.pixels for each in simulated]), rig, FilmSettings(row_time_s=0.0),
        inputs=applied(rig, simulated),
    )  # fmt: skip
    assert (account.frames, account.exposures, account.saturated, account.clipped) == (8, 8, 0, 0)
    for one, other in zip(
        aolink.estimate(recording, "o3").estimates("o3"), aolink.estimate(simulated, "o3").estimates("o3"), strict=True
    ):
        np.testing.assert_array_equal(one.path, other.path)
        np.testing.assert_array_equal(one.end_covariance, other.end_covariance)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"frames": np.zeros((4, 8, 9))}, "float64 of shape (4, 8, 9), expected counts of the rig"),
        ({"frames": np.zeros((2, 4, 8, 8))}, "of shape (frames, 8, 8)"),
        ({"frames": np.zeros((0, 8, 8))}, "of shape (0, 8, 8)"),
        ({"frames": np.zeros((4, 8, 8), complex)}, "complex128"),
        ({"frames": np.full((4, 8, 8), 0.5)}, "whole numbers from 0 to 65535"),
        ({"frames": np.full((4, 8, 8), -1)}, "whole numbers from 0 to 65535"),
        ({"frames": np.full((4, 8, 8), np.nan)}, "whole numbers from 0 to 65535"),
        ({"inputs": np.zeros((69, 2))}, "(70 fast steps or more, 2), found (69, 2)"),
        ({"inputs": np.zeros((70, 3))}, "(70 fast steps or more, 2), found (70, 3)"),
        ({"inputs": np.full((70, 2), np.inf)}, "finite"),
        ({"start_steps": [0, 20, 40]}, "4 fast steps"),
        ({"start_steps": [0, 20, 29, 40]}, "each at least 10 (one exposure) after the one before"),
        ({"start_steps": [-1, 20, 40, 60]}, "from 0 on"),
        ({"start_steps": [0.5, 20, 40, 60]}, "4 fast steps"),
    ],
)  # fmt: skip
def test_arrays_in_memory_that_do_not_fit_are_refused(arguments, says):
    with pytest.raises(ImportingError, match=re.escape(says)):
        aolink.exposures(**{"frames": np.zeros((4, 8, 8)), "rig": small_rig(), **arguments})


@pytest.mark.parametrize("wrong", [[], ["film.mcap"], [np.zeros((16, 16))], np.zeros((2, 16, 16)), None])
def test_what_has_no_rig_is_refused_with_what_to_do(wrong):
    for wanted in (lambda: aolink.estimate(wrong, "o3").estimates("o3"), lambda: aolink.smooth(wrong)):
        with pytest.raises(EstimatorError, match=r"know their rig.*aolink\.exposures\(frames, rig\)"):
            wanted()


def test_exposures_have_the_times_of_the_rig_and_the_start_of_the_film(tmp_path):
    recording, _ = made(tmp_path, film(), start_ns=1_790_000_000_000_000_000)
    exposures = list(recording)
    assert [each.first_step for each in exposures] == [0, 20, 40, 60, 80, 100]
    assert [each.frame_id for each in exposures] == [1, 2, 3, 4, 5, 6]
    assert [each.host_start_ns - 1_790_000_000_000_000_000 for each in exposures] == [k * 20_000_000 for k in range(6)]
    for each, frame in zip(exposures, film(), strict=True):
        np.testing.assert_array_equal(each.pixels, frame)


def test_what_is_given_of_times_goes_before_what_the_film_says(tmp_path):
    settings = FilmSettings(rate_hz=50, exposure_s=0.01, start_ns=7)
    recording, account = made(tmp_path, film(), None, settings, rate_hz=25.0, exposure_s=0.04, start_ns=5)
    assert next(iter(recording)).host_start_ns == 7
    assert any("film says 25 frames/s; 50 frames/s as given are taken" in note for note in account.notes)
    assert any("film says 0.04 s a frame; 0.01 s as given are taken" in note for note in account.notes)


TIMES = np.arange(6) * 20_000_000
LATE = TIMES + 8_000_000 * (np.arange(6) == 3)
SUM = FilmSettings(frames_per_exposure=3, rate_hz=150)


@pytest.mark.parametrize(
    ("says", "rig", "settings", "known"),
    [
        ("60 frames/s contradict its times, which say 50: give --rate 50", (), PLAIN,
         {"rate_hz": 60.0, "times_ns": TIMES}),
        ("wants a frame every 0.02 s, 50 frames/s", (), FilmSettings(rate_hz=60), {"rate_hz": 50.0}),
        ("give --film sum=10", (10, 10), PLAIN, {"rate_hz": 1000.0}),
        ("50 frames/s", (), PLAIN, {"times_ns": TIMES * 2}),
        ("exposed for 0.02 s a frame", (), PLAIN, {"exposure_s": 0.02}),
        ("frame 2 is not later", (), PLAIN, {"times_ns": TIMES[[0, 1, 1, 3, 4, 5]]}),
        ("only whole frames", (), PLAIN, {"times_ns": LATE}),
        ("3 inputs in each step", (), PLAIN, {"inputs": np.zeros((6, 3))}),
        ("each of its 110 fast steps", (), PLAIN, {"inputs": np.zeros((109, 2))}),
        ("set timing.exposure_steps = 3", (10, 20), SUM, {}),
        ("8 x 9 pixels", (), PLAIN, {"frames": numbers(np.uint8, 3, 8, 9)}),
        ("not enough", (3, 3), FilmSettings(frames_per_exposure=3), {"frames": numbers(np.uint8, 2, 8, 8)}),
    ],
)  # fmt: skip
def test_a_film_that_contradicts_itself_or_the_rig_file_is_refused(says, rig, settings, known, tmp_path):
    known = {"frames": film(), **known}
    assert says in refused(tmp_path, known.pop("frames"), small_rig(*rig), settings, **known)


def test_frames_that_were_lost_are_gaps_in_the_count(tmp_path):
    inputs = np.arange(12.0).reshape(6, 2) / 1000
    times = np.array([0, 1, 4, 5, 6, 8]) * 20_000_000 + 3_000
    recording, _ = made(tmp_path, film(), inputs=inputs, times_ns=times)
    exposures = list(recording)
    assert [each.frame_id for each in exposures] == [1, 2, 5, 6, 7, 9]
    assert [each.first_step for each in exposures] == [0, 20, 80, 100, 120, 160]
    held = applied(recording.rig, exposures)
    # Each frame's input is held until the next frame that there is.
    np.testing.assert_array_equal(held, np.repeat(inputs, [20, 60, 20, 20, 40, 10], axis=0))


@pytest.mark.parametrize("per_step", [False, True])
def test_inputs_are_given_for_each_frame_or_for_each_step(per_step, tmp_path):
    inputs = np.linspace(-0.04, 0.04, 2 * (110 if per_step else 6)).reshape(-1, 2)
    recording, _ = made(tmp_path, film(), inputs=inputs)
    expected = inputs if per_step else np.repeat(inputs, 20, axis=0)[:110]
    np.testing.assert_array_equal(applied(recording.rig, recording), expected)


def test_without_inputs_the_mirror_is_parked(tmp_path):
    recording, _ = made(tmp_path, film())
    np.testing.assert_array_equal(applied(recording.rig, recording), np.tile(recording.rig.mirror.park, (110, 1)))


def test_each_spot_has_the_window_about_its_place(tmp_path):
    """In the order of the places, whose pixels count from the middle of the first one; the median is the picture's."""
    rig = load_rig("sh-4x4")
    rows, columns = rig.sensor.grid
    height, width = np.array(rig.sensor.shape) // rig.sensor.grid
    corners = np.random.default_rng(1).permutation(200)[: 2 * rig.sensor.spots].reshape(-1, 2)
    frames = np.random.default_rng(2).integers(0, 4000, (12, 220 + height, 220 + width)).astype(np.uint16)
    frames[:, corners[5, 1] + 3, corners[5, 0] + 2] = 60_000  # a hot pixel
    places = tuple((x + (width - 1) / 2, y + (height - 1) / 2) for x, y in corners.tolist())
    settings = FilmSettings(places=places, subtract_median=True, row_time_s=0.0)
    recording, _ = made(tmp_path, frames, rig, settings)
    ground = np.median(frames, axis=(1, 2))
    for each, frame, dark in zip(recording, frames, ground, strict=True):
        windows = each.pixels.reshape(rows, height, columns, width).swapaxes(1, 2).reshape(-1, height, width)
        mask = each.mask.reshape(rows, height, columns, width).swapaxes(1, 2).reshape(-1, height, width)
        for (x, y), window, usable in zip(corners, windows, mask, strict=True):
            counts = frame[y : y + height, x : x + width] - dark + rig.sensor.black_level
            np.testing.assert_array_equal(window[usable], np.rint(counts)[usable])
        assert not mask[5, 3, 2]


@pytest.mark.parametrize("K", [2, 3])
def test_the_mean_of_several_frames_is_one_exposure(K, tmp_path):
    frames = film(np.uint16, 7)
    inputs = np.arange(14.0).reshape(7, 2) / 1000
    recording, account = made(
        tmp_path, frames, small_rig(K, K), FilmSettings(frames_per_exposure=K, rate_hz=1000), inputs=inputs
    )  # fmt: skip
    exposures = list(recording)
    assert (account.frames, account.exposures) == (7 // K * K, 7 // K)
    for j, each in enumerate(exposures):
        exact = frames[j * K : (j + 1) * K].astype(np.int64).sum(axis=0)
        assert abs(each.pixels.astype(np.int64) * K - exact).max() <= K / 2  # the nearest whole number
        assert each.mask.all()
        np.testing.assert_array_equal(each.inputs, inputs[j * K : (j + 1) * K])


def test_a_frame_that_is_lost_costs_the_exposure_that_it_belongs_to(tmp_path):
    frames = film(np.uint16, 8)
    times = np.array([0, 1, 2, 3, 5, 6, 7, 8]) * 1_000_000
    recording, _ = made(tmp_path, frames, small_rig(3, 3), FilmSettings(frames_per_exposure=3), times_ns=times)
    assert [each.frame_id for each in recording] == [1, 3]
    np.testing.assert_array_equal([each.pixels for each in recording][1], np.rint(frames[5:8].mean(axis=0)))


def test_pixels_at_the_end_of_their_range_are_masked_and_counted(tmp_path):
    frames = np.minimum(film(np.uint8), 254)
    frames[2, 1, :3] = 255
    recording, account = made(tmp_path, frames)
    assert (account.saturated, account.clipped, account.pixels) == (3, 0, frames.size)
    for each, frame in zip(recording, frames, strict=True):
        np.testing.assert_array_equal(each.mask, frame < 255)
        np.testing.assert_array_equal(each.pixels, frame.astype(int) * 256)
    # One saturated frame spoils the mean.
    recording, account = made(tmp_path, frames, small_rig(2, 2), FilmSettings(frames_per_exposure=2))
    np.testing.assert_array_equal([each.mask.all() for each in recording], [True, False, True])


@pytest.mark.parametrize(("bits", "up"), [(12, 0), (14, 0), (12, 4)])
def test_a_camera_with_fewer_bits_than_its_film_saturates_at_its_own_last_value(tmp_path, bits, up):
    """Light of any strength up to twice what the camera can tell, stored in 16 bits at either end."""
    last = (1 << bits) - 1
    light = np.random.default_rng(3).uniform(0, 2 * last, (4, 8, 8))
    frames = (np.minimum(light, last).astype(np.uint16) << up).astype(np.uint16)
    recording, account = made(tmp_path, frames)
    np.testing.assert_array_equal([each.mask for each in recording], frames < last << up)
    assert account.saturated == np.count_nonzero(light >= last)
    assert any(f"the values end at {last << up:g}" in note for note in account.notes)


def test_a_film_that_only_reaches_a_cameras_last_value_is_not_saturated(tmp_path):
    frames = np.random.default_rng(3).integers(0, 4096, (40, 8, 8)).astype(np.uint16)
    frames[0, 0, :5] = 4095
    _, account = made(tmp_path, frames)
    assert account.saturated == 0
    assert not any("the values end" in note for note in account.notes)


def test_counts_beyond_the_range_of_the_rig_are_masked_and_counted(tmp_path):
    frames = np.full((2, 8, 8), 4095, np.uint16)
    frames[1, 0, :5] = 4096
    recording, account = made(tmp_path, frames, small_rig(bit_depth=12))
    assert (account.saturated, account.clipped) == (0, 5)
    np.testing.assert_array_equal(list(recording)[1].mask, frames[1] < 4096)


@pytest.mark.parametrize("gamma", [2.2, 0.5])
def test_a_gamma_curve_is_undone(gamma, tmp_path):
    stored = np.arange(64, dtype=np.uint8).reshape(1, 8, 8) * 4
    recording, _ = made(tmp_path, stored, None, FilmSettings(gamma=gamma))
    light = [[round(256 * 255 * (int(v) / 255) ** gamma) for v in row] for row in stored[0]]
    np.testing.assert_array_equal(next(iter(recording)).pixels, light)


def test_light_behind_a_gamma_curve_is_found_again(tmp_path):
    """A film stored by v = 255 L^(1/2.2): a quarter of the light is a quarter of the counts."""
    light = np.linspace(0.05, 0.95, 64).reshape(8, 8)
    frames = np.rint(255 * np.stack([light, light / 4]) ** (1 / 2.2)).astype(np.uint8)
    recording, _ = made(tmp_path, frames, None, FilmSettings(gamma=2.2))
    bright, dim = (each.pixels / 65_280 for each in recording)
    # Half a level of the 8 bits that were stored.
    for found, true in ((bright, light), (dim, light / 4)):
        assert (abs(found - true) <= 2.2 * 0.5 / 255 * (true ** (1.2 / 2.2) + 0.02) + 1e-5).all()


@pytest.mark.parametrize(
    ("dtype", "bit_depth", "scale"),
    [(np.uint8, 16, 256), (np.uint8, 12, 16), (np.uint8, 10, 4), (np.uint16, 16, 1), (np.float32, 16, 65_535)],
)
def test_full_scale_becomes_full_scale(dtype, bit_depth, scale, tmp_path):
    frames = np.abs(film(np.float32)) % 1 if dtype is np.float32 else film(dtype) // 2
    recording, _ = made(tmp_path, frames, small_rig(bit_depth=bit_depth))
    np.testing.assert_array_equal(
        [each.pixels for each in recording], np.rint(frames.astype(float) * scale)
    )  # fmt: skip


def test_a_scale_that_is_given_is_taken(tmp_path):
    frames = film(np.uint8)
    recording, _ = made(tmp_path, frames, None, FilmSettings(scale=2.5))
    np.testing.assert_array_equal([each.pixels for each in recording], np.rint(frames * 2.5))


def test_yes_and_no_are_light_and_none(tmp_path):
    frames = film(np.uint8) > 127
    recording, account = made(tmp_path, frames)
    np.testing.assert_array_equal([each.pixels for each in recording], frames * 65_535)
    assert account.saturated == 0


def test_numbers_that_are_none_are_masked(tmp_path):
    frames = np.full((2, 8, 8), 0.5, np.float32)
    frames[0, 3, 4], frames[1, 5, 6] = np.nan, np.inf
    recording, account = made(tmp_path, frames)
    assert account.saturated == 2
    np.testing.assert_array_equal([each.mask for each in recording], np.isfinite(frames))


@pytest.mark.parametrize("invert", [False, True])
def test_the_ground_is_taken_off(invert, tmp_path):
    """Then black level stands for no light, and noise around the ground is not cut off."""
    ground, light = 100, np.zeros((1, 8, 8), np.uint8)
    light[0, 3:5, 3:5] = 50
    frames = ground - light if invert else ground + light
    rig = small_rig()
    recording, account = made(tmp_path, frames, rig, FilmSettings(invert=invert, subtract_median=not invert))
    np.testing.assert_array_equal(next(iter(recording)).pixels, rig.sensor.black_level + 256 * light[0].astype(int))
    assert account.clipped == 0


def test_colours_keep_the_scale_of_their_type(tmp_path):
    colours = np.stack([film(np.uint8) // 2] * 3, axis=-1)
    source = open_film(others.write_pictures(tmp_path / "film", colours))
    import_film(source, small_rig(), PLAIN, tmp_path / "film.mcap")
    np.testing.assert_array_equal(
        [each.pixels for each in Recording(tmp_path / "film.mcap")], colours[..., 0].astype(int) * 256
    )


def test_light_that_may_not_be_linear_is_said_unless_gamma_is_given(tmp_path):
    _, account = made(tmp_path, film(np.uint8), nonlinear="a JPEG")
    assert any("light may not be linear: a JPEG; --film gamma=2.2" in note for note in account.notes)
    _, account = made(tmp_path, film(np.uint8), None, FilmSettings(gamma=2.2), nonlinear="a JPEG")
    assert not any("linear" in note for note in account.notes)


def test_nothing_is_left_of_a_film_that_ends_in_damage(tmp_path):
    """The damage shows after most of the recording has been written; a recording that was there stays."""
    folder = others.write_pictures(tmp_path / "film", film(np.uint8, 30))
    last = max(folder.iterdir(), key=lambda each: int(each.stem.removeprefix("frame")))
    last.write_bytes(last.read_bytes()[:60])
    source, out = open_film(folder), tmp_path / "out"
    out.mkdir()
    with pytest.raises(ImportingError, match=last.name):
        import_film(source, small_rig(), PLAIN, out / "film.mcap")
    assert list(out.iterdir()) == []
    (out / "film.mcap").write_text("mine")
    with pytest.raises(AolinkError):
        import_film(source, small_rig(), PLAIN, out / "film.mcap", overwrite=True)
    assert [each.read_text() for each in out.iterdir()] == ["mine"]


def test_the_row_time_of_a_film_is_known_or_said(tmp_path):
    """With it a film has the exposures of a camera that exposes row by row; without it, its inputs are uncertain."""
    rig = small_rig()
    text = rig.toml.replace("[sensor]", "[sensor]\nrow_time_s = 1e-3", 1)
    simulated = aolink.simulate(parse_rig(text), 8, seed=3)
    frames = np.array([each.pixels for each in simulated])
    inputs = np.random.default_rng(0).uniform(-0.01, 0.01, (200, rig.n_inputs))
    recording, account = made(tmp_path, frames, rig, FilmSettings(row_time_s=1e-3), inputs=inputs)
    assert recording.rig.sensor.row_time_s == 1e-3
    assert not any("row_time=S" in note for note in account.notes)
    late, first = recording.rig.axis_delays[0], next(iter(recording.exposures()))
    assert late > 0
    assert first.row_sigma_ns is None
    n = first.n_steps
    quantised = inputs[late : late + n, 0]
    np.testing.assert_array_equal(first.inputs[:, 0], quantised)
    recording, account = made(tmp_path, frames, rig, inputs=inputs)
    assert any("row_time=S" in note for note in account.notes)
    assert "row_time_s" in recording.metadata["camera_lacks"]
    first = next(iter(recording.exposures()))
    assert first.row_sigma_ns is not None
    np.testing.assert_array_equal(first.row_sigma_ns, possible_skew_ns(rig))
    estimate = next(iter(aolink.estimate(recording, "o3").estimates("o3")))
    assert estimate.alignment is not None
    assert estimate.alignment.steps == pytest.approx(possible_skew_ns(rig).max() / rig.timing.fast_step_ns)
    none, _ = made(tmp_path, frames, rig)
    assert next(iter(none.exposures())).row_sigma_ns is None  # a mirror that rests has the same inputs at any time


@pytest.mark.parametrize("side", [8, 9])
def test_a_window_moves_by_a_pixel_where_its_place_does(side, tmp_path):
    rig = parse_rig(load_rig("single-lenslet").toml.replace("window = [16, 16]", f"window = [{side}, {side}]"))
    frames = np.tile(np.arange(40, dtype=np.uint16), (12, 40, 1))
    first = []
    for x in range(10, 16):
        recording, _ = made(tmp_path, frames, rig, FilmSettings(places=((x, 20),), row_time_s=0.0))
        first.append(int(next(iter(recording)).pixels[0, 0]))
    assert np.diff(first).tolist() == [1] * 5
