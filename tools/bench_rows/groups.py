"""The list of all rows."""

ROWS = {
    "estimation": (
        "o3_step", "update_forms", "frame_moments_and_o3", "frame_from_last_byte", "moments_of_many_axes",
        "profile_of_many_axes", "profile_of_tip_tilt", "largest_sensor", "spots_under_turbulence",
        "membrane_in_real_time", "growth", "frame_synthesis",
    ),
    "wire": (
        "link_throughput", "frame_to_command", "commands_at_1_khz", "slow_estimator", "clock_nees", "bit_errors",
    ),
    "recording": (
        "recording_rate", "loop_stall", "reestimation", "walks", "tiny_recordings", "batch_workers",
        "rrd_of_ten_minutes", "rrd_size",
    ),
    "start": ("command_start", "first_profile", "view_start", "look_answer"),
    "restoration": ("restoration_quality", "restoration_time", "shaken"),
    "loop": ("loop_worth",),
}  # fmt: skip
"""Functions that measure, by the module of bench_rows that they are in, in the order of the table."""

LONG = frozenset({"bit_errors", "restoration_quality", "shaken", "loop_worth", "first_profile", "look_answer"})
"""Functions that take two minutes or more each: they are measured where they are named, or with `--long`."""
