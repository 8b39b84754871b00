"""Promises of `drivers.arm.dashboard`."""

from __future__ import annotations

import threading
import time

import pytest

from drivers.arm.dashboard import Dashboard
from drivers.errors import DeadlineError, NotConnectedError


def test_the_dashboard_answers_line_by_line_over_one_connection(server):
    def serve():
        client, _ = server.accept()
        with client:
            client.sendall(b"Connected\n")
            for question in client.makefile("rb"):
                client.sendall(b"you said " + question)
                if question == b"stop\n":
                    client.sendall(b"nobody asked for this\n")

    threading.Thread(target=serve, daemon=True).start()
    dashboard = Dashboard("arm", server.getsockname()[0])
    assert (dashboard.ask("robotmode"), dashboard.ask("stop")) == ("you said robotmode", "you said stop")
    time.sleep(0.1)
    assert dashboard.ask("robotmode") == "you said robotmode"
    dashboard.close()


def test_a_silent_dashboard_is_a_deadline_and_a_missing_one_is_not_connected(server):
    dashboard = Dashboard("arm", server.getsockname()[0], timeout=0.05)
    with pytest.raises(DeadlineError, match=r"did not answer 'stop' within 0\.05 s"):
        dashboard.ask("stop")
    with pytest.raises(NotConnectedError, match=r"127\.255\.0\.9:29999 is not reachable"):
        Dashboard("arm", "127.255.0.9").ask("stop")
