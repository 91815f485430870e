"""Keys of drivers in a rig file: their kinds and triggers are checked in one place, before anything is opened."""

from __future__ import annotations

import re
from typing import Any

import pytest

from aolink.devices.drivers import KINDS, check_driver
from aolink.devices.simple import FREE_RUNNING, Trigger
from aolink.errors import RigError
from aolink.extensions import installed
from aolink.rig import load_rig
from aolink.rig.device_tables import DeviceTable

RIG = load_rig("tip-tilt")


def arguments(name: str, **keys: Any) -> dict[str, Any]:
    (kind,) = (each for each in KINDS if name in installed(f"aolink.{each}s"))
    return check_driver(kind, DeviceTable(driver=name, options=keys), RIG)[1]


@pytest.mark.parametrize(
    ("name", "keys", "says"),
    [
        ("aravis", {"address": 7}, "devices.camera.address: expected a text, found 7"),
        ("aravis", {"resend": 1}, "devices.camera.resend: expected true or false, found 1"),
        ("aravis", {"features": [1]}, "devices.camera.features: expected a table, found [1]"),
        ("folder", {"path": "a", "corner": 3}, "devices.camera.corner: expected a list of whole numbers, found 3"),
        ("folder", {"path": "a", "corner": [0, 1.5]}, "devices.camera.corner: expected a list of whole numbers"),
        ("opencv", {"source": 0.5}, "devices.camera.source: expected a whole number or a text, found 0.5"),
        ("micromanager", {"properties": "a"}, "devices.camera.properties: expected a table, found 'a'"),
        ("optotune", {"port": 3}, "devices.mirror.port: expected a text, found 3"),
        ("optotune", {"port": "a", "unit_rad": "1"}, "unit_rad: expected a number or a list of numbers, found '1'"),
        ("pi_gcs2", {"port": "a", "axes": "1 2"}, "axes: expected a list of texts or whole numbers, found '1 2'"),
        ("pi_gcs2", {"port": "a", "axes": [1, 2], "baud_rate": "x"}, "baud_rate: expected a whole number, found 'x'"),
        ("thorlabs_piezo", {"port": [1, 2]}, "devices.mirror.port: expected a text or a list of texts, found [1, 2]"),
        ("microscope", {"device": "a", "unit": [0.5, True]}, "devices.mirror.unit: expected a number or a list of num"),
        ("folder", {}, "devices.camera: the driver folder cannot take these keys: missing a required"),
    ],
)
def test_a_value_of_another_kind_is_refused(name: str, keys: dict[str, Any], says: str) -> None:
    with pytest.raises(RigError, match=re.escape(says)):
        arguments(name, **keys)


def test_values_of_the_right_kinds_are_passed_on() -> None:
    keys = {"port": ["a", "b"], "unit": 3, "zero": [1, 2.5], "closed_loop": True, "travel_um": 20}
    assert arguments("thorlabs_piezo", **keys) == keys
    assert arguments("pi_gcs2", port="a", axes=["1", 2])["axes"] == ["1", 2]


@pytest.mark.parametrize(
    ("name", "keys", "trigger"),
    [
        ("aravis", {}, FREE_RUNNING),
        ("aravis", {"trigger": "free-running"}, FREE_RUNNING),
        ("aravis", {"trigger": "software"}, Trigger("software")),
        ("aravis", {"trigger": "hardware:Line1"}, Trigger("hardware", "Line1")),
        ("micromanager", {"trigger": "hardware"}, Trigger("hardware")),
        ("folder", {"path": "a", "trigger": "free-running"}, None),
        ("opencv", {}, None),
    ],
)
def test_a_trigger_is_a_value_that_the_driver_gets(name: str, keys: dict[str, Any], trigger: Trigger | None) -> None:
    assert arguments(name, **keys).get("trigger") == trigger


@pytest.mark.parametrize(
    ("name", "trigger"),
    [
        ("aravis", "Line1"), ("aravis", "sofware"), ("aravis", "hardware"), ("aravis", "hardware:"), ("aravis", 3),
        ("aravis", "software:Line1"), ("aravis", ""), ("micromanager", "software"), ("micromanager", "hardware:Line1"),
        ("folder", "software"), ("opencv", ["hardware"]),
    ],
)  # fmt: skip
def test_a_trigger_that_the_driver_cannot_have_is_refused_with_those_that_it_can(name: str, trigger: Any) -> None:
    can = {"aravis": "'free-running' or 'software' or 'hardware:INPUT'", "micromanager": "'free-running' or 'hardware'"}
    says = f"devices.camera.trigger: expected {can.get(name, repr('free-running'))} with this driver, found {trigger!r}"
    with pytest.raises(RigError, match=f"^{re.escape(says)}$"):
        arguments(name, trigger=trigger)
