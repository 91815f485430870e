"""Rigs whose cameras expose their rows one after the other."""

import dataclasses

from aolink.rig import Rig, load_rig, parse_rig


def rolling(name: str, row_time_s: float, *, noise: bool = True) -> Rig:
    """A rig that comes with aolink, with this row time."""
    text = load_rig(name).toml.replace("[sensor]", f"[sensor]\nrow_time_s = {row_time_s!r}", 1)
    rig = parse_rig(text, load_rig(name).folder)
    return rig if noise else dataclasses.replace(rig, sensor=dataclasses.replace(rig.sensor, noise_density=0.0))


COUPLED = """
name = "two mirrors' axes, four spots"
[plant]
A = [[0.98, 0.05, 0.0, 0.0], [-0.05, 0.98, 0.0, 0.0], [0.0, 0.0, 0.97, 0.08], [0.0, 0.0, -0.08, 0.97]]
B = [[0.0, 0.0], [0.5, 0.0], [0.0, 0.0], [0.0, 0.5]]
B_w = [[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]
C = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.9, 0.0, 0.1, 0.0], [0.1, 0.0, 0.9, 0.0],
     [0.8, 0.0, 0.3, 0.0], [0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.2, 0.0, 0.8, 0.0]]
process_noise = [[0.0002, 0.0], [0.0, 0.0002]]
initial_covariance = [[0.01, 0.0, 0.0, 0.0], [0.0, 0.01, 0.0, 0.0], [0.0, 0.0, 0.01, 0.0], [0.0, 0.0, 0.0, 0.01]]
[timing]
fast_step_s = 1e-3
exposure_steps = 100
frame_period_steps = 150
[sensor]
kind = "spots"
grid = [2, 2]
window = [16, 16]
field = [-1.5, 1.5]
noise_density = 0.00005
bit_depth = 16
black_level = 2000
counts_per_density = 5000
row_time_s = 2.5e-3
kernel = {shape = "gaussian", sigma = 0.25}
[mirror]
input_min = -0.2
input_max = 0.2
dac_bits = 16
block_steps = 10
"""
"""One plant that moves four spots."""
