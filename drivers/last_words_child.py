"""Child side of `last_words`: run by its path, with the standard library's core only, so that it starts at once.

It also says when a process counts as frozen, for the arm's own child process.
"""

import os
import select
import signal
import sys
import time
from contextlib import suppress

BEAT, REST, ALIVE, GOODBYE = b"+", b"-", b".", b"b"
FROZEN_S = 0.25
"""An owner without a beat that used no processor time for so long, nor waits for a processor, is frozen: stopped,
swapped out, in a debugger."""
HUNG_S = 2.0
"""An owner without a beat for so long counts as frozen even if it computes, or this computer is too busy for it."""
LOOK_S = 0.05
ALONE_S = 0.3
"""Processor time that a thread in real time may take without waiting once."""


class Owner:
    """Signs of life of the process `pid`: its beats, the processor time that it uses, and that it waits for some. The
    time counts as well, because a process that computes may hold Python's lock and send no beat meanwhile."""

    def __init__(self, pid: int) -> None:
        self._stat, self._threads = f"/proc/{pid}/stat", f"/proc/{pid}/task"
        self._beat = self._sign = float("inf")
        self._used = b""
        self._looked = time.monotonic()

    def beat(self) -> None:
        """The owner has sent a beat. It is watched from the first one on."""
        self._beat = self._sign = time.monotonic()

    def frozen(self) -> bool:
        """Whether the owner gave no sign of life for too long; asked at least every `LOOK_S`."""
        now, used = time.monotonic(), self._processor_time()
        # Time in which this process did not run itself says nothing of the owner.
        blind, self._looked = max(0.0, now - self._looked - 2 * LOOK_S), now
        self._beat, self._sign = self._beat + blind, self._sign + blind
        if used != self._used and self._sign < now:
            self._used, self._sign = used, now
        elif now - self._sign > FROZEN_S and self._waits():
            self._sign = now
        return now - self._sign > FROZEN_S or now - self._beat > HUNG_S

    def _processor_time(self) -> bytes:
        with suppress(OSError), open(self._stat, "rb") as stat:  # noqa: PTH123 (pathlib starts too slowly here)
            # utime and stime, the 14th and 15th field; the name before them may contain blanks.
            return b" ".join(stat.read().rpartition(b")")[2].split()[11:13])
        return b""

    def _waits(self) -> bool:
        """Whether one of its threads could run, if this computer had a processor for it: none of a stopped process."""
        with suppress(OSError):
            for thread in os.listdir(self._threads):  # noqa: PTH208 (pathlib starts too slowly here)
                with suppress(OSError), open(f"{self._threads}/{thread}/stat", "rb") as stat:  # noqa: PTH123
                    if stat.read().rpartition(b")")[2].split()[0] == b"R":
                        return True
        return False


def raise_priority() -> None:
    """Run before the processes that compute, where the system allows it: in real time, else with a lower niceness. A
    thread that spins in real time would leave nothing to all others: after `ALONE_S` this process loses the right."""
    try:
        import resource  # not on Windows, where this file is imported as well

        _, most = resource.getrlimit(resource.RLIMIT_RTTIME)
        resource.setrlimit(resource.RLIMIT_RTTIME, (int(1e6 * ALONE_S), most))
        signal.signal(signal.SIGXCPU, lambda number, frame: _lower_priority())
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except (ImportError, AttributeError, OSError, ValueError):
        with suppress(OSError, AttributeError):
            os.setpriority(os.PRIO_PROCESS, 0, -10)


def _lower_priority() -> None:
    for thread in os.listdir("/proc/self/task"):  # noqa: PTH208 (pathlib starts too slowly here)
        with suppress(OSError):
            os.sched_setscheduler(int(thread), os.SCHED_OTHER, os.sched_param(0))


def main(pipe: int, told: int, port: int, pause: float, silence: float, words: list[bytes]) -> None:
    """Wait for the end of `pipe`; write `words` to `port`, unless the owner has said goodbye.

    They are also written while the owner is frozen, which `told` is told each time. From a beat until a rest they are
    also written each time that nothing was heard for `silence` s: an owner that hung may begin a motion afterwards.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    raise_priority()
    owner = Owner(os.getppid())
    attended_until = float("inf")
    while True:
        unattended = time.monotonic() > attended_until
        if unattended or owner.frozen():
            if not unattended:
                with suppress(OSError):
                    os.write(told, b"!")
            if not say(port, pause, words):
                return
            # Again if it goes on.
            owner.beat()
            attended_until = time.monotonic() + silence if unattended else attended_until
        if not select.select([pipe], [], [], min(LOOK_S, max(0.0, attended_until - time.monotonic())))[0]:
            continue
        heard = os.read(pipe, 4096)
        if GOODBYE in heard:
            return
        if not heard:
            break
        owner.beat()
        if said := heard.replace(ALIVE, b""):
            attended_until = time.monotonic() + silence if said[-1:] == BEAT else float("inf")
    say(port, pause, words)


def say(port: int, pause: float, words: list[bytes]) -> bool:
    """Write the words to the port; whether it took them."""
    for word in words:
        try:
            os.write(port, word)
        except OSError:
            return False
        time.sleep(pause)
    return True


if __name__ == "__main__":
    pipe_end, told_end, port_end, pause_s, silence_s, *said = sys.argv[1:]
    last = [bytes.fromhex(word) for word in said]
    main(int(pipe_end), int(told_end), int(port_end), pause=float(pause_s), silence=float(silence_s), words=last)
