"""Drivers of cameras, one module each; `aolink.devices.simple` has their interface."""
