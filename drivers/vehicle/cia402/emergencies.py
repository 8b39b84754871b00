"""What a drive's emergency code means, in words with a remedy.

Source: the error code ranges of CiA 301 and the codes that CiA 402 adds. A code that is not here is told by its range.
"""

from __future__ import annotations

_CODES = {
    0x2310: ("the motor took too much current for too long", "see what the wheel runs against"),
    0x2320: ("short circuit or earth fault at the motor", "switch off and measure the motor's cable"),
    0x2330: ("earth fault at the motor", "switch off and measure the motor's cable"),
    0x3110: ("supply voltage too high", "check battery and charger"),
    0x3120: ("supply voltage too low", "charge the battery, check its fuse and the emergency stop's contactor"),
    0x3210: ("DC link voltage too high", "lower vehicle.deceleration, or fit a brake resistor"),
    0x3220: ("DC link voltage too low", "charge the battery, check its fuse and the emergency stop's contactor"),
    0x4210: ("the drive is too hot", "let the vehicle stand and see that the drive is cooled"),
    0x4310: ("the drive is too hot", "let the vehicle stand and see that the drive is cooled"),
    0x4410: ("the motor is too hot", "let the vehicle stand and see whether a brake drags"),
    0x5441: ("a safe stop contact is open", "release the emergency stop"),
    0x5442: ("a safe stop contact is open", "release the emergency stop"),
    0x6320: ("a parameter of the drive does not fit", "compare the drive's set-up with its maker's tool"),
    0x7121: ("the motor is blocked", "see what the wheel runs against and whether its brake opens"),
    0x7122: ("the motor's commutation fails", "check motor and encoder cables"),
    0x7305: ("the encoder fails", "check the encoder's cable"),
    0x7306: ("the second encoder fails", "check the encoder's cable"),
    0x8110: ("the drive lost CAN messages", "check the bus and its load"),
    0x8120: ("the drive's CAN controller is error passive", "measure 60 ohm between CAN high and low"),
    0x8130: ("our heartbeat stayed away", "see what keeps this computer busy, or raise vehicle.watchdog"),
    0x8140: ("the drive was off the CAN bus", "measure 60 ohm between CAN high and low"),
    0x8210: ("a PDO of another length came", "see whether another master commands the drive"),
    0x8220: ("a PDO of another length came", "see whether another master commands the drive"),
    0x8311: ("more torque than allowed was asked", "see what the wheel runs against"),
    0x8400: ("the velocity is not kept", "see what the wheel runs against and whether its brake opens"),
    0x8480: ("the wheel runs too fast", "compare velocity_unit, gear and counts_per_turn with the drive"),
    0x8611: ("following error", "see what the wheel runs against and whether its brake opens"),
}
_RANGES = (
    (0xFF00, 0x1000, "a fault without further words"),
    (0xF000, 0x2000, "current"),
    (0xF000, 0x3000, "voltage"),
    (0xF000, 0x4000, "temperature"),
    (0xF000, 0x5000, "the drive's hardware"),
    (0xF000, 0x6000, "the drive's software or parameters"),
    (0xF000, 0x7000, "a module of the drive, such as motor or encoder"),
    (0xFF00, 0x8100, "communication"),
    (0xF000, 0x8000, "monitoring"),
    (0xF000, 0x9000, "something outside of the drive"),
    (0xFF00, 0xFF00, "a fault of its maker's own"),
)


def meaning(code: int) -> str:
    """What the emergency `code` says and what to do."""
    if code in _CODES:
        words, remedy = _CODES[code]
        return f"{words}, {code:04X}h: {remedy}"
    words = next((words for mask, bits, words in _RANGES if code & mask == bits), "a code that no profile has")
    return f"{words}, {code:04X}h: see the drive's manual"
