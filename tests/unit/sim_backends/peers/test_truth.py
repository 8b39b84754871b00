"""The truth endpoint, spoken to by a client of a few lines."""

from __future__ import annotations

import json
import socket
from typing import Any

import numpy as np
import pytest

from sim_backends.peers.truth import truth_peer

pytestmark = pytest.mark.wire


def test_the_truth_endpoint_tells_the_truth_and_causes_faults() -> None:
    faults: list[str] = []
    drawn: list[str] = []

    def fault(name: str) -> None:
        if name != "rail.drop_reply":
            raise ValueError(f"unknown fault {name!r}; known: rail.drop_reply")
        faults.append(name)

    peer = truth_peer(lambda: {"pose": np.eye(2), "s": np.float64(0.5)}, fault, faults.clear, drawn.append)
    peer.start()
    host, port = peer.address.split(":")
    with socket.create_connection((host, int(port)), timeout=3.0) as connection, connection.makefile("rwb") as lines:

        def ask(line: bytes) -> dict[str, Any]:
            lines.write(line + b"\n")
            lines.flush()
            reply: dict[str, Any] = json.loads(lines.readline())
            return reply

        assert ask(b'{"op": "truth"}') == {"ok": True, "truth": {"pose": [[1.0, 0.0], [0.0, 1.0]], "s": 0.5}}
        assert ask(b'{"op": "fault", "name": "rail.drop_reply"}') == {"ok": True}
        assert faults == ["rail.drop_reply"]
        assert "known: rail.drop_reply" in ask(b'{"op": "fault", "name": "rail.explode"}')["error"]
        assert ask(b'{"op": "reset"}') == {"ok": True}
        assert faults == []
        assert ask(b'{"op": "make_ready", "drawing": "of a job"}') == {"ok": True}
        assert drawn == ["of a job"]
        for bad in (b'{"op": "dance"}', b"[]", b"not json", b"\xff\xfe", b'{"no": 1}'):
            assert ask(bad)["ok"] is False
    peer.stop()
