"""The simulated rig: its physics, its devices with queues, clocks and faults, and what serves them on two ports.

A new fault is a field of `Faults` in `aolink/rig/parts.py`, zero by default, what it does in `faults` (bytes, packets),
`server` (blocks, chunks, clocks, ports) or `model` (pixels), and a test that a session survives it. Nothing is drawn
while it is zero, so that a seed gives what it gave before.
"""
