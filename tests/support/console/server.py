"""A server as a cell starts it, for tests that talk to it as strangers do: over sockets, with clients not made here."""

import http.client
import json
import queue
import re
import socket
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from cell.apps.console.host.controller import ConsoleController
from cell.apps.console.host.link import Answer, AskCell, Do, Ready, ServerProcess, ServerSetup
from drivers.errors import CellError

HOSTS = ("127.0.0.1", "localhost")


class Served:
    """The server, and this side of its pipes: `heard` are its messages, `stops` counts what its stop pipe asked for.
    `begun` says when, and each takes `stop_s`."""

    def __init__(self, runs: Path, lasting: str | None = None) -> None:
        bound = socket.socket()
        bound.bind(("127.0.0.1", 0))
        self.port: int = bound.getsockname()[1]
        self.host = f"127.0.0.1:{self.port}"
        self.origin = f"http://{self.host}"
        self.heard: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.tokens: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.stops = 0
        self.stop_s = 0.0
        self.begun: list[float] = []
        self.trouble: str | None = None
        facts = {"version": 1, "name": "test"}
        self.process = ServerProcess(
            lambda fd: ServerSetup(fd, self.port, HOSTS, lasting, None, None, str(runs), facts, str(runs), 86_400.0),
            bound, self._hear, self._stop, lambda: None,
        )  # fmt: skip
        self._cookie = self._key = ""

    def _hear(self, message: object) -> None:
        match message:
            case Ready(str() as token):
                self.tokens.put(token)
            case Do(number, _, words):
                self.heard.put(message)
                if words.get("do") != "diag":
                    self.process.notify(Answer(number, 200, {"ok": True, "text": str(words.get("do"))}))
            case AskCell(number, job):
                self.process.notify(Answer(number, 200, {"job": job}))
            case _:
                self.heard.put(message)

    def _stop(self) -> str | None:
        self.begun.append(time.monotonic())
        self.stops += 1
        time.sleep(self.stop_s)
        return self.trouble

    def forget(self) -> None:
        """Hear nothing of what was said until now."""
        while not self.heard.empty():
            self.heard.get()

    # --- clients ---

    def enter(self, token: str | None = None) -> tuple[str, str]:
        """Cookie and key of a browser that has opened the link."""
        token = self.tokens.get(timeout=20) if token is None else token
        answer = self.ask("GET", f"/enter?token={token}", cookie=None, x_cell_key=None)
        assert answer.status == 200, answer.text
        self._cookie = answer.headers["set-cookie"].partition(";")[0]
        self._key = answer.text.partition("#key=")[2].partition('"')[0]
        return self._cookie, self._key

    @property
    def cookie(self) -> str:
        """Of the browser that opened the link last."""
        return self._cookie or self.enter()[0]

    @property
    def key(self) -> str:
        """Of its page."""
        return self._key or self.enter()[1]

    def ask(
        self, method: str, path: str, body: str | bytes | None = None, *, cookie: str | None = "", **headers: str | None
    ) -> "Reply":
        """One request by the standard library's client; headers of None are left out."""
        sent: dict[str, str | None] = {"host": self.host, "origin": self.origin if method == "POST" else None}
        sent |= {"cookie": self.cookie if cookie == "" else cookie}
        sent |= {"x-cell-key": self._key if cookie == "" else None}
        sent |= {"content-type": "application/json"} if method == "POST" else {}
        sent |= {name.replace("_", "-"): value for name, value in headers.items()}
        with closing(http.client.HTTPConnection("127.0.0.1", self.port, timeout=20)) as link:
            link.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
            for name, value in sent.items():
                if value is not None:
                    link.putheader(name, value)
            data = body.encode() if isinstance(body, str) else body
            if data is not None:
                link.putheader("content-length", str(len(data)))
            link.endheaders(data)
            return Reply(link.getresponse())

    def do(self, **words: Any) -> "Reply":
        """A command."""
        return self.ask("POST", "/api/do", json.dumps(words))

    def live(self, **options: Any) -> ClientConnection:
        """A page's live link; a context as well, or to be closed."""
        headers = {"cookie": self.cookie} | options.pop("headers", {})
        origin = options.pop("origin", self.origin)
        url = options.pop("url", f"ws://{self.host}/live")
        options = {"subprotocols": ["cell", self.key], "max_size": None, "compression": None} | options
        # Some versions of websockets connect as the context begins.
        return connect(url, additional_headers=headers, origin=origin, **options).__enter__()

    def head(self, request: str = "POST /api/do", *lines: str) -> str:
        """The head of a request as this browser's page sends it, still open; `lines` come last."""
        own = f"Host: {self.host}", f"Origin: {self.origin}", f"Cookie: {self.cookie}", f"X-Cell-Key: {self.key}"
        return "\r\n".join([f"{request} HTTP/1.1", *own, "Content-Type: application/json", *lines, ""])

    def raw(self, request: bytes) -> bytes:
        """What comes back to these bytes, until the other side has nothing more to say."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=20) as link:
            link.sendall(request)
            link.settimeout(3.0)
            said = b""
            try:
                while data := link.recv(65536):
                    said += data
                    if re.match(rb"HTTP/1.1 \d+", said) and b"\r\n\r\n" in said:
                        break
            except TimeoutError:
                pass
            return said


class Browser(Served):
    """A stranger's client at the address of a console's link."""

    def __init__(self, link: str) -> None:
        self.host = link.split("/")[2]
        self.port = int(self.host.rpartition(":")[2])
        self.origin = f"http://{self.host}"
        self.token = link.partition("token=")[2]
        self.enter(self.token)


class Reply:
    """Status, headers and body of an answer."""

    def __init__(self, response: http.client.HTTPResponse) -> None:
        self.status = response.status
        self.headers = {name.lower(): value for name, value in response.getheaders()}
        self.text = response.read().decode("utf-8", "replace")

    @property
    def words(self) -> dict[str, Any]:
        return json.loads(self.text)


def refusal(controller: ConsoleController, client: str, **words: Any) -> CellError:
    """What the controller answers to a command that it refuses."""
    with pytest.raises(CellError) as refused:
        controller.do(client, words)
    return refused.value


@contextmanager
def serving(runs: Path, lasting: str | None = None) -> Iterator[Served]:
    """A server; ended afterwards."""
    served = Served(runs, lasting)
    with closing(served.process):
        yield served
