"""What goes wrong on the line of any serial mirror when it is opened; `test_sessions` has the rest."""

from __future__ import annotations

import pytest

from aolink.errors import AolinkError
from tests.devices.mirrors.serial_mirrors import MIRRORS, with_each
from tests.devices.simulators.serial_device import Faults

NAMED = r"(Optotune mirror driver|PI controller|Thorlabs (unit|aligner)|/dev/pts/)"


@pytest.mark.parametrize(
    ("faults", "what"),
    [
        (Faults(late_s=1.3), "does not answer .* as it should, .*: is it switched on, is this its port"),
        (Faults(silent_from=0), "does not answer .* nothing came: is it switched on, is this its port"),
        (Faults(silent_from=5), "does not answer .* nothing came: is it switched on, is this its port"),
        (Faults(garbled=frozenset(range(100))), "answers|sends|identifies itself as"),
        (Faults(unplugged_at=3), r"lost /dev/pts/\d+: .*is the device still there\?"),
    ],
    ids=["late", "silent", "silent later", "garbled", "unplugged"],
)
def test_a_line_that_is_of_no_use_when_the_mirror_is_opened(faults: Faults, what: str) -> None:
    """One line names the device or its port."""

    def check(name: str) -> None:
        with (
            MIRRORS[name].make(faults=faults) as device,
            pytest.raises(AolinkError, match=rf"^(?=.*{NAMED}).*({what})") as raised,
        ):
            MIRRORS[name].opened(device)
        assert "\n" not in str(raised.value)

    with_each(check)


def test_a_line_at_another_speed() -> None:
    def check(name: str) -> None:
        with MIRRORS[name].make() as device:
            speed, device.baud_rate = device.baud_rate, 19_200
            with pytest.raises(AolinkError, match=f"does not answer .* does its line run at {speed} baud"):
                MIRRORS[name].opened(device)

    with_each(check)


def test_a_mirror_that_refuses_its_safe_input_is_not_opened() -> None:
    def check(name: str) -> None:
        with MIRRORS[name].make(faults=Faults(refused=frozenset({0}))) as device:
            with pytest.raises(AolinkError, match=r"answers XY=.* with 'NO'|its error 53|reports an error .* code 7"):
                MIRRORS[name].opened(device)
            MIRRORS[name].opened(device).close()  # the port was given back
            assert MIRRORS[name].is_parked(device)

    with_each(check)


def test_a_slow_line_in_pieces_opens_a_mirror_at_its_safe_input_wherever_it_was() -> None:
    def check(name: str) -> None:
        with MIRRORS[name].make(faults=Faults(late_s=0.003, split=True)) as device:
            assert not MIRRORS[name].holds_the_safe_input(device)
            driver = MIRRORS[name].opened(device)
            assert MIRRORS[name].is_parked(device)
            driver.close()
            assert MIRRORS[name].is_parked(device)

    with_each(check)
