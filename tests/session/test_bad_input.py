"""What bad input gets: one clear line that says what to do, an exit code that means something, nothing lost."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import resource
import signal
import socket
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message

from aolink.devices.interfaces import CommandAnswered
from aolink.errors import DeviceError, PortError, RecordingError
from aolink.polling import wait_readable
from aolink.recording.reader import Recording
from aolink.recording.writer import RecordingWriter
from aolink.rig import load_rig
from aolink.session import record
from aolink.wire import messages_pb2 as pb
from aolink.wire.packet import Packet, PacketDecoder, encode_message, encode_packet, schema_hash
from aolink.wire.port import SerialPort
from tests.commands import simulated_rig
from tests.conftest import Session
from tests.hostile import lying_rig
from tests.session.native import open_native

Run = Callable[..., subprocess.CompletedProcess[str]]
Start = Callable[..., "subprocess.Popen[str]"]
RECORDING = Path(__file__).parents[2] / "recordings" / "section-vi.mcap"


def record_arguments(
    camera: str, mirror: str, *more: str, rig: str = "section-vi", output: str = "a.mcap"
) -> list[str]:
    return ["record", "--camera", camera, "--mirror", mirror, "--rig", rig, "-o", output, *more]


def assert_refused(result: subprocess.CompletedProcess[str], exit_code: int, pattern: str) -> None:
    assert result.returncode == exit_code, result.stderr
    assert re.fullmatch(rf"aolink: .*{pattern}.*\n", result.stderr), result.stderr


@contextmanager
def fake_device(answer: Callable[[Packet], bytes]) -> Iterator[str]:
    """Something on a pseudo terminal that answers packets in its own way; gives its path."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    done = threading.Event()

    def serve() -> None:
        decoder = PacketDecoder()
        os.set_blocking(master, False)
        while not done.wait(0.01):
            try:
                data = os.read(master, 4096)
            except BlockingIOError:
                continue
            for packet in decoder.feed(data):
                os.write(master, answer(packet))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        done.set()
        thread.join()
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize(
    ("camera", "mirror", "why"),
    [("/dev/nowhere", "/dev/nowhere-else", "no port /dev/nowhere"), ("/dev/ttyX", "/dev/ttyX", "both at /dev/ttyX")],
)
def test_a_port_that_is_not_there_and_one_for_both_are_refused(aolink: Run, camera: str, mirror: str, why: str) -> None:
    assert_refused(aolink(*record_arguments(camera, mirror)), 3, why)


def test_a_port_in_use_is_refused(aolink: Run) -> None:
    with simulated_rig("section-vi") as (camera, mirror):
        held = SerialPort(camera)
        result = aolink(*record_arguments(camera, mirror, "--exposures", "2"))
        held.close()
    assert_refused(result, 3, f"{camera} is in use")


def test_swapped_ports_are_refused_and_named(aolink: Run) -> None:
    with simulated_rig("section-vi") as (camera, mirror):
        result = aolink(*record_arguments(mirror, camera, "--exposures", "2"))
    assert_refused(result, 4, "swapped")


def of_another_schema(packet: Packet) -> bytes:
    nonce = pb.Identify.FromString(packet.payload).nonce
    return encode_message(pb.Identity(nonce=nonce, protocol_version=1, schema_hash=b"otherone"), 0)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda packet: b"", "nothing came"),
        (lambda packet: b"+++ OK\r\n", "24 bytes came that are not aolink packets"),
        (lambda packet: encode_packet(Packet(3, 2, packet.sequence, b"\x08\x01")), "protocol version 3"),
        (of_another_schema, f"6f746865726f6e65, here {schema_hash().hex()}"),
    ],
)
def test_a_device_that_is_none_of_ours(aolink: Run, answer: Callable[[Packet], bytes], said: str) -> None:
    with fake_device(answer) as port:
        result = aolink("devices", port)
    assert result.returncode == 4
    assert said in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "pattern"),
    [
        ("pixels = 40", "pixels = 64", r"sensor shape .* \(1, 64\) in the file, \(1, 40\)"),
        ("exposure_steps = 200", "exposure_steps = 100", "timing.exposure_steps is 100 in the file, 200"),
        ("input_max = 0.05", "input_max = 0.06", r"mirror.input_max is \[0.06\] in the file, \[0.05\]"),
    ],
)
def test_a_rig_file_of_another_device(aolink: Run, tmp_path: Path, old: str, new: str, pattern: str) -> None:
    text = load_rig("section-vi").toml
    assert old in text
    (tmp_path / "other.toml").write_text(text.replace(old, new))
    with simulated_rig("section-vi") as (camera, mirror):
        result = aolink(*record_arguments(camera, mirror, rig="other.toml"))
    assert_refused(result, 4, pattern)


@pytest.mark.slow
def test_ports_of_two_rigs_are_refused(aolink: Run) -> None:
    with simulated_rig("section-vi") as (camera, _), simulated_rig("section-vi", "--seed", "9") as (_, mirror):
        result = aolink(*record_arguments(camera, mirror))
    assert_refused(result, 4, "same rig")


@pytest.mark.slow
def test_an_existing_target_is_kept(aolink: Run, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("precious")
    with simulated_rig("section-vi") as (camera, mirror):
        arguments = record_arguments(camera, mirror, "--exposures", "2")
        assert_refused(aolink(*arguments), 5, "a.mcap exists")
        assert (tmp_path / "a.mcap").read_text() == "precious"
        assert aolink(*arguments, "--overwrite").returncode == 0
    assert Recording(tmp_path / "a.mcap").counts["/camera/image"] == 2
    for name in ("b.mcap", "b.rrd"):
        (tmp_path / name).write_text("precious")
    for command in (["estimate", "a.mcap", "-o", "b.mcap"], ["view", "a.mcap", "-o", "b.rrd"]):
        assert "exists" in aolink(*command).stderr


@pytest.mark.slow
def test_a_folder_that_does_not_exist(aolink: Run) -> None:
    with simulated_rig("section-vi") as (camera, mirror):
        result = aolink(*record_arguments(camera, mirror, output="no/such/a.mcap"))
    assert_refused(result, 5, "no folder no/such")


@pytest.mark.slow
def test_an_unknown_estimator_is_refused_with_those_there_are(aolink: Run) -> None:
    with simulated_rig("section-vi") as (camera, mirror):
        result = aolink(*record_arguments(camera, mirror, "--estimator", "o7"))
    assert_refused(result, 2, "o7.*open-loop")


@pytest.mark.slow
def test_a_full_disk_ends_the_session_and_leaves_what_was_recorded(aolink: Run, tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk, and for those that take none over 4 GiB."""
    limit = 200_000
    with simulated_rig("section-vi") as (camera, mirror):
        result = aolink(
            *record_arguments(camera, mirror, "--estimator", "o3"),
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        )
        assert_refused(result, 5, "what was recorded until then")
        parked = aolink("devices", mirror).stdout
    assert "parked" in parked
    recording = Recording(tmp_path / "a.mcap")
    exposures = list(recording.exposures())
    assert "it was cut off" in recording.damage
    assert len(exposures) > 10
    assert [e.frame_id for e in exposures] == list(range(1, len(exposures) + 1))
    info = aolink("info", "a.mcap")
    assert "damage" in info.stdout
    assert "warning: a.mcap" in info.stderr


def test_a_disk_without_any_space_is_one_clear_error(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        with pytest.raises(RecordingError, match="larger"):
            RecordingWriter(tmp_path / "a.mcap", load_rig("section-vi"), {}, 0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("name", ["/dev/full", "/dev/null"])
def test_a_device_is_no_target(name: str) -> None:
    with pytest.raises(RecordingError, match="device"):
        RecordingWriter(name, load_rig("section-vi"), {}, 0, overwrite=True)


@contextmanager
def rig_process(start_aolink: Start, *arguments: str) -> Iterator[tuple[subprocess.Popen[str], list[str]]]:
    """A simulated rig as a process of its own, which may be stopped or killed; and its ports."""
    rig = start_aolink("sim", *arguments, "--json")
    assert rig.stdout is not None
    ports = json.loads(rig.stdout.readline())
    try:
        yield rig, [ports["camera"], ports["mirror"]]
    finally:
        rig.kill()
        rig.communicate()


def wait_for_size(path: Path, size: int, process: subprocess.Popen[str]) -> None:
    for _ in range(6000):
        if path.exists() and path.stat().st_size >= size:
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    pytest.fail(f"{path} has not grown to {size} bytes within a minute")


@pytest.mark.slow
@pytest.mark.parametrize("how", [[], ["--real-time"]])
def test_ctrl_c_keeps_the_recording_whole_and_parks_the_mirror(
    aolink: Run, start_aolink: Start, tmp_path: Path, how: list[str]
) -> None:
    with simulated_rig("section-vi", *how) as (camera, mirror):
        process = start_aolink(*record_arguments(camera, mirror, "--estimator", "o3"))
        wait_for_size(tmp_path / "a.mcap", 40_000, process)
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=30)
        parked = aolink("devices", mirror).stdout
    assert process.returncode == 130
    assert errors == "aolink: interrupted by SIGINT\n"
    assert "interrupted" in output
    if not how:  # in real time the mirror parks by itself as well, its queue runs empty: virtual time tells
        assert "parked" in parked
    recording = Recording(tmp_path / "a.mcap")
    assert recording.complete
    assert recording.metadata["ended"] == "interrupted"
    assert len(list(recording.exposures())) == len(recording.estimates("o3")) > 0


@pytest.mark.slow
def test_a_rig_killed_in_the_middle(start_aolink: Start, tmp_path: Path) -> None:
    with rig_process(start_aolink, "section-vi") as (rig, ports):
        process = start_aolink(*record_arguments(*ports, "--estimator", "o3"))
        wait_for_size(tmp_path / "a.mcap", 100_000, process)
        rig.kill()
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 3
    match = re.search(r"lost /dev/pts/.*; the (\d+) exposure\(s\) .* saved in a.mcap", errors)
    assert match, errors
    recording = Recording(tmp_path / "a.mcap")
    assert len(list(recording.exposures())) == int(match[1])
    assert recording.complete
    assert recording.metadata["ended"].startswith("error: lost")
    assert len(recording.estimates("o3")) > 0


@pytest.mark.slow
def test_a_killed_host_leaves_a_readable_recording_and_a_parked_mirror(
    aolink: Run, start_aolink: Start, tmp_path: Path
) -> None:
    """Nobody tells the mirror to park: its queue runs empty."""
    with simulated_rig("section-vi", "--real-time") as (camera, mirror):
        process = start_aolink(*record_arguments(camera, mirror))
        wait_for_size(tmp_path / "a.mcap", 60_000, process)
        process.kill()
        process.communicate()
        assert any("parked" in aolink("devices", mirror).stdout for _ in range(20))
    recording = Recording(tmp_path / "a.mcap")
    assert not recording.complete
    assert recording.counts["/camera/image"] == len(list(recording.exposures())) > 0


def test_the_watchdog_parks_the_mirror_while_commands_are_queued(tmp_path: Path) -> None:
    text = load_rig("section-vi").toml.replace("block_steps = 50", "queue_steps = 5000\nwatchdog_s = 0.1")
    (tmp_path / "rig.toml").write_text(text)
    rig = load_rig(tmp_path / "rig.toml")
    with simulated_rig(tmp_path / "rig.toml", "--real-time") as ports, open_native(rig, *ports) as (hub, _, mirror):
        for k in range(0, 4000, 50):
            mirror.send_block(mirror.identity.next_step + 100 + k, np.full((50, 1), 0.01), 0, hub.now_ns())
        events: list[str] = []
        for _ in range(1000):
            for link, received in hub.wait(0.1):
                if link is mirror.link:
                    events += [e.text for e in mirror.handle(received) if isinstance(e, pb.Event)]
            if events:
                break
    assert events == ["mirror parked by its watchdog: no valid packet for 0.1 s"]


def test_a_command_beyond_the_limits_is_refused_by_the_host_and_by_the_device() -> None:
    rig = load_rig("section-vi")
    with simulated_rig("section-vi") as ports, open_native(rig, *ports) as (hub, _, mirror):
        for value in (0.06, float("nan")):
            u = np.array([[0.0], [value]])
            with pytest.raises(DeviceError, match="limits"):
                mirror.send_block(0, u, 0, hub.now_ns())
        rig.mirror.input_max[0] = 1.0  # a host that believes in other limits
        mirror.send_block(0, np.array([[0.06]]), 0, hub.now_ns())
        ((_, refusal),) = hub.wait(1.0)
        (answered,) = mirror.handle(refusal)
        assert isinstance(answered, CommandAnswered)
        assert answered.ack
        assert answered.ack.code == pb.OUT_OF_RANGE
        assert mirror.in_flight == 0


@pytest.mark.slow
def test_ctrl_c_while_the_rig_is_held_up(start_aolink: Start, tmp_path: Path) -> None:
    """Nobody answers any more; the session ends all the same, as interrupted, and says what it could not do."""
    with rig_process(start_aolink, "section-vi") as (rig, ports):
        process = start_aolink(*record_arguments(*ports, "--estimator", "o3"))
        wait_for_size(tmp_path / "a.mcap", 100_000, process)
        rig.send_signal(signal.SIGSTOP)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "has said nothing" in errors
    assert Recording(tmp_path / "a.mcap").metadata["ended"] == "interrupted"


def test_a_camera_that_dies_ends_an_unlimited_session(tmp_path: Path) -> None:
    """Its line goes on, its frames do not."""

    def without_frames(message: Message) -> Message | Iterator[Message]:
        return iter(()) if isinstance(message, pb.FrameChunk) and message.frame_id > 2 else message

    with (
        lying_rig(load_rig("section-vi"), camera=without_frames, real_time=True) as ports,
        pytest.raises(DeviceError, match="no frame"),
    ):
        record(load_rig("section-vi"), *ports, tmp_path / "a.mcap")
    assert Recording(tmp_path / "a.mcap").metadata["ended"].startswith("error: ")


@pytest.mark.slow
def test_a_device_held_up_for_two_seconds_does_not_end_the_session(start_aolink: Start, tmp_path: Path) -> None:
    """As long as twice its watchdog is longer than that."""
    text = load_rig("section-vi").toml.replace("block_steps = 50", "block_steps = 50\nwatchdog_s = 3")
    (tmp_path / "rig.toml").write_text(text)
    with rig_process(start_aolink, "rig.toml", "--real-time", "--listen", "127.0.0.1:0") as (rig, ports):
        process = start_aolink(*record_arguments(*ports, "--exposures", "16", rig="rig.toml"))
        wait_for_size(tmp_path / "a.mcap", 50_000, process)
        rig.send_signal(signal.SIGSTOP)
        time.sleep(2.0)  # the fault itself, not a wait for something
        rig.send_signal(signal.SIGCONT)
        output, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (0, ""), errors
    assert "exposures, complete" in output


@pytest.mark.slow
def test_a_killed_parent_takes_its_rig_along(tmp_path: Path) -> None:
    code = (
        "import sys\nfrom aolink.jobs.demo import simulated_rig\n"
        "with simulated_rig('section-vi') as ports: print(*ports, flush=True); sys.stdin.read()"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    camera = parent.stdout.readline().split()[0]
    assert Path(camera).exists()
    parent.kill()
    parent.communicate()
    deadline = time.monotonic() + 20
    while Path(camera).exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize(
    "arguments", [["--exposures", "0"], ["--exposures", "5000000000"], ["--duration", "inf"], ["--duration", "-1"]]
)
def test_numbers_that_make_no_sense(aolink: Run, tmp_path: Path, arguments: list[str]) -> None:
    result = aolink(*record_arguments("/dev/nowhere", "/dev/nowhere", *arguments))
    assert result.returncode == 2
    assert "Traceback" not in result.stderr
    assert arguments[0] in result.stderr
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize("where", ["devices", "record", "rig file", "check"])
def test_a_port_that_would_write_a_file_is_refused_before_it_does(aolink: Run, tmp_path: Path, where: str) -> None:
    (precious := tmp_path / "precious").write_text("precious")
    master, slave = pty.openpty()
    port = f"spy://{os.ttyname(slave)}?file={precious}"
    text = load_rig("section-vi").toml + f'\n[devices]\nmirror = {{ driver = "native", port = "{port}" }}\n'
    (tmp_path / "my.toml").write_text(text)
    command = {
        "devices": ["devices", port],
        "record": ["record", "--camera", os.ttyname(slave), "--mirror", port, "--rig", "section-vi", "-o", "a.mcap"],
        "rig file": ["record", "--camera", os.ttyname(slave), "--rig", "my.toml", "-o", "a.mcap"],
        "check": ["rig", "my.toml", "--check"],
    }[where]
    result = aolink(*command)
    os.close(master)
    os.close(slave)
    assert precious.read_text() == "precious"
    assert result.returncode == (2 if where == "check" else 3)
    said = result.stdout if where == "check" else result.stderr
    assert f"{port!r} is not a port" in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("port", "message"),
    [
        *(
            (port, "not an address")
            for port in (
                "socket://127.0.0.1", "socket://", "socket://127.0.0.1:nine", "socket://127.0.0.1:99999",
                "socket://127.0.0.1:-5", "socket://[::1:5", "rfc2217://",
            )
        ),
        *(
            (port, "nothing behind it")
            for port in (
                "socket://127.0.0.1:5?logging=debug", "socket://127.0.0.1:5/debug",
                "rfc2217://127.0.0.1:5?ign_set_control&timeout=9", "RFC2217://127.0.0.1:5#logging",
            )
        ),
        *(
            (port, "not a port that aolink opens")
            for port in (
                "spy://loop://?file=a", "SPY://loop://", " spy://loop://", "alt:///dev/null?class=Serial",
                "loop://?logging=debug", "hwgrep://[", "cp2110://", "nonsense://1", "://x",
            )
        ),
        ("", "without a name"), ("/dev/null", "no serial port"), (".", "folder"), (__file__, "a file"),
        ("n" * 5000, "too long"),
    ],
)  # fmt: skip
def test_what_cannot_be_a_port_is_one_clear_error(port: str, message: str) -> None:
    with pytest.raises(PortError, match=message) as caught:
        SerialPort(port)
    assert "\n" not in str(caught.value)
    for word in ("Errno", "NoneType", "Traceback", "object"):
        assert word not in str(caught.value)


@contextmanager
def terminal_as_nobody(mode: int) -> Iterator[int]:
    """A pseudo terminal's descriptor; root, who may open everything, is somebody else meanwhile."""
    master, slave = pty.openpty()
    is_root = os.geteuid() == 0
    os.fchmod(slave, mode)
    try:
        if is_root:
            os.seteuid(65534)
        yield slave
    finally:
        if is_root:
            os.seteuid(0)
        os.close(master)
        os.close(slave)


def test_a_port_where_nobody_listens() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        with pytest.raises(PortError, match="nothing listens"):
            SerialPort(f"socket://127.0.0.1:{probe.getsockname()[1]}")


def test_a_port_without_permission_and_one_that_somebody_has_locked() -> None:
    """With the lock of a terminal, which is not pyserial's own."""
    with terminal_as_nobody(0o666) as slave:
        fcntl.ioctl(slave, termios.TIOCEXCL)
        with pytest.raises(PortError, match="in use"):
            SerialPort(os.ttyname(slave))
    with terminal_as_nobody(0) as slave, pytest.raises(PortError, match="permission"):
        SerialPort(os.ttyname(slave))


@pytest.mark.slow
def test_a_tcp_port_that_another_host_has(aolink: Run) -> None:
    with simulated_rig("section-vi", "--listen", "127.0.0.1:0") as (camera, _):
        held = SerialPort(camera)
        held.write(encode_message(pb.Identify(nonce=1), 0))
        wait_readable([held], 20.0)
        result = aolink("devices", camera)
        held.close()
    assert result.returncode in (3, 4)
    assert "lost socket://" in result.stderr or "does another host have it" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"hello, this is a text file, not a recording\n"])
def test_a_file_that_is_not_a_recording(aolink: Run, tmp_path: Path, content: bytes) -> None:
    (tmp_path / "bad.mcap").write_bytes(content)
    for command in ("info", "estimate", "view"):
        result = aolink(command, "bad.mcap")
        assert_refused(result, 5, "bad.mcap")
    assert_refused(aolink("info", "missing.mcap"), 5, "missing.mcap: no such file")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "unwanted"),
    [
        (["--help"], "numpy|scipy|aolink.rig|numba|rerun"),
        (["info", "s.mcap"], r"scipy\.stats|scipy\.optimize|numba|rerun"),
    ],
)
def test_a_command_imports_what_it_uses(recorded: Session, tmp_path: Path, arguments: list[str], unwanted: str) -> None:
    """SciPy's statistics alone take a second of processor time."""
    (tmp_path / "s.mcap").symlink_to(recorded.path)
    command = [sys.executable, "-X", "importtime", "-m", "aolink", *arguments]
    result = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=120, check=True)
    imported = {line.rpartition("|")[2].strip() for line in result.stderr.splitlines()}
    assert "aolink.cli.recordings" in imported
    assert not [name for name in imported if re.match(rf"({unwanted})(\.|$)", name)]
