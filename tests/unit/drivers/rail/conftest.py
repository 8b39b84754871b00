"""The rail on its wire, and the same homed."""

import socket
import threading
from collections.abc import Callable, Iterator

import pytest

from tests.support.wire.rail_bench import Bench, benched, reply


@pytest.fixture
def bench() -> Iterator[Bench]:
    with benched() as made:
        yield made
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("rail motion")]


@pytest.fixture
def homed(bench: Bench) -> Bench:
    bench.rail.home().wait(20.0)
    return bench


@pytest.fixture
def module() -> Iterator[Callable[..., str]]:
    """Starts a module that gives `answer(request)` to each request, but tells its settings as they were set. `settings`
    are those that it begins with, `stubborn` those that it keeps. Returns its URL."""
    listener = socket.create_server(("127.0.0.1", 0))
    threads: list[threading.Thread] = []

    def start(
        answer: Callable[[bytes], bytes], settings: dict[int, int] | None = None, stubborn: tuple[int, ...] = ()
    ) -> str:
        kept = {255: 1} if settings is None else settings

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                while request := connection.recv(9):
                    if request[1] == 5 and request[2] not in stubborn:
                        kept[request[2]] = int.from_bytes(request[4:8], "big", signed=True)
                    told = request[1] == 6 and request[2] in kept
                    connection.sendall(reply(request, kept[request[2]]) if told else answer(request))

        threads.append(threading.Thread(target=serve, daemon=True))
        threads[-1].start()
        return f"socket://127.0.0.1:{listener.getsockname()[1]}"

    yield start
    for thread in threads:
        thread.join(2.0)
        assert not thread.is_alive()
    listener.close()
