"""A camera beside the gate: it moves nothing, and nothing holds its commands back; who listens there is told them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from cell.devices.gate.gate import Gate, Gated
from cell.devices.gate.interlocks import DeviceCommand
from drivers.interfaces import Camera, Frame, FrameStream


class GatedCamera(Gated[Camera]):
    """A camera whose commands are told at the gate."""

    def __init__(self, bare: Camera, gate: Gate) -> None:
        super().__init__(bare, gate)
        self.shape = bare.shape

    @property
    def time_bound(self) -> float:
        """See `Camera.time_bound`."""
        return self.bare.time_bound

    def configure(self, exposure: float, frame_rate: float) -> None:
        """See `Camera.configure`."""
        self.gate.asked(DeviceCommand(self.name, "configure", {"exposure": exposure, "frame_rate": frame_rate}))
        self.bare.configure(exposure, frame_rate)

    def grab(self, timeout: float = 2.0) -> Frame:
        """See `Camera.grab`."""
        self.gate.asked(DeviceCommand(self.name, "grab"))
        return self.bare.grab(timeout)

    @contextmanager
    def stream(self) -> Iterator[FrameStream]:
        """See `Camera.stream`."""
        self.gate.asked(DeviceCommand(self.name, "stream"))
        try:
            with self.bare.stream() as frames:
                yield frames
        finally:
            self.gate.asked(DeviceCommand(self.name, "stream ended"))
