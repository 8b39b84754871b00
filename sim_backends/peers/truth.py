"""Endpoints of a simulated world that are no part of any device, as lines of JSON (see `JsonLinesPeer`).

`truth_peer` is for reports and for causing faults: {"op": "truth"} → {"truth": {…}}, {"op": "fault", "name": …},
{"op": "make_ready", "drawing": …}, {"op": "reset"}.

`following_peer` is where a world is told of real devices: {"op": "time"} → {"time": world s}; {"op": "begin", "table":
[[…]], "outputs": bits} before the arm's first reading; {"op": "tell", "device": …, "rows": [[…]]} → {"wrenches":
[[…]]}; {"op": "board", "base_from_board": [[…]]}; {"op": "switch", "output": n, "on": …} and {"op": "connector"} →
inputs and outputs as bits, for a laser or claw that is simulated beside a real arm; {"op": "figures"}.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sim_backends.peers.server import JsonLinesPeer
from sim_backends.world.following import WorldFollowing
from sim_backends.world.world import World

_LONGEST_READINGS = 4 * 1024 * 1024


def truth_peer(
    truth: Callable[[], dict[str, object]],
    fault: Callable[[str], None],
    reset: Callable[[], None],
    make_ready: Callable[[str], None],
) -> JsonLinesPeer:
    """`truth` gives the whole truth; `fault` causes a fault by name, with ValueError for one it does not know.

    `reset` takes away all faults; `make_ready` makes the world ready for the job of a drawing's text, with ValueError
    for what is none of this cell.
    """
    return JsonLinesPeer(
        "truth",
        {
            "truth": lambda request: {"truth": truth()},
            "fault": lambda request: fault(str(request.get("name"))),
            "make_ready": lambda request: make_ready(str(request.get("drawing"))),
            "reset": lambda request: reset(),
        },
    )


def following_peer(world: World, following: WorldFollowing) -> JsonLinesPeer:
    """Of a `world` that follows real devices."""

    def board(request: Mapping[str, Any]) -> None:
        pose = np.array(request["base_from_board"], dtype=np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError("base_from_board is a pose, 4 by 4")
        following.board_seen(pose)

    return JsonLinesPeer(
        "following",
        {
            "time": lambda request: {"time": world.clock.now()},
            "begin": lambda request: following.begin_arm(request["table"], request["outputs"]),
            "tell": lambda request: {"wrenches": following.tell(request["device"], request["rows"])},
            "board": board,
            "switch": lambda request: following.switch(int(request["output"]), bool(request["on"]), world.clock.now()),
            "connector": lambda request: {"inputs": world.arm.digital_inputs, "outputs": world.arm.digital_outputs},
            "figures": lambda request: {"figures": following.figures()},
        },
        _LONGEST_READINGS,
    )
