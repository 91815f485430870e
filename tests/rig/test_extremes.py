"""Rig files with numbers at the ends of what there is, and with more keys than anybody writes: one clear error."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from aolink.errors import AolinkError, EstimatorError, RigError
from aolink.estimation import make_estimator
from aolink.jobs.check_rig import check_rig
from aolink.recording.reader import Recording
from aolink.rig import load_rig, parse_rig
from aolink.simulation.model import simulate
from tests.recording.test_hostile import rig_only

TEXT = load_rig("section-vi").toml


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("fast_step_s = 0.001", "fast_step_s = 1e300", r"timing.fast_step_s = 1e\+300 must be at most"),
        ("fast_step_s = 0.001", "fast_step_s = 1e-7", "timing.fast_step_s = 1e-07 must be at least 1e-06"),
        ("sigma = 0.05", "sigma = 1e200", r"kernel.sigma = 1e\+200 must be 0, or of a size from 1e-30 to 1e\+30"),
        ("sigma = 0.05", "sigma = 1e-200", "kernel.sigma = 1e-200 must be 0, or of a size from 1e-30"),
        ("field = [-1.0, 1.0]", "field = [-1e308, 1e308]", r"sensor.field holds a number .* larger than 1e\+30"),
        ("process_noise = 0.1", "process_noise = 1e308", r"plant.process_noise holds a number .* larger than"),
        ("process_noise = 0.1", "process_noise = nan", "plant.process_noise holds a number that is not finite"),
        ("clock_offset_s = 0.25", "clock_offset_s = 1e20", r"simulation.clock_offset_s = 1e\+20 must be at most"),
        ("[timing]", "[timing]\n" + "".join(f"key{k} = 1\n" for k in range(300_000)), "more than 20000 keys"),
        ("[timing]", "".join(f"[t{k}]\n" for k in range(300_000)) + "[timing]", "more than 20000 keys, tables"),
    ],
    ids=lambda text: text[:40],
)
def test_the_rig_file_itself_is_refused(old: str, new: str, what: str, tmp_path: Path) -> None:
    """Also where it comes out of a recording."""
    assert old in TEXT
    with pytest.raises(RigError, match=what):
        parse_rig(TEXT.replace(old, new))
    with pytest.raises(AolinkError, match=what):
        Recording(rig_only(tmp_path / "a.mcap", TEXT.replace(old, new)))


def test_a_damping_that_leaves_nothing_to_compute_is_one_error_or_none() -> None:
    """It depends on the linear algebra library whether a matrix counts as singular; no other error comes out."""
    text = load_rig("tip-tilt").toml
    assert "damping = 0.2" in text
    with suppress(RigError):
        parse_rig(text.replace("damping = 0.2", "damping = 1e-29"))


@pytest.mark.slow
@pytest.mark.parametrize(("old", "new"), [("0.05]]", "1e29]]"), ("sigma = 0.05", "sigma = 1e-9")])
def test_an_estimator_refuses_what_it_cannot_compute_with(old: str, new: str) -> None:
    """A table of light would take more memory than there is."""
    assert old in TEXT
    with pytest.raises(EstimatorError, match=r"a spot is .* pixels wide"):
        step("profile", TEXT.replace(old, new))


def step(name: str, text: str) -> None:
    estimator = make_estimator(parse_rig(text), name)
    for exposure in simulate(parse_rig(TEXT), 2, 1):
        estimator.step(exposure)


def changed(text: str) -> Iterator[str]:
    """The text with each of its numbers replaced by each of some that are not meant."""
    for found in re.finditer(r"(?<![\w.\"#-])-?\d+\.?\d*(?:e-?\d+)?(?![\w.\"])", text):
        line = text[text.rfind("\n", 0, found.start()) + 1 : found.start()]
        if "=" in line and "#" not in line:
            for value in ("1e300", "-1e29", "1e29", "1e-29", "1e-300", "0"):
                yield text[: found.start()] + value + text[found.end() :]


@pytest.mark.slow
def test_no_number_ends_in_anything_but_an_error_of_ours() -> None:
    errors = list[str]()
    for text in changed(TEXT):
        try:
            with np.errstate(all="ignore"):
                check_rig(parse_rig(text))
                for name in ("o1", "o3", "moments", "profile"):
                    step(name, text)
        except AolinkError as error:
            errors.append(str(error))
    assert len(errors) > 50
    assert max(map(len, errors)) < 500
    assert not [error for error in errors if "\n" in error]
