"""The check whether this machine has a Vulkan device, graphics card or software, that a viewer could draw with.

It is run as a program of its own, because a broken driver may crash the process that loads it.
"""

from __future__ import annotations

import ctypes
import subprocess
import sys

_INSTANCE_CREATE_INFO = 1
"""The value of VK_STRUCTURE_TYPE_INSTANCE_CREATE_INFO."""
_TIMEOUT_S = 20.0


def has_vulkan() -> bool:
    """Ask the Vulkan loader, in a process of its own. False where there is no loader, no driver or no device."""
    try:
        return subprocess.run([sys.executable, "-I", __file__], timeout=_TIMEOUT_S, capture_output=True).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def _devices() -> int:
    """The number of devices that the Vulkan loader knows. Raises OSError where there is no loader."""
    vulkan = ctypes.CDLL("libvulkan.so.1")
    # VkInstanceCreateInfo has 64 bytes; all but its type may be zero.
    info, instance, count = (ctypes.c_uint64 * 8)(_INSTANCE_CREATE_INFO), ctypes.c_void_p(), ctypes.c_uint32()
    if vulkan.vkCreateInstance(info, None, ctypes.byref(instance)) != 0:
        return 0
    vulkan.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    return count.value


if __name__ == "__main__":
    try:
        sys.exit(0 if _devices() else 1)
    except OSError:
        sys.exit(1)
