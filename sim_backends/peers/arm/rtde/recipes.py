"""Recipes of RTDE: which variables a data packet carries, and how they are packed and unpacked."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

from sim_backends.models.arm import ArmModel
from sim_backends.peers.arm.rtde.registers import Registers, RegisterView
from sim_backends.peers.arm.rtde.variables import FORMATS, INPUTS, Getter

_COMMANDS = frozenset({"input_int_register_0", "input_int_register_24"})
_REGISTER = re.compile(r"input_(int|double|bit)_register_(\d+)")


class InputRecipe:
    """The variables that one kind of data packet carries, in order."""

    def __init__(self, names: list[str], model: ArmModel, registers: Registers) -> None:
        """`names` are keys of `INPUTS`."""
        self._model = model
        self._registers = registers
        self._names = frozenset(names)
        self._unpacker = struct.Struct(">" + "".join(FORMATS[INPUTS[name]] for name in names))
        self._slots: list[tuple[list[int] | list[float] | list[bool], int]] = []
        self._others: list[tuple[str, int]] = []
        self._force = place = 0
        for name in names:
            match = _REGISTER.fullmatch(name)
            if match is None:
                self._others.append((name, place))
                if name == "external_force_torque":
                    self._force = place
                self._slots += [([0.0], 0)] * (6 if INPUTS[name] == "VECTOR6D" else 1)
            elif match[1] == "int":
                self._slots.append((registers.int_in, int(match[2])))
            elif match[1] == "bit":
                self._slots.append((registers.bits_in, int(match[2])))
            else:
                self._slots.append((registers.double_in, int(match[2])))
            place = len(self._slots)

    def apply(self, payload: bytes) -> None:
        """Write one packet's values; real clients send packets too long or too short, which are cut or padded."""
        size = self._unpacker.size
        numbers = self._unpacker.unpack(payload if len(payload) == size else payload[:size].ljust(size, b"\0"))
        for (bank, index), number in zip(self._slots, numbers, strict=True):
            bank[index] = number
        if self._names & _COMMANDS:
            self._registers.commands += 1
            self._registers.command_fields = self._names
        for name in self._registers.written.keys() & self._names:
            self._registers.written[name] += 1
        if "external_force_torque" in self._names:
            self._registers.external_force = list(numbers[self._force : self._force + 6])
        if self._others:
            self._write_outputs({name: numbers[place] for name, place in self._others})

    def _write_outputs(self, values: dict[str, float]) -> None:
        """Masked outputs change only where their mask says so."""
        for kind, first, bits in (("standard", 0, 255), ("configurable", 8, 255), ("tool", 16, 3)):
            mask = int(values.get(f"{kind}_digital_output_mask", 0)) & bits
            levels = int(values.get(f"{kind}_digital_output", 0))
            if mask:
                self._model.write_digital_outputs(mask << first, levels << first)
        if int(values.get("speed_slider_mask", 0)) & 1:
            self._model.drive.speed_fraction = min(1.0, max(0.0, values.get("speed_slider_fraction", 1.0)))
        for first in (0, 32):
            if (name := f"input_bit_registers{first}_to_{first + 31}") in values:
                bits = int(values[name])
                self._registers.bits_in[first : first + 32] = [bool(bits >> bit & 1) for bit in range(32)]
        mask = int(values.get("standard_analog_output_mask", 0))
        for i in (0, 1):
            if mask >> i & 1:
                self._registers.analog_out[i] = values.get(f"standard_analog_output_{i}", 0.0)


@dataclass(frozen=True)
class OutputRecipe:
    """The variables that are sent in every `every`-th tick under recipe `number`, 0 for protocol 1, which has none."""

    number: int
    every: int
    packer: struct.Struct
    getters: tuple[Getter, ...]

    def packet(self, view: RegisterView) -> bytes:
        """One data packet."""
        values: list[float] = []
        for getter in self.getters:
            values += getter(view)
        head = (self.number,) if self.number else ()
        return self.packer.pack(self.packer.size, ord("U"), *head, *values)
