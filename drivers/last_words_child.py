"""Child side of `last_words`: run by its path, with the standard library's core only, so that it starts at once."""

import os
import select
import signal
import sys
import time

BEAT, REST, GOODBYE = b"+", b"-", b"b"


def main(pipe: int, port: int, pause: float, silence: float, words: list[bytes]) -> None:
    """Wait for the end of `pipe`; write `words` to `port`, unless the owner has said goodbye.

    From a beat until a rest they are also written each time that nothing was heard for `silence` s: an owner that hung
    may begin a motion afterwards.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    attended = False
    while True:
        if attended and not select.select([pipe], [], [], silence)[0]:
            if not say(port, pause, words):
                return
            continue
        heard = os.read(pipe, 64)
        if GOODBYE in heard:
            return
        if not heard:
            break
        attended = heard[-1:] == BEAT
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
    pipe_end, port_end, pause_s, silence_s, *said = sys.argv[1:]
    main(int(pipe_end), int(port_end), float(pause_s), float(silence_s), [bytes.fromhex(word) for word in said])
