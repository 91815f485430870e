"""How long a session waits, and for what: all of its time-outs, in one place."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Timeouts:
    """Times in s, with the numbers of tries and the factors that go with them. On virtual time, where the rig waits,
    only ``virtual_silence_s`` and ``last_patience_s`` count."""

    # Anything that waits
    slice_s: float = 0.1
    """Longest sleep: a request to stop is noticed within this time."""

    # A port
    write_s: float = 5.0
    """A port that takes nothing for this long is lost; ``stopped_write_s`` once a stop is requested."""
    stopped_write_s: float = 1.0
    reopen_s: float = 0.05
    """Between two tries to open a port that has vanished."""
    silent_s: float = 2.0
    """A device whose port may vanish counts as disconnected when it has not answered a clock query for this long."""

    # A request and its answer
    answer_s: float = 1.0
    """How long an answer may take before a request is sent again, and the longest wait for an answer after a stop."""
    tries: int = 3
    most_tries: int = 200
    """Most tries of a request that is insisted on, while anything at all is heard of the device."""
    clock_answer_s: float = 0.2
    """How long the start waits for the answer to one clock query."""
    camera_start_answer_s: float = 0.05
    """Wait for the answer to a camera's start, which is at a near step: the next try must not be late."""
    camera_start_tries: int = 60
    park_answer_s: float = 0.05
    park_silent_s: float = 5.0
    """A mirror of which nothing is heard for this long, or for ``mirror_watchdogs``, is not asked to park any more."""
    virtual_silence_s: float = 20.0
    """A rig on virtual time that sends nothing for this long counts as gone."""
    last_patience_s: float = 0.2
    """How long to wait for a device that has already delayed the session's end."""

    # Command blocks and reports of the mirror
    first_try_s: float = 0.1
    """Between two tries of a block while no round trip has been measured."""
    least_try_s: float = 0.01
    """Least time between two tries of a block: a Python host is held up for some ms now and then."""
    most_try_s: float = 0.5
    late_tries: int = 4
    """A late block is sent again at every fourth time-out only: just its answer is still needed, to account for its
    steps."""
    mirror_watchdogs: float = 2.0
    """A mirror that answers nothing for this many times its watchdog has parked itself, and the session ends."""
    least_tries: int = 5
    """Least tries before a mirror is given up: a host that was held up has not read the answers yet."""
    least_report_tries: int = 3
    """The same, before a report is given up."""
    report_s: float = 1.0
    """How long the end of a session waits for the reports of a driver's mirror."""
    keep_alives: int = 3
    """Least number of messages that a mirror is sent in the time of its watchdog."""

    # The loop
    start_delay_s: float = 0.25
    """Least time from the first command to its first step; with a long queue it is the queue's length, so that the
    queue is full then."""
    start_tries: int = 5
    statistics_s: float = 1.0
    """Between two records of what the connections have counted."""
    grace_s: float = 1.5
    """How long a frame may take after its exposure's end before it counts as lost."""
    first_frame_s: float = 5.0
    """How long a camera may take until its first frame: some start slowly, above all on a busy machine."""
    held_up_s: float = 1.0
    """A turn of the loop that takes longer is one in which this process did not run."""
    progress_s: float = 0.1
    """Between two reports of the progress; the session's end waits ``last_progress_s`` for the last one."""
    last_progress_s: float = 2.0

    # Estimators
    hangs_s: float = 5.0
    """An estimator that has not answered for this long, and for ``hangs_factor`` times as long as it ever took,
    hangs."""
    hangs_factor: float = 10.0
    estimates_s: float = 5.0
    """How long the session's end waits for estimates that are under way."""
    process_end_s: float = 1.0
    """Longest wait for a process that was asked to end."""
    reap_s: float = 0.01
    """Longest wait for a process whose end of the socket is closed: the loop stands still meanwhile."""

    # The disk
    disk_s: float = 2.0
    """Of a disk that takes longer over one write, a warning says how long."""
    disk_end_s: float = 60.0
    """How long the end of a recording waits for one write."""


TIMEOUTS = Timeouts()
