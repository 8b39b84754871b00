"""How far a test's clock is ahead of its simulated world's, though the test may not be run between two readings."""

from collections.abc import Callable

from drivers.clock import Clock
from sim_backends.clock import WorldClock

COMPARISONS = 20


def ahead(clock: Clock, world: WorldClock) -> float:
    """Seconds by which `clock` is ahead of `world`: by the comparison that took the shortest of some."""
    tried = [(clock.now(), world.now(), clock.now()) for _ in range(COMPARISONS)]
    before, there, after = min(tried, key=lambda times: times[2] - times[0])
    return 0.5 * (before + after) - there


def until(clock: WorldClock, condition: Callable[[], object], seconds: float = 60.0) -> None:
    """Wait for something, at most `seconds` of the world."""
    deadline = clock.now() + seconds
    while not condition():
        assert clock.now() < deadline, "not within the deadline"
        clock.sleep(0.02)
