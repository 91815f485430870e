"""A calibration finds what a camera of other people's software was set to: Micro-Manager's DemoCamera, mode Noise.

The adapter draws a pixel's background from a Gaussian of mean 100 counts (10 where it has 8 bits) and of the read
noise, drops the fraction, adds the light from a Gaussian whose variance is its mean in electrons, and drops the
fraction again. Its property Offset has no effect in this mode.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy import stats

from aolink.calibration import Calibration, Frames, calibrate
from aolink.rig import load_rig, parse_rig
from tests.needs import needed

pymmcore = needed("pymmcore")
mm_test_adapters = needed("mm_test_adapters")

PIXELS = 256
FRAMES = 150
DROPPED = 1 / 12
"""Variance of what is lost with the fraction of a count."""


@dataclass(frozen=True)
class Setting:
    """What the camera is set to."""

    bits: int
    electrons_per_count: float
    read_noise: float
    """Electrons."""
    exposure_ms: float
    flux: float
    """Electrons of a pixel in a millisecond, of the brighter of two flats; the other has half of it."""

    @property
    def truth(self) -> tuple[float, float, float]:
        """Counts of an electron, read noise (counts) and black level (counts), with what dropping fractions does."""
        electrons, per_count = self.exposure_ms * self.flux, self.electrons_per_count
        gain = (electrons / per_count**2 + DROPPED) / (electrons / per_count - 0.5)
        return gain, float(np.hypot(self.read_noise / per_count, DROPPED**0.5)), (100 if self.bits > 8 else 10) - 0.5


SETTINGS = (
    Setting(bits=16, electrons_per_count=1.0, read_noise=2.5, exposure_ms=1, flux=5000),
    Setting(bits=16, electrons_per_count=0.25, read_noise=3.0, exposure_ms=2, flux=2000),
    Setting(bits=12, electrons_per_count=4.0, read_noise=50.0, exposure_ms=2, flux=4000),
    Setting(bits=14, electrons_per_count=0.5, read_noise=10.0, exposure_ms=0.5, flux=3000),
    Setting(bits=8, electrons_per_count=0.5, read_noise=1.0, exposure_ms=1, flux=84),
)


@pytest.fixture(scope="module")
def camera() -> Any:
    """The core of Micro-Manager with the camera loaded, a line of pixels read out."""
    core = pymmcore.CMMCore()
    core.setDeviceAdapterSearchPaths([mm_test_adapters.device_adapter_path()])
    core.loadDevice("Camera", "DemoCamera", "DCam")
    core.initializeDevice("Camera")
    core.setCameraDevice("Camera")
    core.setProperty("Camera", "Mode", "Noise")
    yield core
    core.reset()


def shot(camera: Any, kind: Any, exposure_ms: float, flux: float) -> Frames:
    camera.setExposure(exposure_ms)
    camera.setProperty("Camera", "Photon Flux", flux)
    counts = []
    for _ in range(FRAMES):
        camera.snapImage()
        counts.append(camera.getImage().ravel())
    return Frames(kind=kind, counts=np.array(counts, dtype=np.uint16), source=f"{kind} {flux:g}")


def calibrated(camera: Any, setting: Setting) -> Calibration:
    camera.setProperty("Camera", "PixelType", "8bit" if setting.bits == 8 else "16bit")
    camera.setProperty("Camera", "BitDepth", setting.bits)
    camera.setProperty("Camera", "Photon Conversion Factor", setting.electrons_per_count)
    camera.setProperty("Camera", "ReadNoise (electrons)", setting.read_noise)
    camera.setROI(0, 0, PIXELS, 1)
    text = load_rig("section-vi").toml
    for key, old, new in (("pixels", 40, PIXELS), ("bit_depth", 16, setting.bits), ("black_level", 20000, 0)):
        text = text.replace(f"{key} = {old}", f"{key} = {new}")
    rig = parse_rig(text)
    flats = [shot(camera, "flat", setting.exposure_ms, flux) for flux in (setting.flux / 2, setting.flux)]
    return calibrate(rig, [shot(camera, "dark", 0, 2), *flats])


def test_the_settings_of_a_camera_are_found(camera: Any) -> None:
    """Conversion factor, read noise and offset of five settings together, inside 99 % of chi-square."""
    ctypes.CDLL(None).srand(1)  # the C library's generator, which the adapter draws from: the same frames each time
    squares: list[float] = []
    for setting in SETTINGS:
        found = calibrated(camera, setting)
        assert [note.partition(",")[0] for note in found.notes] == ["without a still spot"]
        assert found.gain is not None
        measured = found.gain, found.read_noise, found.black_level
        deviations = [(each.value - true) / each.sd for each, true in zip(measured, setting.truth, strict=True)]
        squares += [deviation**2 for deviation in deviations]
    low, high = (float(stats.chi2.ppf(share, len(squares))) for share in (0.005, 0.995))
    assert low < sum(squares) < high
