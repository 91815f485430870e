"""Jobs, the work of commands that need several subpackages: the demo, a calibration, many recordings at once.

A job is a function that takes a rig or paths, reports its progress through a function that it is given, raises an
`AolinkError`, and gives its result as a frozen dataclass. It prints nothing: its command does.
"""
