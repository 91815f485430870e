"""The functions of the library Aravis 0.8 that its driver calls, by ctypes."""

from __future__ import annotations

import ctypes
from typing import Any

from aolink.errors import DeviceError

_LIBRARY = "libaravis-0.8.so.0"


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", ctypes.c_int), ("message", ctypes.c_char_p))


class GValue(ctypes.Structure):
    _fields_ = (("type", ctypes.c_size_t), ("data", ctypes.c_uint64 * 2))


_ERROR = ctypes.POINTER(ctypes.POINTER(_GError))
_KINDS = {
    "-": None, "P": ctypes.c_void_p, "S": ctypes.c_char_p, "*": ctypes.POINTER(ctypes.c_char_p), "d": ctypes.c_double,
    "i": ctypes.c_int, "u": ctypes.c_uint32, "q": ctypes.c_int64, "Q": ctypes.c_uint64, "E": _ERROR,
}  # fmt: skip
_DECLARED = """
* PPE     arv_camera_dup_available_pixel_formats_as_strings
-         arv_update_device_list
- P       g_error_free g_free g_object_unref
- PE      arv_camera_clear_triggers arv_camera_software_trigger arv_camera_start_acquisition
          arv_camera_stop_acquisition
- PP      arv_stream_push_buffer
- PPP     arv_buffer_get_image_padding
- PPPE    arv_camera_get_sensor_size
- PPPPPE  arv_camera_get_region
- PSE     arv_camera_execute_command arv_camera_set_pixel_format_from_string arv_camera_set_trigger
          arv_gc_feature_node_set_value_from_string
- PSP     g_object_set_property
- PdE     arv_camera_set_exposure_time arv_camera_set_frame_rate
- Pi      arv_camera_gv_set_stream_options arv_camera_set_access_check_policy arv_camera_set_range_check_policy
          g_value_set_enum g_value_set_int
- PiE     arv_camera_gv_set_packet_size arv_camera_set_acquisition_mode arv_camera_set_chunk_mode
          arv_camera_set_exposure_time_auto arv_camera_set_gain_auto
- PiiiiE  arv_camera_set_region
P P       arv_camera_get_device arv_stream_try_pop_buffer
P PPPE    arv_camera_create_stream
P PQ      g_value_init
P PS      arv_device_get_feature
P QP      arv_buffer_new
P SE      arv_camera_new
Q         arv_gv_stream_packet_resend_get_type
Q P       arv_buffer_get_frame_id arv_buffer_get_system_timestamp arv_buffer_get_timestamp
Q PE      arv_gv_device_get_timestamp_tick_frequency
Q PS      arv_stream_get_info_uint64_by_name
S PE      arv_camera_get_device_serial_number arv_camera_get_model_name arv_camera_get_vendor_name
S PSE     arv_camera_get_string
S u       arv_get_device_address arv_get_device_id arv_get_device_model arv_get_device_protocol
          arv_get_device_serial_nbr arv_get_device_vendor
d PE      arv_camera_get_exposure_time arv_camera_get_frame_rate
i P       arv_buffer_get_image_height arv_buffer_get_image_width arv_buffer_get_status arv_camera_is_gv_device
          arv_gv_device_is_controller
i PE      arv_camera_are_chunks_available arv_camera_get_x_offset_increment arv_camera_get_y_offset_increment
          arv_camera_is_exposure_auto_available arv_camera_is_gain_auto_available
          arv_camera_is_region_offset_available
i PQuE    arv_device_write_register
i PQuPE   arv_device_read_memory
i PSE     arv_camera_is_feature_available
q PSE     arv_camera_get_integer
u         arv_get_n_devices
u P       arv_buffer_get_image_pixel_format
u PE      arv_camera_get_payload arv_camera_gv_get_packet_size
"""
"""The functions with the same result and arguments, a letter of ``_KINDS`` each: the result, then the arguments."""
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
        kinds: list[Any] = []
        for line in _DECLARED.strip("\n").splitlines():
            kinds = [_KINDS[letter] for letter in line[:9].replace(" ", "")] or kinds
            for name in line[9:].split():
                self._functions[name] = function = getattr(library, name)
                function.restype, function.argtypes = kinds[0], kinds[1:]

    def __call__(self, name: str, *arguments: Any) -> Any:
        """Call a function without its last argument where that takes an error."""
        function = self._functions[name]
        if function.argtypes[-1:] != [_ERROR]:
            return function(*arguments)
        error = ctypes.POINTER(_GError)()
        result = function(*arguments, ctypes.byref(error))
        if error:
            message = (error.contents.message or b"no reason given").decode(errors="replace")
            self("g_error_free", error)
            raise Refused(message)
        return result
