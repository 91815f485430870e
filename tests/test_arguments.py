"""Public functions given something else: one error of aolink's own that says what to give; short texts of what they
return."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import aolink

SERIES = aolink.simulate("section-vi-lively", 2, seed=1)
FRAMES = np.stack([each.pixels for each in SERIES])
EXPOSURES: Any = aolink.exposures
CALLS: dict[str, Callable[[], Any]] = {
    "a negative count": lambda: aolink.simulate("section-vi", -1),
    "a count as text": lambda: aolink.simulate("section-vi", "3"),  # type: ignore[arg-type]
    "half an exposure": lambda: aolink.simulate("section-vi", 2.5),  # type: ignore[arg-type]
    "a negative seed": lambda: aolink.simulate("section-vi", 1, seed=-1),
    "a number for a rig": lambda: aolink.simulate(5, 1),  # type: ignore[arg-type]
    "no rig": lambda: aolink.load_rig(None),  # type: ignore[arg-type]
    "a number for an estimator": lambda: aolink.estimate(SERIES, 5),  # type: ignore[arg-type]
    "numbers for estimators": lambda: aolink.estimate(SERIES, [5]),  # type: ignore[list-item]
    "no estimators": lambda: aolink.estimate(SERIES, None),  # type: ignore[arg-type]
    "a lag that is no count": lambda: aolink.smooth(SERIES, 2.5),  # type: ignore[arg-type]
    "a number for what is smoothed": lambda: aolink.smooth(SERIES, estimators=5),  # type: ignore[arg-type]
    "inputs that are text": lambda: EXPOSURES(FRAMES, "section-vi-lively", inputs="a"),
    "no path": lambda: aolink.read(None),  # type: ignore[arg-type]
    "series for recordings": lambda: aolink.compare(SERIES, SERIES),  # type: ignore[arg-type]
    "a number for a view": lambda: aolink.view(5),  # type: ignore[arg-type]
    "a number for a replay": lambda: list(aolink.replay(5, "o1")),  # type: ignore[arg-type]
    "a session of fewer than none": lambda: aolink.record("section-vi", None, None, "a.mcap", exposures=-1),
}


@pytest.mark.parametrize("call", CALLS)
def test_something_else_is_one_error_of_aolinks_own(call: str) -> None:
    with pytest.raises(aolink.AolinkError) as raised:
        CALLS[call]()
    assert "\n" not in str(raised.value)


def test_paths_and_names_do_where_objects_do(tmp_path: Path, recorded: Any) -> None:
    assert all(each.same for each in aolink.compare(recorded.path, str(recorded.path)).values())
    assert next(aolink.replay(recorded.path, "open-loop"))[1][0].estimator == "open-loop"


def test_exposures_estimates_and_rigs_are_shown_in_a_few_lines() -> None:
    exposure, found = next(aolink.estimate(SERIES, "moments").walk())
    for each in (exposure, found["moments"], SERIES.rig):
        assert len(repr(each)) < 1000
    assert "pixels=<uint16 (1, 40)>" in repr(exposure)
    assert repr(SERIES.rig) == "<Rig section-vi-lively: 1 input, 1 output>"
