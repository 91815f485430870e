"""`aolink rig --check`: what a lab user gets wrong is named before anything runs."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

import aolink
from aolink.control.loop import centroids
from aolink.jobs.check_rig import check_devices, check_rig
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
        ({"sigma": "50"}, "sensor.kernel.sigma", r"sd is 35\.4"),
        ({"field": "[-0.01, 0.01]"}, "sensor.kernel.sigma", "wider"),
        ({"noise_density": "10"}, "sensor.noise_density", r"0\.84 sd"),
        ({"counts_per_density": "0.01"}, "sensor.counts_per_density", "rounds"),
        ({"process_noise": "1e6"}, "plant.process_noise", "hardly"),
        ({"amplitude": "0.04"}, "drive.amplitude", "lower"),
        ({"C": "[[1e-300, 0.0]]"}, "rig", "compute"),
    ],
)
def test_what_cannot_work_is_an_error(values: dict[str, str], key: str, message: str) -> None:
    assert re.search(message, found("error", **values)[key])
    assert found("error") == {}


@pytest.mark.parametrize(
    ("values", "key", "message"),
    [
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
        ({"process_noise": "100"}, "sensor.field", "beyond the field"),
        ({"process_noise": "0"}, "plant.process_noise", "use no frame"),
        ({"amplitude": "0", "process_noise": "1e-6"}, "plant.process_noise", "no blur to learn from"),
        (
            {"A": "[[0.5, 0.0], [0.0, 0.9]]", "B": "[[4.0], [1.0]]", "amplitude": "0.05", "period_s": "0.01"},
            "timing.fast_step_s",
            "jumps by",
        ),
        ({"fast_step_s": "1e-5"}, "mirror.queue_steps", "lasts 4 ms"),
        ({"watchdog_s": "0.06"}, "mirror.watchdog_s", "parks after 60 ms .* a block of commands lasts 50 ms"),
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


LARGE = ("membrane-12x12", "sh-30x30")


@pytest.mark.parametrize(
    "name", [pytest.param(each, marks=[pytest.mark.slow] if each in LARGE else []) for each in builtin_rigs()]
)
def test_the_rigs_that_come_along_have_no_error(name: str) -> None:
    findings = check_rig(load_rig(name))
    assert not [f for f in findings if f.severity == "error"]
    # The spot of the loop is brighter than those on which estimators were judged.
    expected = {"loop": ["sensor.noise_density"]}
    assert [f.key for f in findings if f.severity == "warning"] == expected.get(name, [])


def test_rows_of_one_spot_that_are_exposed_too_far_apart_are_a_warning() -> None:
    said = {}
    for skew in (0.05, 0.2, -0.2):
        rig = load_rig("sh-4x4")
        rows = 4 * rig.sensor.kernel.sigma / math.sqrt(2) / rig.sensor.pixel_width
        row_time = skew * rig.timing.exposure_steps * rig.timing.fast_step_s / rows
        rolled = parse_rig(rig.toml.replace("[sensor]", f"[sensor]\nrow_time_s = {row_time}", 1))
        said[skew] = [f.message for f in check_rig(rolled) if f.key == "sensor.row_time_s"]
    assert not said[0.05]
    assert all("up to 0.2 of" in text for skew in (0.2, -0.2) for text in said[skew])
    assert said[0.2]
    assert said[-0.2]


@pytest.mark.parametrize(
    ("row_time", "driver", "warned"),
    [("", "opencv", True), ("row_time_s = 0.0", "opencv", False), ("", "folder", False)],
)
def test_a_camera_that_may_expose_row_by_row_needs_a_row_time(row_time: str, driver: str, warned: bool) -> None:
    key = {"opencv": "source", "folder": "path"}[driver]
    text = load_rig("section-vi").toml.replace('kind = "line"', f'kind = "line"\n{row_time}')
    rig = parse_rig(f'{text}\n[devices.camera]\ndriver = "{driver}"\n{key} = "a"\n')
    found = [(each.severity, each.key) for each in check_devices(rig)]
    assert (("warning", "sensor.row_time_s") in found) == warned
