"""Contract suites, one per kind of device: what the cell relies on, as tests that any make can be put to.

A make's own tests derive from a suite and say how its device is connected:

    from cell.devices.contracts import Bench
    from cell.devices.contracts.rail import RailContract

    class TestAcmeRail(RailContract):
        @pytest.fixture(scope="class")
        @classmethod
        def bench(cls) -> Iterator[Bench[Rail]]:
            clock = Clock()
            made = Bench(lambda: AcmeRail("rail", "/dev/acme0", clock=clock), clock, motion=0.2)
            yield made
            made.over()

The devices of a configured cell, simulated or real, are put to them all by

    CELL_CONTRACTS=cell.toml CELL_CONTRACTS_MOTION=0.2 pytest --pyargs cell.devices.contracts.test_configured

They move: by `motion` times what a suite would do by itself, and as fast.

A simulated device is also given faults, where its bench says how (`Faults`); with a real one those tests are skipped.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import pytest

from drivers.clock import Clock
from drivers.interfaces import Device

Connected = TypeVar("Connected", bound=Device)


class Faults(Protocol):
    """How a simulated device is given a fault, and how what caused it is taken away, as a person would."""

    def cause(self, name: str) -> None:
        """Cause the fault with this code, such as `arm.protective_stop`, now."""

    def clear(self) -> None:
        """Take away whatever causes faults: the button is released, the motor is well again, an arm that the device
        hangs on is ready again."""


@dataclass(eq=False)
class Bench(Generic[Connected]):
    """How a device is come by: `connect()` gives it anew, on `clock`; `motion` (0 to 1) scales ways and speeds.

    `linked` is false for a device without a connection that could be closed. It is closed by `over()`. `faults` is
    there for a simulated device alone.
    """

    connect: Callable[[], Connected]
    clock: Clock
    motion: float = 1.0
    linked: bool = True
    faults: Faults | None = None
    _open: list[Connected] = field(default_factory=list)

    @property
    def device(self) -> Connected:
        """The device, connected when it is first asked for."""
        if not self._open:
            self._open.append(self.connect())
        return self._open[0]

    @contextmanager
    def faulty(self) -> Iterator[Faults]:
        """The faults that can be caused inside this context; at its end all causes are gone. A real device skips."""
        if self.faults is None:
            pytest.skip("a fault is caused in a simulated device only")
        try:
            yield self.faults
        finally:
            self.faults.clear()

    def over(self) -> None:
        """Close it; the next test connects anew."""
        while self._open:
            self._open.pop().close()

    @contextmanager
    def timed(self, took: list[float]) -> Iterator[None]:
        """Append to `took` how many seconds of the clock passed inside this context."""
        begun = self.clock.now()
        yield
        took.append(self.clock.now() - begun)
