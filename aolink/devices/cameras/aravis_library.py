"""The functions of the library Aravis 0.8 that its driver calls, by ctypes."""

from __future__ import annotations

import ctypes
from typing import Any

from aolink.errors import DeviceError

_LIBRARY = "libaravis-0.8.so.0"

_P, _S, _I, _U, _D = ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_uint, ctypes.c_double
_U64, _SIZE = ctypes.c_uint64, ctypes.c_size_t


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", _I), ("message", _S))


class GValue(ctypes.Structure):
    _fields_ = (("type", _SIZE), ("data", _U64 * 2))


_ERROR = ctypes.POINTER(ctypes.POINTER(_GError))
_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_buffer_get_frame_id": (_U64, (_P,)),
    "arv_buffer_get_image_height": (_I, (_P,)),
    "arv_buffer_get_image_padding": (None, (_P, _P, _P)),
    "arv_buffer_get_image_pixel_format": (ctypes.c_uint32, (_P,)),
    "arv_buffer_get_image_width": (_I, (_P,)),
    "arv_buffer_get_status": (_I, (_P,)),
    "arv_buffer_get_system_timestamp": (_U64, (_P,)),
    "arv_buffer_get_timestamp": (_U64, (_P,)),
    "arv_buffer_new": (_P, (_SIZE, _P)),
    "arv_camera_are_chunks_available": (_I, (_P, _ERROR)),
    "arv_camera_clear_triggers": (None, (_P, _ERROR)),
    "arv_camera_create_stream": (_P, (_P, _P, _P, _ERROR)),
    "arv_camera_dup_available_pixel_formats_as_strings": (ctypes.POINTER(_S), (_P, _P, _ERROR)),
    "arv_camera_execute_command": (None, (_P, _S, _ERROR)),
    "arv_camera_get_device": (_P, (_P,)),
    "arv_camera_get_device_serial_number": (_S, (_P, _ERROR)),
    "arv_camera_get_exposure_time": (_D, (_P, _ERROR)),
    "arv_camera_get_frame_rate": (_D, (_P, _ERROR)),
    "arv_camera_get_integer": (ctypes.c_int64, (_P, _S, _ERROR)),
    "arv_camera_get_model_name": (_S, (_P, _ERROR)),
    "arv_camera_get_payload": (_U, (_P, _ERROR)),
    "arv_camera_get_region": (None, (_P, _P, _P, _P, _P, _ERROR)),
    "arv_camera_get_sensor_size": (None, (_P, _P, _P, _ERROR)),
    "arv_camera_get_string": (_S, (_P, _S, _ERROR)),
    "arv_camera_get_vendor_name": (_S, (_P, _ERROR)),
    "arv_camera_get_x_offset_increment": (_I, (_P, _ERROR)),
    "arv_camera_get_y_offset_increment": (_I, (_P, _ERROR)),
    "arv_camera_gv_get_packet_size": (_U, (_P, _ERROR)),
    "arv_camera_gv_set_packet_size": (None, (_P, _I, _ERROR)),
    "arv_camera_gv_set_stream_options": (None, (_P, _I)),
    "arv_camera_is_exposure_auto_available": (_I, (_P, _ERROR)),
    "arv_camera_is_feature_available": (_I, (_P, _S, _ERROR)),
    "arv_camera_is_gain_auto_available": (_I, (_P, _ERROR)),
    "arv_camera_is_gv_device": (_I, (_P,)),
    "arv_camera_is_region_offset_available": (_I, (_P, _ERROR)),
    "arv_camera_new": (_P, (_S, _ERROR)),
    "arv_camera_set_access_check_policy": (None, (_P, _I)),
    "arv_camera_set_acquisition_mode": (None, (_P, _I, _ERROR)),
    "arv_camera_set_chunk_mode": (None, (_P, _I, _ERROR)),
    "arv_camera_set_exposure_time": (None, (_P, _D, _ERROR)),
    "arv_camera_set_exposure_time_auto": (None, (_P, _I, _ERROR)),
    "arv_camera_set_frame_rate": (None, (_P, _D, _ERROR)),
    "arv_camera_set_gain_auto": (None, (_P, _I, _ERROR)),
    "arv_camera_set_pixel_format_from_string": (None, (_P, _S, _ERROR)),
    "arv_camera_set_range_check_policy": (None, (_P, _I)),
    "arv_camera_set_region": (None, (_P, _I, _I, _I, _I, _ERROR)),
    "arv_camera_set_trigger": (None, (_P, _S, _ERROR)),
    "arv_camera_start_acquisition": (None, (_P, _ERROR)),
    "arv_camera_stop_acquisition": (None, (_P, _ERROR)),
    "arv_device_get_feature": (_P, (_P, _S)),
    "arv_device_read_memory": (_I, (_P, _U64, ctypes.c_uint32, _P, _ERROR)),
    "arv_device_write_register": (_I, (_P, _U64, ctypes.c_uint32, _ERROR)),
    "arv_gc_feature_node_set_value_from_string": (None, (_P, _S, _ERROR)),
    "arv_get_device_address": (_S, (_U,)),
    "arv_get_device_id": (_S, (_U,)),
    "arv_get_device_model": (_S, (_U,)),
    "arv_get_device_protocol": (_S, (_U,)),
    "arv_get_device_serial_nbr": (_S, (_U,)),
    "arv_get_device_vendor": (_S, (_U,)),
    "arv_get_n_devices": (_U, ()),
    "arv_gv_device_get_timestamp_tick_frequency": (_U64, (_P, _ERROR)),
    "arv_gv_device_is_controller": (_I, (_P,)),
    "arv_gv_stream_packet_resend_get_type": (_SIZE, ()),
    "arv_stream_get_info_uint64_by_name": (_U64, (_P, _S)),
    "arv_stream_push_buffer": (None, (_P, _P)),
    "arv_stream_try_pop_buffer": (_P, (_P,)),
    "arv_update_device_list": (None, ()),
    "g_error_free": (None, (_P,)),
    "g_free": (None, (_P,)),
    "g_object_set_property": (None, (_P, _S, _P)),
    "g_object_unref": (None, (_P,)),
    "g_value_init": (_P, (_P, _SIZE)),
    "g_value_set_enum": (None, (_P, _I)),
    "g_value_set_int": (None, (_P, _I)),
}  # fmt: skip
G_TYPE_INT = 6 << 2


class Refused(Exception):
    """An error that Aravis reports."""


class Aravis:
    """The library's functions, by their names; an error that one reports is raised as `Refused`."""

    def __init__(self) -> None:
        try:
            library = ctypes.CDLL(_LIBRARY)
        except OSError as error:
            raise DeviceError(
                f"the library Aravis 0.8 is missing ({error}): install it (Debian: apt install libaravis-0.8-0)"
            ) from None
        self._functions = {}
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
            self._functions[name] = function

    def __call__(self, name: str, *arguments: Any) -> Any:
        """Call a function without its last argument where that takes an error."""
        if _SIGNATURES[name][1][-1:] != (_ERROR,):
            return self._functions[name](*arguments)
        error = ctypes.POINTER(_GError)()
        result = self._functions[name](*arguments, ctypes.byref(error))
        if error:
            message = (error.contents.message or b"no reason given").decode(errors="replace")
            self("g_error_free", error)
            raise Refused(message)
        return result
