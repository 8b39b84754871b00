"""What every device promises, of whatever kind. Derive from the suite of a kind, not from this."""

from __future__ import annotations

from typing import Any

import pytest

from cell.devices.contracts import Bench
from drivers.errors import NotConnectedError


class DeviceContract:
    """Who it is, a round trip, a stop and an end. `bench` is a fixture of the class that derives from this."""

    def test_it_says_who_it_is(self, bench: Bench[Any]) -> None:
        """Model and address are not empty: a calibration and `cell diag` go by them."""
        who = bench.device.identity()
        assert who.model
        assert who.address

    def test_a_ping_takes_wall_time(self, bench: Bench[Any]) -> None:
        """Seconds on the wall, not milliseconds."""
        assert 0.0 <= bench.device.ping() < 5.0

    def test_a_stop_at_rest_does_no_harm_twice(self, bench: Bench[Any]) -> None:
        """`stop` is idempotent."""
        bench.device.stop()
        bench.device.stop()

    def test_it_is_closed_once_and_for_all(self, bench: Bench[Any]) -> None:
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
