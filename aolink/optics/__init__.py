"""Optics: image kernels on pixels and the camera's counts; lenslets, mirror, turbulence; spots, slopes, wavefront."""
