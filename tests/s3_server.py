"""A server on this machine that speaks S3, and counts what it sends of the objects that it is asked for."""

from __future__ import annotations

import logging
import threading
import urllib.request
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from tests.needs import needed


class S3Server:
    """What `serving_s3` gives."""

    def __init__(self) -> None:
        self.sent: list[int] = []
        """Bytes of each answer to a request for an object."""
        self.url = ""
        moto = needed("moto.moto_server.werkzeug_app")
        self._application = moto.DomainDispatcherApplication(moto.create_backend_app)

    def __call__(self, environment: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        def start(status: str, headers: list[tuple[str, str]], *rest: Any) -> Any:
            if environment["REQUEST_METHOD"] == "GET" and status[:3] in ("200", "206"):
                self.sent.append(int(dict(headers).get("Content-Length", 0)))
            return start_response(status, headers, *rest)

        answer: Iterable[bytes] = self._application(environment, start)
        return answer

    def refuse_strangers(self) -> None:
        """From now on only users that the server knows may do anything; it knows none."""
        self._tell("reset-auth", b"0")

    def forget(self) -> None:
        """All objects, and who may do what: one process has one memory of them, whatever servers it runs."""
        self._tell("reset-auth", b"inf")
        self._tell("reset", b"")

    def _tell(self, what: str, data: bytes) -> None:
        header = {"Content-Type": "text/plain"}
        request = urllib.request.Request(f"{self.url}/moto-api/{what}", data=data, headers=header, method="POST")
        urllib.request.urlopen(request).close()


@contextmanager
def serving_s3() -> Iterator[S3Server]:
    """Run it in a thread."""
    logging.getLogger("werkzeug").setLevel(logging.ERROR)  # requests are no news
    served = S3Server()
    server = needed("werkzeug.serving").make_server("127.0.0.1", 0, served, threaded=True)
    served.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        served.forget()
        yield served
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
