"""How a device is put to a suite, what every device promises, and what the cell relies on in camera, laser and claw."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import numpy as np
import pytest

from drivers.clock import Clock
from drivers.errors import InterlockError, LimitError, NotConnectedError
from drivers.interfaces import Camera, Claw, Device, Laser

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


class DeviceContract:
    """Who it is, a round trip, a stop and an end. A suite of a kind derives from it; its user brings `bench`."""

    def test_it_says_who_it_is(self, bench: Bench[Device]) -> None:
        """Model and address are not empty: a calibration and `cell diag` go by them."""
        who = bench.device.identity()
        assert who.model
        assert who.address

    def test_a_ping_takes_wall_time(self, bench: Bench[Device]) -> None:
        """Seconds on the wall, not milliseconds."""
        assert 0.0 <= bench.device.ping() < 5.0

    def test_a_stop_at_rest_does_no_harm_twice(self, bench: Bench[Device]) -> None:
        """`stop` is idempotent."""
        bench.device.stop()
        bench.device.stop()

    def test_it_is_closed_once_and_for_all(self, bench: Bench[Device]) -> None:
        """`close` is idempotent; afterwards nothing is asked of it any more; it can be connected again."""
        device = bench.device
        try:
            device.close()
            device.close()
            if bench.linked:
                with pytest.raises(NotConnectedError):
                    device.ping()
        finally:
            bench.over()
        assert bench.device.identity().model


EXPOSURE_S, RATE_HZ = 0.005, 10.0
TIMEOUT_S = 10.0


class CameraContract(DeviceContract):
    """A camera that takes 5 ms at 10 Hz."""

    def test_a_picture_began_after_it_was_asked_for(self, bench: Bench[Camera]) -> None:
        """8 bits in the camera's shape, exposed as configured, never a buffered one."""
        camera = bench.device
        camera.configure(EXPOSURE_S, RATE_HZ)
        last = -1
        for _ in range(3):
            asked = bench.clock.now()
            frame = camera.grab(TIMEOUT_S)
            assert frame.image.shape == camera.shape
            assert frame.image.dtype == np.uint8
            assert frame.exposure == pytest.approx(EXPOSURE_S, rel=0.02)
            assert frame.host_time >= asked - camera.time_bound
            assert frame.mid_exposure == pytest.approx(frame.host_time + EXPOSURE_S / 2, abs=1e-4)
            assert frame.frame_id > last
            last = frame.frame_id

    def test_a_stream_comes_in_order_at_its_rate_and_knows_its_losses(self, bench: Bench[Camera]) -> None:
        """Ids count every exposure, and times are those of the exposures."""
        camera = bench.device
        camera.configure(EXPOSURE_S, RATE_HZ)
        with camera.stream() as frames:
            made = [frames.next(TIMEOUT_S) for _ in range(6)]
            with pytest.raises(InterlockError):
                camera.grab(TIMEOUT_S)
            with pytest.raises(InterlockError):
                camera.configure(EXPOSURE_S, RATE_HZ)
        ids = np.diff([frame.frame_id for frame in made])
        assert (ids >= 1).all()
        assert [frame.lost_before for frame in made[1:]] == list(ids - 1)
        assert np.diff([frame.host_time for frame in made]) / ids == pytest.approx(1.0 / RATE_HZ, rel=0.05)
        assert camera.grab(TIMEOUT_S).frame_id > made[-1].frame_id

    def test_limits_are_kept_before_anything_is_sent(self, bench: Bench[Camera]) -> None:
        """`LimitError`, and the settings stay."""
        camera = bench.device
        camera.configure(EXPOSURE_S, RATE_HZ)
        for exposure, rate in ((1e-9, RATE_HZ), (1e4, RATE_HZ), (EXPOSURE_S, 1e6), (0.2, RATE_HZ)):
            with pytest.raises(LimitError):
                camera.configure(exposure, rate)
        assert camera.grab(TIMEOUT_S).exposure == pytest.approx(EXPOSURE_S, rel=0.02)


def shines(laser: Laser) -> bool:
    """What its output shows now: asked anew each time."""
    return laser.is_on


class LaserContract(DeviceContract):
    """A laser that may be lit for a moment."""

    def test_it_is_lit_inside_its_context_alone(self, bench: Bench[Laser]) -> None:
        """Whatever happens inside; `is_on` is what the output shows."""
        laser = bench.device
        assert not shines(laser)
        with laser.lit():
            assert shines(laser)
        assert not shines(laser)
        with pytest.raises(ZeroDivisionError), laser.lit():
            _ = 1 / 0
        assert not shines(laser)

    def test_it_has_one_owner(self, bench: Bench[Laser]) -> None:
        """A second one is an `InterlockError`, and the first keeps it."""
        laser = bench.device
        with laser.lit():
            with pytest.raises(InterlockError), laser.lit():
                pass
            assert shines(laser)

    def test_it_goes_out_although_its_arm_has_a_fault(self, bench: Bench[Laser]) -> None:
        """At the end of its context, by a stop, and again by the next."""
        laser = bench.device
        with bench.faulty() as faults:
            with laser.lit():
                faults.cause("arm.protective_stop")
                bench.clock.sleep(0.5)
            assert not shines(laser)
            laser.stop()
            laser.stop()
            assert not shines(laser)

    def test_a_stop_puts_it_out_whoever_has_it(self, bench: Bench[Laser]) -> None:
        """And it can be lit again."""
        laser = bench.device
        with laser.lit():
            laser.stop()
            assert not shines(laser)
        with laser.lit():
            assert shines(laser)


class ClawContract(DeviceContract):
    """A claw that has a part between its fingers, held or not. It opens: see that the part cannot fall."""

    def test_a_stop_does_not_drop_the_part(self, bench: Bench[Claw]) -> None:
        """Nor does an end."""
        claw = bench.device
        held = claw.holding
        claw.stop()
        assert claw.holding == held
        claw.close()
        if bench.linked:
            bench.over()
        assert bench.device.holding == held

    def test_a_held_part_is_held_again(self, bench: Bench[Claw]) -> None:
        """`grip` on a part that is held comes back, and it is held still."""
        claw = bench.device
        if not claw.holding:
            pytest.skip("no part is in it")
        claw.grip()
        assert claw.holding
