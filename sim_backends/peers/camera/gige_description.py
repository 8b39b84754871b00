"""How a simulated GigE Vision camera describes itself to a client: GenICam XML, written from tables.

Source: GenICam Standard 2.1 (schema 1.1); Standard Features Naming Convention 2.4 for the features' names and units.
"""

from __future__ import annotations

from sim_backends.models.camera import CameraSpec
from sim_backends.peers.camera.gige_pixels import ENCODERS
from sim_backends.peers.camera.gige_registers import (
    ACQUISITION,
    ACQUISITION_MODE,
    EXPOSURE,
    FRAME_RATE,
    GAIN,
    HEIGHT,
    LEFT,
    LINE,
    PACKET_DELAY,
    PACKET_SIZE,
    PACKET_SIZES,
    PAYLOAD,
    PIXEL_FORMAT,
    SOFTWARE,
    TOP,
    TRIGGER_ACTIVATION,
    TRIGGER_MODE,
    TRIGGER_SOFTWARE,
    TRIGGER_SOURCE,
    WIDTH,
)

_TEXTS = (
    ("DeviceVendorName", 0x48, 32), ("DeviceModelName", 0x68, 32), ("DeviceVersion", 0x88, 32),
    ("DeviceSerialNumber", 0xD8, 16),
)  # fmt: skip
_CHOICES: tuple[tuple[str, int, dict[str, int]], ...] = (
    ("PixelFormat", PIXEL_FORMAT, {name: code for code, (name, _, _) in ENCODERS.items()}),
    ("AcquisitionMode", ACQUISITION_MODE, {"Continuous": 0}),
    ("TriggerMode", TRIGGER_MODE, {"Off": 0, "On": 1}),
    ("TriggerSource", TRIGGER_SOURCE, {"Software": SOFTWARE, "Line1": LINE}),
    ("TriggerActivation", TRIGGER_ACTIVATION, {"RisingEdge": 0, "FallingEdge": 1}),
)
_COMMANDS = (
    ("AcquisitionStart", ACQUISITION, 1), ("AcquisitionStop", ACQUISITION, 0),
    ("TriggerSoftware", TRIGGER_SOFTWARE, 1), ("GevSCPSFireTestPacket", PACKET_SIZE, None),
)  # fmt: skip
_UNITS = {EXPOSURE: ("ExposureTime", "us"), FRAME_RATE: ("AcquisitionFrameRate", "Hz"), GAIN: ("Gain", "dB")}
_FIXED = (
    '<Enumeration Name="TriggerSelector"><EnumEntry Name="FrameStart"><Value>0</Value></EnumEntry><Value>0</Value>'
    '</Enumeration><Integer Name="TLParamsLocked"><Value>0</Value><Min>0</Min><Max>1</Max></Integer>'
)
_HEAD = (
    '<?xml version="1.0" encoding="utf-8"?><RegisterDescription ModelName="SimulatedCamera" '
    'VendorName="simulated" StandardNameSpace="GEV" SchemaMajorVersion="1" SchemaMinorVersion="1" '
    'SchemaSubMinorVersion="0" MajorVersion="1" '
    'MinorVersion="0" SubMinorVersion="0" ProductGuid="0" VersionGuid="0" '
    'xmlns="http://www.genicam.org/GenApi/Version_1_1">'
)


def describe(spec: CameraSpec, reals: dict[int, tuple[float, float]]) -> str:
    """The camera's description, a GenICam XML of schema 1.1; `reals` are least and most of its real registers."""
    words = (
        ("Width", WIDTH, 16, spec.width, 1), ("Height", HEIGHT, 16, spec.height, 1),
        ("OffsetX", LEFT, 0, spec.width, 1), ("OffsetY", TOP, 0, spec.height, 1),
        ("PayloadSize", PAYLOAD, 0, 2**31, 1),
        ("GevSCPSPacketSize", PACKET_SIZE, *PACKET_SIZES, 4), ("GevSCPD", PACKET_DELAY, 0, 2**31, 1),
    )  # fmt: skip
    nodes = [_integer(name, address, (low, high, step)) for name, address, low, high, step in words]
    nodes += [_register("StringReg", name, address, size) for name, address, size in _TEXTS]
    nodes += [_choice(name, address, entries) for name, address, entries in _CHOICES]
    nodes.append(_FIXED)
    nodes += [_command(name, address, value) for name, address, value in _COMMANDS]
    nodes += [_real(name, unit, address, reals[address]) for address, (name, unit) in _UNITS.items()]
    names = "".join(f"<pFeature>{name}</pFeature>" for name in (w[0] for w in (*words, *_TEXTS, *_CHOICES)))
    return f'{_HEAD}<Category Name="Root">{names}</Category>{"".join(nodes)}<Port Name="Device"/></RegisterDescription>'


def _integer(name: str, address: int, limits: tuple[int, int, int]) -> str:
    low, high, step = limits
    mask = "<LSB>31</LSB><MSB>16</MSB>" if name == "GevSCPSPacketSize" else ""
    kind = "MaskedIntReg" if mask else "IntReg"
    return (
        f'<Integer Name="{name}"><pValue>{name}Reg</pValue><Min>{low}</Min><Max>{high}</Max><Inc>{step}</Inc>'
        "</Integer>"
        f"{_register(kind, f'{name}Reg', address, 4, mask)}"
    )


def _choice(name: str, address: int, entries: dict[str, int]) -> str:
    listed = "".join(
        f'<EnumEntry Name="{entry}"><Value>{value}</Value></EnumEntry>' for entry, value in entries.items()
    )
    return (
        f'<Enumeration Name="{name}">{listed}<pValue>{name}Reg</pValue></Enumeration>'
        f"{_register('IntReg', f'{name}Reg', address, 4)}"
    )


def _command(name: str, address: int, value: int | None) -> str:
    """What writes `value`; None for one bit of a register that is for something else."""
    if value is None:
        register = _register("MaskedIntReg", f"{name}Reg", address, 4, "<LSB>0</LSB><MSB>0</MSB>")
    else:
        register = _register("IntReg", f"{name}Reg", address, 4)
    shown = 1 if value is None else value
    return f'<Command Name="{name}"><pValue>{name}Reg</pValue><CommandValue>{shown}</CommandValue></Command>{register}'


def _real(name: str, unit: str, address: int, limits: tuple[float, float]) -> str:
    least, most = limits
    return (
        f'<Float Name="{name}"><pValue>{name}Reg</pValue><Min>{least!r}</Min><Max>{most!r}</Max>'
        f"<Unit>{unit}</Unit></Float>"
        f"{_register('FloatReg', f'{name}Reg', address, 8)}"
    )


def _register(kind: str, name: str, address: int, length: int, more: str = "") -> str:
    sign = "<Sign>Unsigned</Sign>" if kind in ("IntReg", "MaskedIntReg") else ""
    endian = "" if kind == "StringReg" else "<Endianess>BigEndian</Endianess>"
    return (
        f'<{kind} Name="{name}"><Address>0x{address:X}</Address><Length>{length}</Length><AccessMode>RW</AccessMode>'
        f"<pPort>Device</pPort><Cachable>NoCache</Cachable>{more}{sign}{endian}</{kind}>"
    )
