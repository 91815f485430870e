"""Optics: image kernels on pixels, and the camera's counts."""
