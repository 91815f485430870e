"""The list of all rows."""

ROWS = {
    "estimation": (
        "o3_step", "update_forms", "frame_moments_and_o3", "frame_from_last_byte", "moments_of_many_axes",
        "profile_of_many_axes", "profile_of_tip_tilt", "largest_sensor", "spots_under_turbulence",
        "membrane_in_real_time",
    ),
    "optics": (
        "frame_synthesis", "coupled_exposure", "cost_against_lenslets",
        "turbulence", "zonal_wavefront",
    ),
    "wire": ("link_throughput", "frame_to_command", "commands_at_1_khz", "slow_estimator", "live_membrane"),
    "clock": ("host_times",),
    "reach": ("bit_errors", "large_frames", "soak"),
    "devices": ("late_steps", "clock_sd"),
    "parking": ("time_to_park",),
    "recording": (
        "recording_rate", "loop_stall", "reestimation_rate", "chunks_read", "memory_of_an_hour", "kill_at_any_moment",
        "truncation", "flipped_bits", "batch_workers", "rrd_of_ten_minutes", "rrd_size", "view_first",
    ),
    "start": ("command_start", "first_profile", "view_start"),
    "batches": ("tiny_recordings", "cluster_workers"),
    "restoration": ("restoration_quality", "restoration_uncertainty", "restoration_time"),
    "shaken": ("shaken",),
    "moving_scene": ("moving_scene",),
    "family": ("drawn_scenes",),
    "loop": ("residual_slopes", "fall_back"),
    "loop_soak": ("closed_loop_soak",),
    "loop_worth": (
        "worth_headline", "worth_past", "worth_vibrations", "worth_resonance", "worth_air", "worth_factors",
    ),
    "identification": ("coverage", "coverage_with_pixels"),
}  # fmt: skip
"""Functions that measure, by the module of bench_rows that they are in, in the order of the table."""

LONG = frozenset(
    {
        "soak", "closed_loop_soak", "bit_errors", "large_frames", "time_to_park", "restoration_quality", "shaken",
        "moving_scene", "residual_slopes", "fall_back", "worth_headline", "worth_past", "worth_vibrations",
        "worth_resonance", "worth_air", "worth_factors", "drawn_scenes", "coverage", "coverage_with_pixels",
        "first_profile",
    }
)  # fmt: skip
"""Functions that take two minutes or more each, `soak` forty, `closed_loop_soak` sixty.

They are measured where they are named, or with `--long`.
"""
