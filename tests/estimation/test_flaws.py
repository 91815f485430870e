"""Pixels that lie: defects that the rig file names, and a pedestal that it does not know, cost almost nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import aolink
from aolink.errors import RigError
from aolink.estimation import Driver, Estimate
from aolink.estimation.frames.flaws import pedestals
from aolink.exposure import Exposure
from aolink.numerics.rms import rms
from aolink.rig import Rig, load_rig, parse_rig
from aolink.series import in_memory

RIGS = ("section-vi-lively", "tip-tilt")
COUNT, FIRST = 16, 3


def places(rig: Rig) -> list[list[int]]:
    rows, columns = rig.sensor.shape
    if rows == 1:
        return [[0, 5], [0, 18], [0, 31]]
    return [[rows // 2, columns // 2 - 1], [3, 4], [rows - 4, columns // 2 + 3]]


def with_hot_pixels(rig: Rig, pixels: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Each gives half of a resting spot's peak."""
    pixels = pixels.copy()
    for row, column in places(rig):
        light = int(0.5 * rig.sensor.peak_density * rig.sensor.counts_per_density)
        pixels[row, column] = min(int(pixels[row, column]) + light, rig.sensor.full_scale - 1)
    return pixels


def on_pedestal(rig: Rig, pixels: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Three per cent of a resting spot's peak in every pixel."""
    return pixels + np.uint16(0.03 * rig.sensor.peak_density * rig.sensor.counts_per_density)


FLAWS = {"defects": with_hot_pixels, "pedestal": on_pedestal}


def described(rig: Rig, flaw: str) -> Rig:
    line = f"defects = {places(rig)}" if flaw == "defects" else 'pedestal = "free"'
    return parse_rig(rig.toml.replace("[sensor]\n", f"[sensor]\n{line}\n", 1))


def flawed(name: str, flaw: str) -> tuple[Rig, list[Exposure], list[Exposure]]:
    rig = load_rig(name)
    clean = list(aolink.simulate(rig, COUNT, seed=3))
    return rig, clean, [replace(each, pixels=FLAWS[flaw](rig, each.pixels)) for each in clean]


def error(exposures: list[Exposure], estimates: list[Estimate]) -> float:
    pairs = list(zip(exposures, estimates, strict=True))[FIRST:]
    return rms(np.array([estimate.path - each.truth.path for each, estimate in pairs if each.truth is not None]))


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["o1", "o3", "moments", "profile"])
@pytest.mark.parametrize("flaw", FLAWS)
@pytest.mark.parametrize("name", RIGS)
def test_a_flaw_that_the_rig_file_describes_costs_little(name: str, flaw: str, estimator: str) -> None:
    rig, clean, bad = flawed(name, flaw)
    without = error(clean, aolink.estimate(in_memory(rig, clean), estimator).estimates())
    found = aolink.estimate(in_memory(described(rig, flaw), bad), estimator).estimates()
    assert error(clean, found) < 1.15 * without
    assert {each.status.name for each in found} == {"OK"}


@pytest.mark.parametrize(("name", "flaw"), [(RIGS[0], "defects"), (RIGS[1], "pedestal")])
def test_a_flaw_that_it_does_not_describe_costs_the_information(name: str, flaw: str) -> None:
    """Or else the test above would show nothing."""
    rig, clean, bad = flawed(name, flaw)
    without, lost = (
        error(clean, aolink.estimate(in_memory(rig, each), "moments").estimates()) for each in (clean, bad)
    )
    assert lost > 1.5 * without


@pytest.mark.parametrize("flaw", FLAWS)
@pytest.mark.parametrize("name", RIGS)
def test_one_by_one_as_all_at_once(name: str, flaw: str) -> None:
    rig, _, bad = flawed(name, flaw)
    rig = described(rig, flaw)
    together = [made for _, (made, _) in Driver(rig, ["moments", "o1"]).steps(bad[:5])]
    driver = Driver(rig, ["moments", "o1"])
    for exposure, expected in zip(bad[:5], together, strict=True):
        assert driver.step(exposure)[0].path.tobytes() == expected.path.tobytes()


@pytest.mark.parametrize("name", RIGS)
def test_a_pedestal_is_found_within_its_noise(name: str) -> None:
    rig = load_rig(name)
    sensor = replace(rig.sensor, pedestal="free")
    for exposure in aolink.simulate(rig, 8, seed=5):
        noise = np.sqrt(sensor.noise_density / sensor.pixel_size) * sensor.counts_per_density
        for more in (0, 500):
            found = pedestals(sensor, exposure.pixels + np.uint16(more), exposure.mask)
            assert abs(found - sensor.black_level - more).max() < 1.2 * noise


def test_a_window_without_a_dark_pixel_has_no_pedestal_of_its_own() -> None:
    sensor = load_rig(RIGS[0]).sensor
    bright = np.full(sensor.shape, 30_000, np.uint16)
    assert pedestals(sensor, bright, np.zeros(sensor.shape, bool)).tolist() == [sensor.black_level]


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("defects = [[0, 40]]", r"\[0, 40\], outside the 1 x 40 pixels"),
        ("defects = [3]", r"sensor.defects\[0\]: expected a list of 2, found 3"),
        ("defects = [[0, -1]]", r"sensor.defects\[0\]\[1\] = -1 must be at least 0"),
        ("defects = [[0, 1.5]]", r"sensor.defects\[0\]\[1\]: expected a whole number, found 1.5"),
        ('pedestal = "yes"', "known.*free"),
        ("defect = [[0, 1]]", "defects"),
    ],
)
def test_what_cannot_be_is_refused(line: str, says: str) -> None:
    toml = load_rig(RIGS[0]).toml.replace("[sensor]\n", f"[sensor]\n{line}\n", 1)
    with pytest.raises(RigError, match=says):
        parse_rig(toml)
