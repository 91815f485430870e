"""The description of a rig: a TOML file, and the frozen dataclasses that it becomes.

A new key is a field of its table's dataclass, with its meaning and unit below it and a default, so that old files still
work; a new table is a field of ``_File`` in `file`. Refuse what cannot work where the table is read; report what is
doubtful in `aolink.jobs.check_rig`. Then ``tools/pages`` writes KEYS.md.
"""

from aolink.optics.sensor import Kernel, Sensor, SpotSensor
from aolink.rig.file import Rig, builtin_rigs, load_rig, parse_rig, rig_of
from aolink.rig.parts import (
    Control,
    Drive,
    Faults,
    Light,
    MirrorDriver,
    Plant,
    Simulation,
    Timing,
    parse_light,
)  # fmt: skip
from aolink.rig.sensor_tables import CalibrationTable
from aolink.rig.tables import with_faults

__all__ = [
    "CalibrationTable", "Control", "Drive", "Faults", "Kernel", "Light", "MirrorDriver", "Plant", "Rig", "Sensor",
    "Simulation", "SpotSensor", "Timing", "builtin_rigs", "load_rig", "parse_light",
    "parse_rig", "rig_of", "with_faults",
]  # fmt: skip
