"""Child side: the state packets of the arm, one every 2 ms, as `Snapshot`s."""

from __future__ import annotations

import time

from rtde_receive import RTDEReceiveInterface

from drivers.arm.messages import Snapshot
from drivers.arm.rtde_link import VARIABLES


class Packets:
    """What the arm at `address` sends of itself; RuntimeError when it does not answer."""

    def __init__(self, address: str) -> None:
        self._receive = RTDEReceiveInterface(address, 500.0, list(VARIABLES))
        self._newest = 0.0

    @property
    def connected(self) -> bool:
        """Whether the arm keeps the connection."""
        return bool(self._receive.isConnected())

    @property
    def news(self) -> bool:
        """Whether a packet has come since the one that was read last."""
        return bool(self._receive.getTimestamp() != self._newest)

    def read(self) -> Snapshot:
        """The newest packet, read whole: again if another one has come in between."""
        receive = self._receive
        while True:
            self._newest = receive.getTimestamp()
            snapshot = Snapshot(
                stamp=time.monotonic(),
                joints=tuple(receive.getActualQ()),
                speeds=tuple(receive.getActualQd()),
                flange=tuple(receive.getActualTCPPose()),
                wrench=tuple(receive.getActualTCPForce()),
                safety_bits=receive.getSafetyStatusBits(),
                mode=receive.getRobotMode(),
                runtime=receive.getRuntimeState(),
                inputs=receive.getActualDigitalInputBits(),
                outputs=receive.getActualDigitalOutputBits(),
                device_time=self._newest,
                payload=(receive.getPayload(), tuple(receive.getPayloadCog())),
            )
            if receive.getTimestamp() == self._newest:
                return snapshot
