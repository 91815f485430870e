"""Any deformable mirror of python-microscope: ALPAO, Boston Micromachines, Imagine Optic, or a simulated one."""

from __future__ import annotations

from importlib import import_module
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from aolink.devices.mirrors.keys import Scale
from aolink.devices.simple import Lacks
from aolink.errors import DeviceError, RigError
from aolink.extensions import installed, loaded, needs_extra
from aolink.rig import Rig


class MicroscopeMirror:
    """A `DirectMirror` with one input for each of the device's actuators.

    The device takes numbers from 0 to 1 for each actuator, which are the vendor's full range.

    Parameters
    ----------
    device:
        Path of its class in python-microscope, such as ``microscope.mirror.alpao.AlpaoDeformableMirror``, or the name
        under which another package brings one, an entry point of the group ``aolink.microscope``.
    settings:
        The arguments that the class is made with, such as ``serial_number``.
    unit, zero:
        The part of the range that an input of one moves by, and the part at an input of zero; numbers, or lists of one
        for each input. By default inputs from -1 to 1 are the whole range.

    Raises
    ------
    DeviceError
        The extra ``microscope`` or the vendor's library is missing, there is no such device, or it has another number
        of actuators; or the rig's limits go beyond its range.
    RigError
        A key has a value of the wrong kind.
    """

    lacks: ClassVar[tuple[Lacks, ...]] = (Lacks.READ_BACK, Lacks.WATCHDOG)

    def __init__(
        self, rig: Rig, *, device: str, settings: dict[str, Any] | None = None, unit: float | list[float] = 0.5,
        zero: float | list[float] = 0.5,
    ) -> None:  # fmt: skip
        self._scale = Scale(rig.mirror, unit, zero)
        self._scale.check(0, 1, device, " of the range")
        make = _class_of(device)
        try:
            self._device = make(**(settings or {}))
        except Exception as error:  # a vendor's library may raise anything
            raise DeviceError(f"{device} cannot be opened with {settings or 'no settings'}: {error!r}") from error
        self._park, self.description = rig.mirror.park, f"{device} {settings or ''}".strip()
        try:
            if self._device.n_actuators != rig.n_inputs:
                raise DeviceError(
                    f"{device} has {self._device.n_actuators} actuators, the rig file's mirror {rig.n_inputs} input(s)"
                )
            self.park()
        except BaseException:
            self._device.shutdown()
            raise

    def put(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        self._device.apply_pattern(np.clip(self._scale.of(u), 0.0, 1.0))
        return u

    def park(self) -> None:
        self.put(self._park)

    def close(self) -> None:
        """Give the device back, at the safe input."""
        try:
            self.park()
        finally:
            self._device.shutdown()


def _class_of(path: str) -> Any:
    """The class of this name. Raises DeviceError, or RigError for a name that is not that of a deformable mirror.

    No module is imported but those of python-microscope and of packages that offer theirs.
    """
    with needs_extra("microscope", DeviceError):
        from microscope.abc import DeformableMirror
    module, _, name = path.rpartition(".")
    if point := installed("aolink.microscope").get(path):
        found = loaded(point, "deformable mirror", DeviceError)
    elif not module.startswith("microscope."):
        raise RigError(
            f"devices.mirror.device: {path} is no class of python-microscope (microscope...), and no installed package"
            " offers a device of this name"
        )
    else:
        try:
            found = getattr(import_module(module), name)
        except Exception as error:  # a module that is not there, or the vendor's library that it needs
            raise DeviceError(
                f"devices.mirror.device: {path} cannot be had ({error!r}): is the name right, and is the vendor's"
                " library installed?"
            ) from error
    if not (isinstance(found, type) and issubclass(found, DeformableMirror)):
        raise RigError(f"devices.mirror.device: {path} is no deformable mirror of python-microscope")
    return found
