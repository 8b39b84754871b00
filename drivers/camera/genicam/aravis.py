"""The functions of Aravis that the driver needs, called through ctypes: its shared library is all that must be there.

Aravis (LGPL) speaks GigE Vision and USB3 Vision and reads the camera's own description (GenICam). Nothing here looks
for cameras: a device is made for one address or one serial number, and no broadcast is ever sent.
"""

import ctypes
import socket
from collections.abc import Callable
from ctypes import c_char_p, c_double, c_int, c_int64, c_size_t, c_uint, c_uint32, c_uint64, c_void_p
from enum import IntEnum
from functools import cache
from typing import Any

LIBRARIES = ("libaravis-0.8.so.0", "libaravis-0.10.so.0", "libaravis-0.8.dylib", "libaravis-0.10.dylib")
REMEDY = "install the library Aravis: apt-get install libaravis-0.8-0 (Debian, Ubuntu), brew install aravis (macOS)"

CONTROL_PRIVILEGE = 0x0A00
"""Bootstrap register: who controls the camera. 0 nobody; GigE Vision 2.0, table 27-1."""
PRIMARY_APPLICATION_ADDRESS = 0x0A14
"""Bootstrap register: IPv4 address of the application that controls the camera; GigE Vision 1.1 and later."""

Handle = int
_POINTER, _TEXT, _NOTHING = c_void_p, c_char_p, None
_OUT_INT = ctypes.POINTER(c_int)
_OUT_INT64 = ctypes.POINTER(c_int64)
_OUT_DOUBLE = ctypes.POINTER(c_double)
_OUT_UINT64 = ctypes.POINTER(c_uint64)
_OUT_SIZE = ctypes.POINTER(c_size_t)

_MAY_FAIL: dict[str, tuple[object, ...]] = {
    "arv_gv_device_new": (_POINTER, _POINTER, _POINTER),
    "arv_gv_device_leave_control": (c_int, _POINTER),
    "arv_gv_device_get_timestamp_tick_frequency": (c_uint64, _POINTER),
    "arv_uv_device_new_from_guid": (_POINTER, _TEXT),
    "arv_camera_new_with_device": (_POINTER, _POINTER),
    "arv_camera_create_stream": (_POINTER, _POINTER, _POINTER, _POINTER),
    "arv_camera_get_vendor_name": (_TEXT, _POINTER),
    "arv_camera_get_model_name": (_TEXT, _POINTER),
    "arv_camera_get_device_serial_number": (_TEXT, _POINTER),
    "arv_camera_is_feature_available": (c_int, _POINTER, _TEXT),
    "arv_camera_get_string": (_TEXT, _POINTER, _TEXT),
    "arv_camera_set_string": (_NOTHING, _POINTER, _TEXT, _TEXT),
    "arv_camera_get_integer": (c_int64, _POINTER, _TEXT),
    "arv_camera_set_integer": (_NOTHING, _POINTER, _TEXT, c_int64),
    "arv_camera_get_integer_bounds": (_NOTHING, _POINTER, _TEXT, _OUT_INT64, _OUT_INT64),
    "arv_camera_get_integer_increment": (c_int64, _POINTER, _TEXT),
    "arv_camera_execute_command": (_NOTHING, _POINTER, _TEXT),
    "arv_camera_is_exposure_auto_available": (c_int, _POINTER),
    "arv_camera_set_exposure_time_auto": (_NOTHING, _POINTER, c_int),
    "arv_camera_set_exposure_time": (_NOTHING, _POINTER, c_double),
    "arv_camera_get_exposure_time": (c_double, _POINTER),
    "arv_camera_get_exposure_time_bounds": (_NOTHING, _POINTER, _OUT_DOUBLE, _OUT_DOUBLE),
    "arv_camera_is_gain_available": (c_int, _POINTER),
    "arv_camera_is_gain_auto_available": (c_int, _POINTER),
    "arv_camera_set_gain_auto": (_NOTHING, _POINTER, c_int),
    "arv_camera_set_gain": (_NOTHING, _POINTER, c_double),
    "arv_camera_get_gain": (c_double, _POINTER),
    "arv_camera_get_gain_bounds": (_NOTHING, _POINTER, _OUT_DOUBLE, _OUT_DOUBLE),
    "arv_camera_is_frame_rate_available": (c_int, _POINTER),
    "arv_camera_set_frame_rate": (_NOTHING, _POINTER, c_double),
    "arv_camera_get_frame_rate": (c_double, _POINTER),
    "arv_camera_get_frame_rate_bounds": (_NOTHING, _POINTER, _OUT_DOUBLE, _OUT_DOUBLE),
    "arv_camera_set_acquisition_mode": (_NOTHING, _POINTER, c_int),
    "arv_camera_clear_triggers": (_NOTHING, _POINTER),
    "arv_camera_set_trigger": (_NOTHING, _POINTER, _TEXT),
    "arv_camera_is_software_trigger_supported": (c_int, _POINTER),
    "arv_camera_software_trigger": (_NOTHING, _POINTER),
    "arv_camera_get_payload": (c_uint, _POINTER),
    "arv_camera_start_acquisition": (_NOTHING, _POINTER),
    "arv_camera_stop_acquisition": (_NOTHING, _POINTER),
    "arv_camera_gv_set_packet_size": (_NOTHING, _POINTER, c_int),
    "arv_camera_gv_get_packet_size": (c_uint, _POINTER),
    "arv_camera_gv_auto_packet_size": (c_uint, _POINTER),
    "arv_camera_gv_set_packet_delay": (_NOTHING, _POINTER, c_int64),
    "arv_device_read_register": (c_int, _POINTER, c_uint64, ctypes.POINTER(c_uint32)),
    "arv_device_write_register": (c_int, _POINTER, c_uint64, c_uint32),
}
"""Functions whose last argument is the error: result, then arguments without it."""

_CANNOT_FAIL: dict[str, tuple[object, ...]] = {
    "arv_camera_gv_set_packet_size_adjustment": (_NOTHING, _POINTER, c_int),
    "arv_camera_gv_set_stream_options": (_NOTHING, _POINTER, c_int),
    "arv_gv_device_is_controller": (c_int, _POINTER),
    "arv_stream_push_buffer": (_NOTHING, _POINTER, _POINTER),
    "arv_stream_timeout_pop_buffer": (_POINTER, _POINTER, c_uint64),
    "arv_stream_get_n_infos": (c_uint, _POINTER),
    "arv_stream_get_info_name": (_TEXT, _POINTER, c_uint),
    "arv_stream_get_info_uint64": (c_uint64, _POINTER, c_uint),
    "arv_buffer_new_allocate": (_POINTER, c_size_t),
    "arv_buffer_get_status": (c_int, _POINTER),
    "arv_buffer_get_payload_type": (c_int, _POINTER),
    "arv_buffer_get_timestamp": (c_uint64, _POINTER),
    "arv_buffer_get_frame_id": (c_uint64, _POINTER),
    "arv_buffer_get_data": (_POINTER, _POINTER, _OUT_SIZE),
    "arv_buffer_get_image_pixel_format": (c_uint32, _POINTER),
    "arv_buffer_get_image_region": (_NOTHING, _POINTER, _OUT_INT, _OUT_INT, _OUT_INT, _OUT_INT),
    "arv_buffer_get_image_padding": (_NOTHING, _POINTER, _OUT_INT, _OUT_INT),
    "arv_gv_stream_packet_resend_get_type": (c_size_t,),
    "arv_gv_stream_socket_buffer_get_type": (c_size_t,),
    "g_object_unref": (_NOTHING, _POINTER),
    "g_error_free": (_NOTHING, _POINTER),
    "g_inet_address_new_from_string": (_POINTER, _TEXT),
    "g_value_init": (_POINTER, _POINTER, c_size_t),
    "g_value_set_enum": (_NOTHING, _POINTER, c_int),
    "g_value_set_uint": (_NOTHING, _POINTER, c_uint),
    "g_value_set_int": (_NOTHING, _POINTER, c_int),
    "g_value_set_double": (_NOTHING, _POINTER, c_double),
    "g_object_set_property": (_NOTHING, _POINTER, _TEXT, _POINTER),
}

_BASIC = {"int": 6 << 2, "uint": 7 << 2, "double": 15 << 2}
"""GObject's numbers of its basic types."""


class BufferStatus(IntEnum):
    """How a buffer came back: `ArvBufferStatus`."""

    UNKNOWN = -1
    SUCCESS = 0
    CLEARED = 1
    TIMEOUT = 2
    MISSING_PACKETS = 3
    WRONG_PACKET_ID = 4
    SIZE_MISMATCH = 5
    FILLING = 6
    ABORTED = 7


class AravisMissing(Exception):
    """The library is not on this computer; the text says what to install."""


class AravisError(Exception):
    """The library reports an error; the text is its own, `code` its number (`ArvDeviceError`)."""

    SILENT = (2, 4, 5, 10)
    """Not connected, transfer failed, no answer in time, control lost."""
    ACCESS_DENIED = 17

    def __init__(self, function: str, code: int, text: str) -> None:
        super().__init__(text)
        self.function = function
        self.code = code


class _GError(ctypes.Structure):
    _fields_ = (("domain", c_uint32), ("code", c_int), ("message", c_char_p))


class GValue(ctypes.Structure):
    """A value with its type, as GObject passes properties."""

    _fields_ = (("type", c_size_t), ("data", c_uint64 * 2))


class Aravis:
    """The loaded library: `call` and `plain` by the C function's name, with the arguments in its order."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._may_fail: dict[str, Callable[..., object]] = {}
        self._cannot_fail: dict[str, Callable[..., object]] = {}
        for name, (result, *arguments) in _MAY_FAIL.items():
            function = getattr(library, name)
            function.restype = result
            function.argtypes = [*arguments, ctypes.POINTER(ctypes.POINTER(_GError))]
            self._may_fail[name] = function
        for name, (result, *arguments) in _CANNOT_FAIL.items():
            function = getattr(library, name)
            function.restype = result
            function.argtypes = arguments
            self._cannot_fail[name] = function

    def call(self, name: str, *arguments: object) -> Any:
        """Call a function that may fail; raises `AravisError`."""
        error = ctypes.POINTER(_GError)()
        result = self._may_fail[name](*arguments, ctypes.byref(error))
        if error:
            text = (error.contents.message or b"").decode(errors="replace").strip()
            code = int(error.contents.code)
            self.plain("g_error_free", error)
            raise AravisError(name, code, text or f"error {code}")
        return result

    def plain(self, name: str, *arguments: object) -> Any:
        """Call a function that does not report errors."""
        return self._cannot_fail[name](*arguments)

    def set_property(self, thing: Handle, name: str, kind: str, value: float) -> None:
        """Set a property of an object; `kind` is "int", "uint", "double" or the name of an enumeration of Aravis."""
        number = _BASIC[kind] if kind in _BASIC else self.plain(f"arv_{kind}_get_type")
        packed = GValue()
        self.plain("g_value_init", ctypes.byref(packed), number)
        self.plain(f"g_value_set_{kind if kind in _BASIC else 'enum'}", ctypes.byref(packed), value)
        self.plain("g_object_set_property", thing, name.encode(), ctypes.byref(packed))

    def open_gige(self, host: str) -> Handle:
        """The device at the IPv4 address `host`; only that address is spoken to."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as route:
            # Connecting a datagram socket sends nothing; it tells which of this computer's addresses leads there.
            route.connect((host, 3956))
            own, _ = route.getsockname()
        ends = [self.plain("g_inet_address_new_from_string", end.encode()) for end in (own, host)]
        try:
            device: Handle = self.call("arv_gv_device_new", *ends)
            return device
        finally:
            for end in ends:
                self.plain("g_object_unref", end)


@cache
def load() -> Aravis:
    """The library, loaded once; raises `AravisMissing`."""
    reasons = []
    for name in LIBRARIES:
        try:
            return Aravis(ctypes.CDLL(name))
        except (OSError, AttributeError) as error:
            reasons.append(str(error))
    raise AravisMissing(f"{REMEDY} ({reasons[0]})")
