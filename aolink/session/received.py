"""Frames as they come from the camera: each is counted, given the host's time of its start, and recorded."""

from __future__ import annotations

from dataclasses import replace

from aolink.assembly import Frame
from aolink.devices.interfaces import Camera, Mirror, Time
from aolink.recording import convert, topics
from aolink.recording import schemas_pb2 as pb
from aolink.rig import Rig
from aolink.session.journal import Journal
from aolink.session.report import LatencyBook, Report

_ALIGNED = 0.2
"""Largest standard deviation of an exposure's alignment without a warning, as a part of the exposure: estimates'
intervals hold up to there."""


class ReceivedFrames:
    """The frames of a session, of the wavefront sensor and of the picture sensor."""

    def __init__(
        self, rig: Rig, time: Time, camera: Camera, mirror: Mirror, journal: Journal, latencies: LatencyBook
    ) -> None:
        self._timing, self._camera, self._journal = rig.timing, camera, journal
        self._latencies = None if time.virtual else latencies
        self._check_alignment = mirror.commanded
        """Whether an exposure that is not aligned well enough is to be warned of."""
        self._newest_steps: dict[int, int] = {}
        """First fast step of the newest frame, by its sensor's number on the wire."""
        self._restarted: set[int] = set()
        """Numbers of the sensors from which no frame has come since the camera was started again."""

    def camera_restarted(self) -> None:
        """Note that the camera was started again: it does not number the exposures that it has missed."""
        self._restarted = set(self._newest_steps)

    def take(self, frame: Frame, receive_ns: int) -> None:
        """Make messages of a frame, with the host's time of its start and all frames lost before it."""
        frame = self._with_host_time(self._with_missed(frame), receive_ns)
        report, exposure_ns = self._journal.report, self._timing.exposure_steps * self._timing.fast_step_ns
        self._count(report, frame)
        if not frame.plane and self._check_alignment and frame.alignment_sigma_ns > _ALIGNED * exposure_ns:
            self._check_alignment = False
            report.warnings.append(
                "which of the mirror's fast steps an exposure covers is known only to"
                f" {frame.alignment_sigma_ns / exposure_ns:.2g} of an exposure (sd, frame {frame.frame_id}): intervals"
                f" of estimates are reliable up to {_ALIGNED:g}; give delay_s and delay_sd_s of the devices as well as"
                " they are known"
            )
        if not frame.plane and self._latencies is not None:
            host_end_ns, _ = self._camera.clock.host_ns(frame.device_end_ns)
            latency = pb.Latency(
                frame_id=frame.frame_id, exposure_end_ns=host_end_ns, first_byte_ns=frame.host_first_byte_ns,
                complete_ns=frame.host_receive_ns,
            )  # fmt: skip
            self._latencies.frame(latency)
        info, image = convert.frame_messages(frame)
        self._journal.take(topics.SCENE_EXPOSURE if frame.plane else topics.EXPOSURE, receive_ns, info)
        self._journal.take(topics.SCENE if frame.plane else topics.IMAGE, receive_ns, image)

    @staticmethod
    def _count(report: Report, frame: Frame) -> None:
        kind = "scenes" if frame.plane else "frames"
        lost = {"received": 1, "incomplete": frame.chunks_lost > 0, "lost": frame.frames_lost_before}
        for name, count in lost.items():
            setattr(report, f"{kind}_{name}", getattr(report, f"{kind}_{name}") + count)

    def _with_missed(self, frame: Frame) -> Frame:
        """The frame with a count of the exposures that the camera has missed before it was started again."""
        before = self._newest_steps.get(frame.plane)
        self._newest_steps[frame.plane] = frame.first_step
        if before is None or frame.plane not in self._restarted:
            return frame
        self._restarted.remove(frame.plane)
        lost = (frame.first_step - before) // self._timing.frame_period_steps - 1
        return replace(frame, frames_lost_before=max(frame.frames_lost_before, lost))

    def _with_host_time(self, frame: Frame, receive_ns: int) -> Frame:
        step_ns, camera = self._timing.fast_step_ns, self._camera
        since_zero_ns = frame.first_step * step_ns + frame.exposure_offset_ns
        length_ns = (frame.last_step + 1 - frame.first_step) * step_ns
        # The end's time first: it may raise the doubt about the start.
        camera.host_ns(frame.device_end_ns, since_zero_ns + length_ns, receive_ns)
        host_start_ns, sigma_ns = camera.host_ns(frame.device_start_ns, since_zero_ns, receive_ns)
        return replace(frame, host_start_ns=host_start_ns, clock_sigma_ns=sigma_ns)
