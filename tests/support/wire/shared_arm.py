"""One arm over its wires for all tests of a file, and the one connection that they share."""

import pytest

from drivers.errors import CellError
from tests.support.wire.arm_bench import ArmBench, dashboard, stand_at_home


class Shared:
    """The one connection that tests share as long as the arm can be moved over it: most leave one behind that can."""

    def __init__(self, connect):
        self._connect = connect
        self._arm = None

    def ready(self):
        """The driver, connected, with a program that moves the arm, which stands where it began."""
        if self._arm is not None:
            try:
                stand_at_home(self._arm)
            except CellError:
                self.close()
        if self._arm is None:
            self._arm = self._connect()
            stand_at_home(self._arm)
        return self._arm

    def close(self):
        """Let others have the arm."""
        if self._arm is not None:
            self._arm.close()
            self._arm = None


def shared_arm(connect, table=None):
    """Fixtures `running`, `shared`, `bench` and `arm` for the tests of a file; `connect` opens a driver at an address.

    `arm` is the driver, connected. `bench` is the arm as after switching on, in use by nobody without `arm`; it stands
    above a table if asked.
    """

    @pytest.fixture(scope="module")
    def running():
        with ArmBench(table=table) as bench:
            yield bench

    @pytest.fixture(scope="module")
    def shared(running):
        shared = Shared(lambda: connect(running.address))
        yield shared
        running.ask("clear")
        shared.close()

    @pytest.fixture
    def bench(request, running, shared):
        running.ask("clear")
        if "arm" not in request.fixturenames:
            shared.close()
            dashboard(running.address, "stop")
        running.ask("reset")
        return running

    @pytest.fixture
    def arm(bench, shared):
        return shared.ready()

    return running, shared, bench, arm
