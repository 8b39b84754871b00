"""Pages that flood a console, in a process of their own: `python -m tests.support.console.flood HOST` with cookie and
key of each on standard input, a line each. It prints that it begins and, when its input ends, how much was said."""

import subprocess
import sys
import threading
import time

from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.support.console.server import Served

SESSIONS, PER_S = 4, 400.0
UNDERSTOOD = (
    '{"type": "stop"}',
    '{"type": "jog_end", "press": 1}',
    '{"type": "jog", "press": 1, "device": "arm", "axis": "z", "sign": 1, "at": 1.0}',
)
"""What a page says; the last of the sessions says `RUBBISH` as well, for which its link is closed."""
RUBBISH = ("[]", "x" * 2000)


class Flood:
    """`SESSIONS` browsers of `server`, each with its own link, that try to say `PER_S` things a second; a context. At
    its end `rate` is how many they said a second."""

    def __init__(self, server: Served) -> None:
        keys = [server.enter() for _ in range(SESSIONS)]
        self._keys = "".join(f"{cookie}\n{key}\n" for cookie, key in keys) + "\n"
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.console.flood", server.host],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip

    def __enter__(self) -> "Flood":
        self._process.stdin.write(self._keys)
        self._process.stdin.flush()
        self._process.stdout.readline()
        self._begun = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        seconds = time.monotonic() - self._begun
        said, _ = self._process.communicate(timeout=20)
        self.rate = int(said) / seconds


class _Page(Served):
    """A browser that has its cookie and key already."""

    def __init__(self, host: str, cookie: str, key: str, says: tuple[str, ...]) -> None:
        self.host, self.origin, self.port = host, f"http://{host}", int(host.rpartition(":")[2])
        self._cookie, self._key = cookie, key
        self.said, self._says = 0, says

    def flood(self) -> None:
        """On the live link; by commands while that is refused."""
        page, due = None, time.monotonic()
        while True:
            time.sleep(max(0.0, due - time.monotonic()))
            due += 1.0 / PER_S
            try:
                page = page or self.live()
                page.send(self._says[self.said % len(self._says)])
            except ConnectionClosed:
                page = None
            except (InvalidStatus, OSError):
                page = None
                self.do(do="stop")
            self.said += 1


def _main(host: str) -> None:
    given = list(iter(lambda: sys.stdin.readline().strip(), ""))
    says = [UNDERSTOOD] * (SESSIONS - 1) + [UNDERSTOOD + RUBBISH]
    pages = [_Page(host, *of) for of in zip(given[::2], given[1::2], says, strict=True)]
    for page in pages:
        threading.Thread(target=page.flood, daemon=True).start()
    print("begun", flush=True)
    sys.stdin.read()
    print(sum(page.said for page in pages), flush=True)


if __name__ == "__main__":
    _main(sys.argv[1])
