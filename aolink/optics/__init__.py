"""Optics: image kernels on pixels and the camera's counts; lenslets, mirror, turbulence; spots, slopes, wavefront.

It knows no rig file and no time. A new kind of mirror is a function of `mirror` that gives a `MirrorPlant`, one that
reads its keys in `aolink/rig/optical_plant.py`, and its name in `aolink/rig/tables.py`.
"""
