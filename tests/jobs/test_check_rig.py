"""`aolink rig --check`: what a lab user gets wrong is named before anything runs."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

import aolink
from aolink.control.loop import centroids
from aolink.jobs.check_rig import check_rig
from aolink.rig import builtin_rigs, load_rig, parse_rig

SECTION_VI = load_rig("section-vi").toml


def swinging(turn: float) -> str:
    """A of a damped oscillation that turns by so much in a fast step, rad."""
    return str([[0.99 * math.cos(turn), 0.99 * math.sin(turn)], [-0.99 * math.sin(turn), 0.99 * math.cos(turn)]])


def found(severity: str, **values: str) -> dict[str, str]:
    """Key and message of what the check says of section-vi with some values changed."""
    text = SECTION_VI.replace("[mirror]", "[mirror]\nwatchdog_s = 1.0\nqueue_steps = 400")
    text = text.replace("exposure_offset = 0 ", "frame_period_steps = 200\nexposure_offset = 0 ")
    text = text.replace("[simulation]", "[simulation]\nlatency_s = 1e-4")
    for key, value in values.items():
        text, count = re.subn(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", text)
        assert count == 1, key
    return {f.key: f.message for f in check_rig(parse_rig(text)) if f.severity == severity}


@pytest.mark.parametrize(
    ("values", "key", "message"),
    [
        ({"sigma": "50"}, "sensor.kernel.sigma", r"wider than the field: its sd is 35\.4, the field 2 wide"),
        ({"field": "[-0.01, 0.01]"}, "sensor.kernel.sigma", "wider than the field"),
        ({"noise_density": "10"}, "sensor.noise_density", r"lost in the noise: resting, .* by 0\.84 sd"),
        ({"counts_per_density": "0.01"}, "sensor.counts_per_density", "the read-out rounds it away"),
        ({"process_noise": "1e6"}, "plant.process_noise", "more than the field is wide"),
        ({"amplitude": "0.04"}, "drive.amplitude", "lower drive.amplitude or widen sensor.field"),
        ({"C": "[[1e-300, 0.0]]"}, "rig", "too large or too small to compute with"),
    ],
)
def test_what_cannot_work_is_an_error(values: dict[str, str], key: str, message: str) -> None:
    assert re.search(message, found("error", **values)[key])
    assert found("error") == {}


@pytest.mark.parametrize(
    ("values", "key", "message"),
    [
        ({"fast_step_s": "1.0"}, "timing.fast_step_s", "1 Hz are not what a fast mirror takes"),
        ({"fast_step_s": "1e-9"}, "timing.fast_step_s", "1 GHz are not what a fast mirror takes"),
        ({"fast_step_s": "1.0"}, "timing.exposure_steps", "200 steps of 1 s takes 200 s"),
        ({"exposure_steps": "1"}, "timing.exposure_steps", "no motion that the blur could show"),
        ({"frame_period_steps": "100000"}, "timing.frame_period_steps", "exposes for 0.002 of the time"),
        ({"fast_step_s": "1e-6"}, "timing.frame_period_steps", "5 kHz are more than a host takes"),
        ({"sigma": "0.8"}, "sensor.kernel.sigma", "every frame cuts the spot off"),
        ({"sigma": "0.02"}, "sensor.kernel.sigma", r"sigma is 0\.4 pixels, .* from 0\.8 on"),
        ({"noise_density": "7"}, "sensor.noise_density", r"is 0\.88 in the brightest pixel .* from 1 on"),
        ({"noise_density": "2e-5"}, "sensor.noise_density", r"is 520 in the brightest pixel .* up to 300"),
        ({"process_noise": "100"}, "plant.process_noise", "by 13.1 sds of the kernel .* up to 8"),
        ({"A": swinging(0.4)}, "timing.exposure_steps", r"swings 12\.7 times in an exposure, .* up to 8"),
        ({"A": swinging(1.2), "exposure_steps": "20"}, "timing.fast_step_s", r"5\.2 fast steps in one swing"),
        (
            {
                "A": str(np.diag([0.99, 0.98, 0.97, 0.96]).tolist()),
                "B": "[[0.0], [0.0], [0.0], [0.1]]",
                "B_w": "[[0.05], [0.05], [0.05], [0.05]]",
                "C": "[[1.0, 1.0, 1.0, 1.0]]",
            },
            "plant.A",
            "4 eigenmodes of the plant move the spot",
        ),
        ({"black_level": "100"}, "sensor.black_level", "clipped at zero"),
        ({"photoelectrons": "1"}, "sensor.photoelectrons", "4e.04 counts for each photo-electron"),
        ({"process_noise": "100"}, "sensor.field", "beyond the field"),
        ({"process_noise": "0"}, "plant.process_noise", "use no frame"),
        ({"amplitude": "0", "process_noise": "1e-6"}, "plant.process_noise", "no blur to learn from"),
        ({"period_s": "0.15", "amplitude": "0.05", "fast_step_s": "0.02"}, "drive.period_s", "7.5 fast steps"),
        (
            {"A": "[[0.5, 0.0], [0.0, 0.9]]", "B": "[[4.0], [1.0]]", "amplitude": "0.05", "period_s": "0.01"},
            "timing.fast_step_s",
            "jumps by",
        ),
        ({"fast_step_s": "1e-5"}, "mirror.queue_steps", "lasts 4 ms"),
        ({"watchdog_s": "0.06"}, "mirror.watchdog_s", "parks after 60 ms .* a block of commands lasts 50 ms"),
        ({"watchdog_s": "500"}, "mirror.watchdog_s", "goes on for 500 s"),
        ({"dac_bits": "3"}, "mirror.dac_bits", "round the drive by up to"),
        ({"clock_drift_ppm": "20000"}, "simulation.clock_drift_ppm", "broken clock"),
        ({"latency_s": "2"}, "simulation.latency_s", "2 s one way"),
    ],
)
def test_what_is_probably_a_slip_is_a_warning(values: dict[str, str], key: str, message: str) -> None:
    assert re.search(message, found("warning", **values)[key])
    assert found("warning") == {}


@pytest.mark.parametrize("noise_density", ["0.3", "3"])
def test_how_many_frames_will_show_no_spot_is_what_they_do(noise_density: str) -> None:
    """At a signal to noise of 1.3 most frames are used, because noise adds to the brightest stretch."""
    text = re.sub(r"(?m)^noise_density = [^#\n]*", f"noise_density = {noise_density} ", SECTION_VI)
    text = re.sub(r"(?m)^black_level = [^#\n]*", "black_level = 30000 ", text)
    rig = parse_rig(re.sub(r"(?m)^counts_per_density = [^#\n]*", "counts_per_density = 200 ", text))
    findings = [f for f in check_rig(rig) if f.key == "sensor.noise_density" and f.severity != "info"]
    assert {f.severity for f in findings} <= {"warning"}
    said = [int(m[1]) for f in findings if (m := re.search(r"about (\d+) % of such frames", f.message))]
    count = 120
    unseen = sum(bool(np.isnan(centroids(rig, each)).any()) for each in aolink.simulate(rig, count, seed=1))
    assert unseen == pytest.approx(count * sum(said) / 100, abs=3 * math.sqrt(count * 0.15 * 0.85))


def test_the_numbers_that_a_rig_comes_to_are_stated() -> None:
    """By hand for section-vi: sd of the kernel sigma/sqrt(2), noise sqrt(V/D), peak erf(D/2/sigma)/D = 10.41."""
    info = found("info")
    assert "a fast step of 1 ms (1 kHz); exposures of 200 steps, 200 ms, one every 200 ms (5 Hz)" in info["timing"]
    assert "40 pixels of 0.05 over the field [-1, 1]" in info["sensor"]
    assert "is 0.0354, 0.707 pixels" in info["sensor"]
    assert (
        "signal to noise 7.36 in the brightest pixel of a resting spot (20820 counts over 2828)"
        in (info["sensor.noise_density"])
    )
    assert "blocks of 50 steps, 50 ms; the device queues 400 ms" in info["mirror"]
    assert "the outputs show 2 of the plant's 2 states, and the centroids of exposures alone 2; o2" in info["plant"]


LARGE = ("membrane-12x12", "sh-30x30")


@pytest.mark.parametrize(
    "name", [pytest.param(each, marks=[pytest.mark.slow] if each in LARGE else []) for each in builtin_rigs()]
)
def test_the_rigs_that_come_along_have_no_error(name: str) -> None:
    findings = check_rig(load_rig(name))
    assert not [f for f in findings if f.severity == "error"]
    # Actuators of the membrane at rest in one place are alike, and the lenslets do not see all of them; the spot of the
    # loop is brighter than those on which estimators were judged.
    expected = {"membrane-12x12": ["plant.C"], "loop": ["sensor.noise_density"]}
    assert [f.key for f in findings if f.severity == "warning"] == expected.get(name, [])
    assert any("o2 needs a spot off centre" in f.message and "here they do not" in f.message for f in findings) == (
        name in ("loop", "membrane-12x12", "sh-30x30", "sh-8x8")
    )


def test_rows_of_one_spot_that_are_exposed_too_far_apart_are_a_warning() -> None:
    said = {}
    for skew in (0.05, 0.2, -0.2):
        rig = load_rig("sh-4x4")
        rows = 4 * rig.sensor.kernel.sigma / math.sqrt(2) / rig.sensor.pixel_width
        row_time = skew * rig.timing.exposure_steps * rig.timing.fast_step_s / rows
        rolled = parse_rig(rig.toml.replace("[sensor]", f"[sensor]\nrow_time_s = {row_time}", 1))
        said[skew] = {(f.severity, f.message) for f in check_rig(rolled) if f.key == "sensor.row_time_s"}
    assert {severity for severity, _ in said[0.05]} == {"info"}
    for skew in (0.2, -0.2):
        assert any(severity == "warning" and "up to 0.2 of an exposure" in text for severity, text in said[skew])
    assert not [f for f in check_rig(load_rig("sh-4x4")) if f.key == "sensor.row_time_s"]
