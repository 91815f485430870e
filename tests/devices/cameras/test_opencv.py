"""Films and streams through OpenCV as cameras: whole sessions over real files and real sockets, and what goes wrong."""

from __future__ import annotations

import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from aolink.devices.cameras.opencv import OpenCVCamera, discover
from aolink.errors import DeviceError
from aolink.recording.reader import Recording
from aolink.session import record
from tests.devices.cameras.bench import BITS_8, EXPOSURE_STEPS, pictures, recorded, rig_of, shown_in
from tests.needs import needed

cv2 = needed("cv2")

RATE = 1000 / EXPOSURE_STEPS
CORNER = (20, 10)


def framed(count: int) -> list[np.ndarray]:
    """Colour pictures of 48 x 64 pixels that have the sensor's line somewhere within."""
    whole = np.zeros((count, 48, 64, 3), dtype=np.uint8)
    for picture, line in zip(whole, pictures(count, 8), strict=True):
        picture[CORNER[0], CORNER[1] : CORNER[1] + 40] = line.reshape(-1, 1)
    return list(whole)


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """A film of 20 frames without loss."""
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), RATE, (64, 48))
    for picture in framed(20):
        writer.write(picture)
    writer.release()
    return path


def table(source: object) -> str:
    return f'driver = "opencv"\nsource = {source!r}\ncorner = {[*CORNER]}\ndelay_s = 0.0\ndelay_sd_s = 0.002'


@pytest.mark.slow
def test_a_session_records_a_film_as_it_plays(film: Path, tmp_path: Path) -> None:
    rig = rig_of(table(film.name), tmp_path, **BITS_8)
    report, recording, found = recorded(rig, tmp_path / "a.mcap", 8, ["o3"])
    assert report.ended == "complete"
    assert len(found) >= 8  # more where several arrive at once
    order = shown_in(found, pictures(20, 8))
    assert order == list(range(order[0], order[0] + len(order)))
    assert all(each.alignment_sigma_ns >= 2e6 for each in found)  # what the table says of the delay, at least
    assert recording.metadata["camera"].endswith("film.avi, exposure 0.04 s as the rig file says")
    assert "reports no time" in recording.metadata["camera_lacks"]
    assert "does not count" in recording.metadata["camera_lacks"]


def test_a_film_that_ends_ends_the_session_with_what_there_is(film: Path, tmp_path: Path) -> None:
    rig = rig_of(table(film.name), tmp_path, **BITS_8)
    with pytest.raises(DeviceError, match=r"film.avi has ended after 20 frames: ask for fewer exposures; .* are saved"):
        record(rig, None, None, tmp_path / "a.mcap", exposures=50)
    recording = Recording(tmp_path / "a.mcap")
    found = list(recording.exposures())
    assert shown_in(found, pictures(20, 8)) == list(range(20 - len(found), 20))
    assert "sensor.row_time_s" in recording.metadata["camera_lacks"]


class Stream(BaseHTTPRequestHandler):
    """A network camera: JPEG after JPEG, one each frame period, until its frames have run out."""

    frames = 30

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
        self.end_headers()
        try:
            for picture in framed(self.frames):
                jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
                head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
                self.wfile.write(head.encode() + jpeg + b"\r\n")
                time.sleep(1 / RATE)  # the camera's own rate
        except ConnectionError:
            pass

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def stream() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), Stream) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}/"
        server.shutdown()


def test_a_camera_on_the_network_that_goes_away_ends_the_session(stream: str, tmp_path: Path) -> None:
    """Up to then its frames are recorded, grey as they are, but for what JPEG makes of them."""
    rig = rig_of(table(stream), tmp_path, **BITS_8)
    with pytest.raises(DeviceError, match=r"127.0.0.1.* gives no more frames: is it still connected\?; .* are saved"):
        record(rig, None, None, tmp_path / "a.mcap", exposures=50)
    found = list(Recording(tmp_path / "a.mcap").exposures())
    assert found
    for each in found:
        nearest = min(np.abs(each.pixels.astype(int) - picture).max() for picture in pictures(Stream.frames, 8))
        assert nearest <= 4


@pytest.mark.parametrize(
    ("source", "changes", "what"),
    [
        (987, {}, r"OpenCV cannot open camera 987: is it connected, not in use, and may you read it\?"),
        ("987", {}, r"OpenCV cannot open camera 987"),
        ("none.avi", {}, r"OpenCV cannot open none.avi"),
        ("text.avi", {}, r"OpenCV cannot open text.avi"),
        ("film.avi", {"pixels": (40, 80)}, r"film.avi gives \(48, 64\) pixels, the rig file's sensor has \(1, 80\)"),
        ("film.avi", {"fast_step_s": (0.001, 0.002)}, r"takes 25 frames a second, the rig file says 12.5: correct"),
    ],
)
def test_what_cannot_be_read_is_refused_when_it_is_opened(
    film: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str],
    source: int | str, changes: dict[str, tuple[object, object]], what: str,
) -> None:  # fmt: skip
    """In one line: OpenCV's own log is silent about it."""
    (tmp_path / "text.avi").write_text("no film")
    rig = rig_of(table(source), tmp_path, **BITS_8, **changes)
    with pytest.raises(DeviceError, match=what):
        OpenCVCamera(rig, source=source, corner=[*CORNER])
    assert capfd.readouterr().err == ""


def test_cameras_are_found_without_being_opened() -> None:
    assert all(index.isdecimal() and name for index, name in discover())
