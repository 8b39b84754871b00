"""Motions of the arm in this process: servo lag, arrival and contact as a driver that streams sees them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from drivers.errors import CellError, DeadlineError
from drivers.interfaces import Vector
from sim_backends.models.arm import Safety
from sim_backends.models.arm_motion import SimulatedMotion, StopMotion
from sim_backends.models.arm_streams import Servo

if TYPE_CHECKING:
    from sim_backends.direct.arm import DirectArm

TICK_S, GUARDED_TICK_S, STILL_TICK_S = 0.02, 0.004, 0.05
AT_REST = 0.003
"""An arm whose joints all turn slower than this, rad/s, stands."""
_SERVO_LAG_S = 0.03
"""Of a look-ahead of 0.05 s and a gain of 500."""
_SERVO_BRAKING = 10.0
_ARRIVED = 2e-3
_PATIENCE_S = 3.0


class ArmMove:
    """A motion that the controller ends by itself; `motion` is the model's."""

    tick_s = TICK_S

    def __init__(self, arm: DirectArm, motion: SimulatedMotion) -> None:
        self.contact = False
        self.motion = motion
        self._arm = arm
        self._error: CellError | None = None
        self._done = False

    @property
    def done(self) -> bool:
        """True once the motion has ended, however it ended."""
        return self._done

    def wait(self, timeout: float) -> None:
        """Let time pass until the motion has ended; see `drivers.interfaces.Motion`."""
        clock = self._arm.clock
        deadline = clock.now() + timeout
        while not self._done:
            if clock.now() > deadline:
                self._arm.stop()
                self._error = DeadlineError(
                    self._arm.name,
                    f"the motion did not end within {timeout:.3g} s and was stopped. See what hinders it",
                )
                break
            clock.sleep(self.tick_s)
        if self._error is not None:
            raise self._error

    def fail(self, error: CellError) -> None:
        """End it with an error."""
        self._error, self._done = error, True

    def before_tick(self, t: float) -> None:
        """The model goes on by itself."""

    def after_tick(self, t: float) -> None:
        """Ended, once the model is idle and the joints stand."""
        model = self._arm.model
        if (found := self._arm.trouble()) is not None:
            self.fail(found)
        elif model.idle and not model.moving:
            self._done = True
            self._arm.rests.append(model.drive.q.copy())


class Streamed(ArmMove):
    """A joint trajectory that is streamed into a servo, with a force limit or without."""

    def __init__(
        self, arm: DirectArm, times: Vector, joints: Vector, force_limit: float | None, force_before: Vector
    ) -> None:
        self._servo = Servo(joints[0], _SERVO_LAG_S)
        super().__init__(arm, self._servo)
        self._times, self._joints = times, joints
        self._force_limit, self._force_before = force_limit, force_before
        self._begun = arm.clock.now()
        self._ending = False
        self.tick_s = TICK_S if force_limit is None else GUARDED_TICK_S

    def before_tick(self, t: float) -> None:
        """Stream where the trajectory is at `t`."""
        if not self._ending:
            elapsed = t - self._begun
            after = min(int(np.searchsorted(self._times, elapsed, side="right")), len(self._times) - 1)
            begin, end = self._times[after - 1], self._times[after]
            part = min(1.0, (elapsed - begin) / (end - begin))
            self._servo.target = self._joints[after - 1] + part * (self._joints[after] - self._joints[after - 1])

    def after_tick(self, t: float) -> None:
        """Contact, arrival, or the end of the patience with it."""
        model = self._arm.model
        if self._ending or model.safety is not Safety.NORMAL:
            super().after_tick(t)
            return
        late = t - self._begun - self._times[-1]
        if self._force_limit is not None:
            change = model.felt[:3] - self._force_before
            self.contact = bool(np.linalg.norm(change) > self._force_limit)
        off = float(np.abs(model.drive.q - self._joints[-1]).max())
        arrived = late >= 0 and off < _ARRIVED and float(np.abs(model.drive.qd).max()) < AT_REST
        if late > _PATIENCE_S:
            self.fail(self._arm.fault("arm.not_arrived", f"a joint is {off:.4f} rad off"))
        elif arrived or self.contact:
            self._ending = True
            model.start(StopMotion(_SERVO_BRAKING, linear=True))
