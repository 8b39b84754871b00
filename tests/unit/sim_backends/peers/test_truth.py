"""The truth endpoint, spoken to by a client of a few lines."""

import json
import socket

import numpy as np
import pytest

from sim_backends.peers.truth import truth_peer

pytestmark = pytest.mark.wire


def test_the_truth_endpoint_tells_the_truth_and_causes_faults():
    faults: list[str] = []
    drawn: list[str] = []
    peer = truth_peer(
        lambda: {"pose": np.eye(2), "s": np.float64(0.5)}, faults.append, lambda: faults.append("reset"), drawn.append
    )
    peer.start()
    replies = []
    with (
        socket.create_connection((peer.host, peer.port), timeout=3.0) as connection,
        connection.makefile("rwb") as lines,
    ):
        for request in (
            {"op": "truth"}, {"op": "fault", "name": "rail.drop_reply"}, {"op": "reset"},
            {"op": "make_ready", "drawing": "of a job"},
        ):  # fmt: skip
            lines.write(json.dumps(request).encode() + b"\n")
            lines.flush()
            replies.append(json.loads(lines.readline()))
    peer.stop()
    assert replies == [{"ok": True, "truth": {"pose": [[1.0, 0.0], [0.0, 1.0]], "s": 0.5}}, *[{"ok": True}] * 3]
    assert (faults, drawn) == (["rail.drop_reply", "reset"], ["of a job"])
