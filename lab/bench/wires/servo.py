"""How regularly the arm is streamed to while this program's perception keeps every core busy.

A simulated arm in a process of its own is moved through the real driver. Beside it a bare loop, which does nothing but
sleep until the next 2 ms, shows what this machine lets anybody do at that time: no stream can be more regular.
"""

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.measure.vision.stripe.extract import StripeStream
from cell.run.session.supervisor import Cell
from drivers.arm.child.streaming import pace_of
from drivers.arm.motion import UrMotion
from drivers.arm.ur import UrArm
from drivers.errors import ConfigError
from lab.bench.stripe.truth import Cell as Stripe
from lab.bench.stripe.truth import draw

RATE_HZ, RATE_OFF_HZ, LONGEST_P99_S = 500.0, 0.05, 2.5e-3
"""What the stream has to hold: its rate, by how much that may be off, and 99 % of the times between two points."""
SWING, PERIOD_S = math.radians(3.0), 4.0
SHAPE, PICTURES = (1024, 1280), 16
PERIOD_OF_STREAM_S = 1.0 / RATE_HZ


def measure(seconds: float, seed: int, progress: Callable[[float, str], None]) -> dict[str, Any]:
    """Stream for `seconds` on the wall twice, without and with perception; figures of stream and bare loop."""
    pictures = [draw(Stripe(2.0, 120.0, 0.2), SHAPE, k)[0] for k in range(PICTURES)]
    cores = len(os.sched_getaffinity(0))
    looked_at(pictures)
    rows = []
    with Cell.open(sim="all", seed=seed, speed=1.0, only=("arm",)) as cell:
        for busy in (False, True):
            what = f"perception on {cores} cores" if busy else "nothing else"
            progress(0.5 * busy, what)
            rows.append(streamed(cell, seconds, pictures if busy else [], cores, what))
    return {
        "seconds": seconds, "cores": cores, "rows": rows, "load": round(os.getloadavg()[0], 2),
        "limits": {"rate_hz": [RATE_HZ - RATE_OFF_HZ, RATE_HZ + RATE_OFF_HZ], "p99_ms": 1e3 * LONGEST_P99_S},
        "verdict": _verdict(rows),
    }  # fmt: skip


def streamed(cell: Cell, seconds: float, pictures: list[Any], cores: int, what: str) -> dict[str, Any]:
    """Stream for `seconds` on the wall, beside perception of the `pictures`, if any; paces of stream and loop."""
    # The driver's own: how regularly it sent is its own business, no interface tells it.
    arm = getattr(cell.devices.arm, "bare", cell.devices.arm)
    if not isinstance(arm, UrArm):
        raise ConfigError("only an arm of Universal Robots is streamed to; leave arm.driver as it ships")
    start = arm.state().joints
    times = np.arange(0.0, seconds, PERIOD_OF_STREAM_S)
    # From rest and back to it.
    swing = SWING * np.sin(2.0 * np.pi * times / PERIOD_S) * np.minimum(1.0, np.minimum(times, times[-1] - times))
    joints = np.tile(start, (len(times), 1))
    joints[:, 5] += swing
    loop = subprocess.Popen(
        [sys.executable, "-c", f"from {__name__} import bare_loop; bare_loop({seconds!r})"], stdout=subprocess.PIPE
    )
    motion = arm.follow(times, joints)
    assert isinstance(motion, UrMotion)
    begun, looked = time.monotonic(), 0
    with ThreadPoolExecutor(cores) as pool:
        while not motion.done:
            if pictures:
                looked += sum(pool.map(looked_at, [pictures] * cores))
            else:
                cell.devices.clock.sleep(0.1)
    took = time.monotonic() - begun
    motion.wait(10.0)
    assert motion.pace is not None
    bare = json.loads(loop.communicate()[0])
    return {"beside": what, "pictures_per_s": looked / took, "stream": asdict(motion.pace), "bare": bare}


def looked_at(pictures: list[NDArray[np.uint8]]) -> int:
    """Read the stripes of a stream; returns of how many pictures."""
    stream = StripeStream()
    return sum(stream.extract(picture) is not None for picture in pictures)


def bare_loop(seconds: float) -> None:
    """Sleep until each next 2 ms for so long; prints its pace as JSON."""
    begun = time.monotonic()
    times = []
    for cycle in range(round(seconds / PERIOD_OF_STREAM_S)):
        left = begun + cycle * PERIOD_OF_STREAM_S - time.monotonic()
        if left > 0.0:
            time.sleep(left)
        times.append(time.monotonic())
    pace = pace_of(times)
    assert pace is not None
    print(json.dumps(asdict(pace)))


def _verdict(rows: list[dict[str, Any]]) -> str:
    """held; missed, though the bare loop held; or none, where this machine let nobody hold it."""
    if all(_holds(row["stream"]) for row in rows):
        return "held"
    return "missed" if all(_holds(row["bare"]) for row in rows) else "none: the machine is too busy for a bare loop"


def _holds(pace: dict[str, float]) -> bool:
    return abs(pace["rate"] - RATE_HZ) <= RATE_OFF_HZ and pace["p99"] <= LONGEST_P99_S
