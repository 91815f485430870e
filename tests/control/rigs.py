"""Small rigs whose loop can be closed: a fast mirror on a line sensor, disturbed by what its model says."""

from __future__ import annotations

from aolink.rig import Rig, parse_rig

TEXT = """
name = "small-loop"
[plant]
A = [[0.6]]
B = [[0.4]]
B_w = [[1.0]]
C = [[1.0]]
process_noise = 1e-8
[timing]
fast_step_s = 0.001
exposure_steps = 40
[sensor]
kind = "line"
pixels = 40
field = [-1.0, 1.0]
noise_density = 1e-5
counts_per_density = 3000
black_level = 5000
kernel = { shape = "gaussian", sigma = 0.05 }
[mirror]
input_min = -1.0
input_max = 1.0
block_steps = 20
watchdog_s = 2.0
[simulation]
seed = 3
"""
DRIFT = '[[disturbance.model]]\nkind = "ornstein-uhlenbeck"\ncorrelation_s = 0.5\nsd = 0.15\n'
VIBRATION = '[[disturbance.model]]\nkind = "resonance"\nfrequency_hz = 15.0\ndamping = 0.002\nsd = 0.1\n'


def small_rig(*parts: str, **changes: str) -> Rig:
    """With these parts of a disturbance's model, these lines of [control] and [mirror], and this light."""
    text = TEXT.replace("watchdog_s = 2.0", f"watchdog_s = 2.0\n{changes.get('mirror', '')}")
    text = text.replace("seed = 3", f'seed = 3\nlight = "{changes.get("light", "moving")}"')
    return parse_rig("\n".join([text, f"[control]\n{changes.get('control', '')}", *parts]))
