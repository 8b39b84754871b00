"""What the cell relies on in a laser and in a claw."""

from __future__ import annotations

import pytest

from cell.devices.contracts import Bench
from cell.devices.contracts.device import DeviceContract
from drivers.errors import InterlockError
from drivers.interfaces import Claw, Laser


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
