"""PI's driver on a pseudo terminal: the bytes, the limits, and what goes wrong."""

from __future__ import annotations

import re
import socketserver
import threading
from typing import Any

import numpy as np
import pytest

from aolink.devices.mirrors.pi_gcs2 import PiMirror
from aolink.errors import DeviceError, RigError
from aolink.rig import Rig, load_rig
from tests.devices.simulators.optotune import OptotuneSimulator
from tests.devices.simulators.pi_gcs2 import PiSimulator

RIG = load_rig("tip-tilt")
KEYS: dict[str, Any] = {"axes": ["1", "2"], "scale": 10, "offset": 17.5}


def opened(simulator: PiSimulator, rig: Rig = RIG, **keys: Any) -> PiMirror:
    return PiMirror(rig, port=simulator.port, **{**KEYS, **keys})


def after_the_opening(simulator: PiSimulator) -> list[bytes]:
    """Requests from the one for the first arrival on."""
    return simulator.requests[simulator.requests.index(b"ONT? 1 2") + 2 :]


def test_it_is_opened_with_the_servos_of_its_axes_on_and_at_its_safe_input() -> None:
    with PiSimulator() as simulator:
        mirror = opened(simulator)
        mirror.close()
        assert simulator.servo == {"1": True, "2": True, "3": False}
        assert simulator.now() == (17.5, 17.5, 3.0)
        assert b"SVO 1 1 2 1" in simulator.requests
    assert mirror.description == "PI E-727.3SDA, serial number 0116047977, firmware 13.21.00.02, axes 1 2"


def test_servos_that_are_on_are_left_alone() -> None:
    with PiSimulator(servo=True) as simulator:
        opened(simulator).close()
        assert not any(request.startswith(b"SVO ") for request in simulator.requests)


def test_inputs_are_positions_of_the_axes_in_their_order() -> None:
    with PiSimulator() as simulator:
        mirror = opened(simulator, axes=[2, 1], scale=[10, -5], offset=[17.5, 20])
        taken = mirror.put(np.array([0.12345678, 0.5]))
        mirror.park()
        mirror.close()
        assert b"MOV 2 18.734568 1 17.500000" in simulator.requests
        assert simulator.now() == (20, 17.5, 3.0)
    assert taken.tolist() == pytest.approx([0.1234568, 0.5], abs=1e-12)


def test_an_error_is_known_at_the_next_input_and_parking_forgets_it() -> None:
    with PiSimulator() as simulator:
        mirror = opened(simulator)
        mirror.put(np.array([0.1, 0.0]))
        mirror.put(np.array([0.2, 0.0]))
        while simulator.now()[0] != 19.5:  # it is not waited for
            pass
        simulator.servo["2"] = False  # as by an overload
        mirror.put(np.array([0.3, 0.0]))
        refused = r"refuses MOV 1 20.500000 2 17.500000 with its error 5 \(an axis has its servo off"
        with pytest.raises(DeviceError, match=refused):
            mirror.put(np.array([0.4, 0.0]))
        with pytest.raises(DeviceError, match=r"refuses MOV 1 17.500000 2 17.500000 with its error 5"):
            mirror.park()
        simulator.servo["2"] = True
        mirror.park()
        mirror.close()
        assert [held[1][0] for held in simulator.held[2:]] == [18.5, 19.5, 17.5]


def test_one_answer_is_awaited_at_a_time() -> None:
    with PiSimulator() as simulator:
        mirror = opened(simulator)
        for x in (0.1, 0.2):
            mirror.put(np.array([x, 0.0]))
        mirror.park()
        mirror.close()
        assert after_the_opening(simulator) == [
            b"MOV 1 18.500000 2 17.500000", b"ERR?", b"MOV 1 19.500000 2 17.500000", b"ERR?",
            b"STP", b"*IDN?", b"ERR?", b"MOV 1 17.500000 2 17.500000", b"ERR?",
        ]  # fmt: skip


@pytest.mark.parametrize("unknown", ["TMN?", "TMX?", "ONT?", "SVO?"])
def test_what_a_controller_cannot_tell_is_not_needed(unknown: str) -> None:
    with PiSimulator(refused={unknown: 2}) as simulator:
        mirror = opened(simulator)
        mirror.put(np.array([0.1, 0.0]))
        mirror.park()
        mirror.close()
        assert simulator.held[-2][1] == (18.5, 17.5, 3.0)


@pytest.mark.parametrize(
    ("answers", "what"),
    [
        ({"*IDN?": "HEWLETT-PACKARD,34401A,0,1"}, "identifies itself as 'HEWLETT-PACKARD,34401A,0,1', not as a"),
        ({"CSV?": "3.0"}, "speaks version 3.0 of its command set, this driver version 2"),
        ({"CSV?": "new"}, "answers CSV[?] with 'new', which is no answer of GCS 2"),
        ({"SAI?": "A \nB"}, "has the axes A, B, not 1, 2: correct devices.mirror.axes"),
        ({"TMN? 1 2": "1=9 \n2=0"}, "are 7.5 to 27.5 by .* scale and offset, the PI axis 1 goes from 9 to 36.5"),
        ({"TMX? 1 2": "1=36 \n2=much"}, r"answers TMX\? 1 2 with '1=36  2=much', which is no answer"),
        ({"TMX? 1 2": "1=36 \n2=nan"}, r"answers TMX\? 1 2 with '1=36  2=nan', which is no answer"),
        ({"TMX? 1 2": "1=36"}, r"answers TMX\? 1 2 with '1=36', which is no answer"),
        ({"SVO? 1 2": "1=1 \n2=0"}, "the servo of the PI axes 1 2 does not switch on: are stage and high voltage"),
    ],
)
def test_a_controller_that_is_another_or_not_ready(answers: dict[str, str], what: str) -> None:
    with PiSimulator(answers=answers) as simulator:
        for _ in range(2):  # the port was given back
            with pytest.raises(DeviceError, match=what):
                opened(simulator)


@pytest.mark.parametrize(
    ("refused", "what"),
    [
        ({"SVO ": 34}, r"refuses SVO 1 1 2 1 with its error 34 \(the stage does not allow it\)"),
        ({"SVO? ": 63}, r"refuses SVO\? 1 2 with its error 63 \(it is still starting\)"),
        ({"MOV": 7}, r"refuses MOV 1 17.5\S* 2 17.5\S* with its error 7 \(it is beyond the axis's limits\)"),
        ({"MOV": 999}, r"with its error 999 \(see the manual of its commands\)"),
    ],
)
def test_commands_that_are_refused(refused: dict[str, int], what: str) -> None:
    with PiSimulator(refused=refused) as simulator, pytest.raises(DeviceError, match=what):
        opened(simulator)


def test_a_stage_that_does_not_arrive() -> None:
    what = r"do not reach their safe position \[17.5 17.5\] in 0.2 s, they are at \[3. 3.\]: are they zeroed"
    with PiSimulator(travel_s=float("inf")) as simulator, pytest.raises(DeviceError, match=what):
        opened(simulator, settling_s=0.2)


def test_a_stage_on_its_way_is_waited_for_when_it_is_opened_and_not_in_a_session() -> None:
    with PiSimulator(travel_s=0.2) as simulator:
        mirror = opened(simulator)
        assert simulator.positions()["1"] == 17.5
        asked = simulator.requests.count(b"ONT? 1 2")
        assert asked > 2
        for x in (0.1, 0.2, 0.3):  # it is told to go elsewhere before it is there
            mirror.put(np.array([x, 0.0]))
        mirror.park()
        assert 17.5 < simulator.positions()["1"] < 20.5  # stopped, and on its way back
        mirror.close()
        assert simulator.now() == (17.5, 17.5, 3.0)
        assert simulator.requests.count(b"ONT? 1 2") == asked


@pytest.mark.parametrize(
    ("keys", "what"),
    [
        ({"axes": ["1"]}, "devices.mirror.axes: expected a list of 2 different axes of the controller"),
        ({"axes": ["1", "1"]}, "2 different axes"),
        ({"axes": ["1", "2 1\nSVO 3"]}, "2 different axes"),
        ({"scale": 0}, "devices.mirror.scale: expected a number that is not zero"),
        ({"offset": [1, 2, 3]}, "devices.mirror.offset: expected a finite number, or a list of 2"),
        ({"baud_rate": 5}, "expected baud_rate in bits per second and settling_s in seconds, found 5 and 5.0"),
    ],
)
def test_wrong_keys(keys: dict[str, Any], what: str) -> None:
    with PiSimulator() as simulator:
        with pytest.raises(RigError, match=re.escape(what)):
            opened(simulator, **keys)
        assert simulator.requests == []


def test_another_device() -> None:
    with OptotuneSimulator() as other, pytest.raises(DeviceError, match="does not answer"):
        PiMirror(RIG, port=other.port, **KEYS)


def test_a_controller_in_the_network() -> None:
    class Connection(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            for line in self.rfile:
                self.wfile.write(controller.answer(line.rstrip()))

    with PiSimulator() as controller, socketserver.ThreadingTCPServer(("127.0.0.1", 0), Connection) as server:
        threading.Thread(target=server.serve_forever).start()
        mirror = PiMirror(RIG, port=f"socket://127.0.0.1:{server.server_address[1]}", **KEYS)
        mirror.put(np.array([0.1, 0.0]))
        mirror.park()
        mirror.close()
        server.shutdown()
        assert [held[0] for _, held in controller.held[2:]] == [18.5, 17.5]


def test_the_simulator_is_what_pipython_expects() -> None:
    """The maker's own client, where a developer has installed it: it is not free software, and no dependency."""
    pipython = pytest.importorskip("pipython")
    interface = pytest.importorskip("pipython.pidevice.interfaces.piserial")
    with PiSimulator() as simulator:
        gateway = interface.PISerial(simulator.port, 115_200)
        pi = pipython.GCSDevice(gateway=gateway)
        assert pi.qIDN().split(",")[1].strip() == pi.devname == "E-727.3SDA"
        assert pi.qCSV() == 2.0
        assert pi.qSAI() == ["1", "2", "3"]
        assert list(pi.qSVO(["1", "2"]).values()) == [False, False]
        for command, number in (
            (lambda: pi.MOV("1", 10.0), 5),  # the servo is off
            (lambda: pi.SVO("9", 1), 15),
            (lambda: pi.STP(), 10),
            (lambda: pi.StopAll(), 10),
            (lambda: pi.VEL("1", 2.0), 2),
        ):
            with pytest.raises(pipython.GCSError) as raised:
                command()
            assert raised.value == number
        pi.SVO(["1", "2"], [1, 1])
        assert dict(pi.qSVO()) == {"1": True, "2": True, "3": False}
        assert (pi.qTMN("1")["1"], pi.qTMX("2")["2"]) == (-1.5, 37.5)
        with pytest.raises(pipython.GCSError) as raised:
            pi.MOV({"1": 10.0, "2": 50.0})
        assert raised.value == 7
        assert pi.qMOV("1")["1"] == 3.0  # all axes or none
        pi.MOV({"1": 10.0, "2": 12.25})
        assert list(pi.qPOS(["1", "2"]).values()) == list(pi.qMOV(["1", "2"]).values()) == [10.0, 12.25]
        assert all(pi.qONT().values())
        assert pi.qERR() == 0
        gateway.close()
