"""Quantities as people write them."""

from __future__ import annotations

import pytest

from aolink.units import quantity


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("0.02", "s", 0.02),
        ("20ms", "s", 0.02),
        ("500 us", "s", 5e-4),
        ("1/60", "s", 1 / 60),
        ("2min", "s", 120),
        ("-1e-3s", "s", -1e-3),
        ("30000/1001", "Hz", 30000 / 1001),
        ("25fps", "Hz", 25),
        ("1.5kHz", "Hz", 1500),
    ],
)
def test_numbers_fractions_and_units(text: str, unit: str, value: float) -> None:
    assert quantity(text, unit) == pytest.approx(value, rel=1e-15)


@pytest.mark.parametrize("text", ["", "x", "ms", "inf", "nan", "1/0", "20mm", "25Hz"])
def test_what_is_no_time_is_refused_with_the_units_there_are(text: str) -> None:
    with pytest.raises(ValueError, match="20ms"):
        quantity(text, "s")
