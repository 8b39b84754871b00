"""Child side of `last_words`: run by its path, with the standard library's core only, so that it starts at once."""

import os
import signal
import sys
import time


def main(pipe: int, port: int, pause: float, words: list[bytes]) -> None:
    """Wait for the end of `pipe`; write `words` to `port`, unless the owner has said goodbye."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    said = b""
    while data := os.read(pipe, 64):
        said += data
    if said:
        return
    for word in words:
        try:
            os.write(port, word)
        except OSError:
            return
        time.sleep(pause)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), [bytes.fromhex(word) for word in sys.argv[4:]])
