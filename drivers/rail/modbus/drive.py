"""A Modbus drive by its register map: positions in m, flags, settings that are read back, faults in words."""

from __future__ import annotations

from drivers.errors import DeviceFault, LimitError
from drivers.rail.modbus.link import Flag, ModbusLink, Number, Rate, RegisterMap


class ModbusDrive:
    """The drive at the other end of `link`; `lead` in m per turn, `counts_per_turn` as its position register counts."""

    def __init__(self, link: ModbusLink, registers: RegisterMap, *, lead: float, counts_per_turn: int) -> None:
        self.link = link
        self.registers = registers
        self.name = link.name
        self.counts = counts_per_turn / lead
        self._lead = lead
        self._turn = counts_per_turn

    def position(self) -> tuple[float, float, float]:
        """Host time in s, position in m, round trip in s of one reading."""
        number = self.registers.position
        words, stamp, round_trip = self.link.read_stamped(number.address, number.words, input=number.input)
        return stamp, number.decode(words) / self.counts, round_trip

    def says(self, flag: Flag | None) -> bool:
        """What a flag says now; no for one that the drive does not have."""
        return flag is not None and flag.decode(self.link.read(flag.address, 1, input=flag.input)[0])

    def read(self, number: Number, *, signed: bool = True) -> int:
        """Read a number."""
        return number.decode(self.link.read(number.address, number.words, input=number.input), signed=signed)

    def set(self, number: Number, value: int, issued: int | None = None) -> None:
        """Write a number and read it back; `DeviceFault` (rail.setting) when the drive has another."""
        try:
            words = number.encode(value)
        except ValueError as error:
            raise LimitError(
                self.name,
                f"{error} at register {number.address:#06x}; nothing was sent. Choose a smaller way, speed or "
                "acceleration",
            ) from error
        self.link.write(number.address, words, issued=issued)
        found = self.link.read(number.address, number.words)
        if found != words:
            raise self.fault(
                "rail.setting",
                f"the drive keeps {number.decode(found)} in register {number.address:#06x} instead of {value}",
                "See whether another program sets the drive up, and whether the value is in its range (rail.registers, "
                "rail.acceleration, rail.max_speed).",
                recoverable=False,
            )

    def set_rate(self, rate: Rate, value: float, issued: int | None = None) -> None:
        """Write a speed (m/s) or an acceleration (m/s²)."""
        self.set(rate.number, rate.encode(value / self._lead, self._turn), issued)

    def kept(self, rate: Rate, value: float) -> float:
        """What a speed (m/s) or an acceleration (m/s²) would become in the drive's unit."""
        return self._lead * rate.decode(rate.encode(value / self._lead, self._turn), self._turn)

    def least(self, rate: Rate) -> float:
        """What one of the drive's units is, in m/s or m/s²."""
        return self._lead * rate.decode(1, self._turn)

    @property
    def alarm(self) -> str:
        """The alarm's number, as manuals have it."""
        number = self.registers.alarm
        return "of unknown number" if number is None else f"{self.read(number) & 0xFFFF:#06x}"

    def alarmed(self, when: str) -> DeviceFault:
        """The fault of a drive that reports one."""
        return self.fault(
            "rail.alarm",
            f"the drive reports a fault {when}, alarm {self.alarm}",
            "Look the alarm up in the drive's manual, clear its cause and the alarm there, then home the rail.",
        )

    def fault(self, code: str, message: str, hint: str, *, recoverable: bool = True) -> DeviceFault:
        """A fault in the drive's name."""
        return DeviceFault(self.name, code, message, recoverable=recoverable, hint=hint)
