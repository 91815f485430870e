"""Cameras and mirrors of any make, and their clocks: `pages/devices.md` says how to write a driver.

`interfaces` has what a session asks of a device, and `simple` what a driver gives. `native` devices are of the former
kind; `adapted_camera`, `adapted_mirror` and `paced` make such devices of the latter. Of a native device's messages and
of each command it is checked here whether they are possible; nothing is clamped.
"""
