"""A recording in memory: the section VI rig with known paths and estimates whose errors are known."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from foxglove_schemas_protobuf.Log_pb2 import Log
from scipy.signal import lfilter

from aolink.estimation.estimate import Estimate, Status
from aolink.estimation.model.exposure_model import exposure_model
from aolink.exposure import Exposure, Truth
from aolink.optics.kernel import exposure_density
from aolink.plain import plain_data
from aolink.recording import schemas_pb2 as schemas
from aolink.recording.reader import Recording
from aolink.restoration import RestoredPictures
from aolink.rig import Rig, load_rig
from aolink.series import NOTHING, Also, Series, Step
from aolink.wire import messages_pb2 as wire
from tests.kinds import line_of

HOST_ZERO_NS = 1_700_000_000_000_000_000
DEVICE_ZERO_NS = 5_000_000_000
MEASUREMENTS = {"open-loop": 0, "o1": 1, "o3": 2}
SD = {"open-loop": 0.12, "o1": 0.06, "o3": 0.04}


@dataclass
class Recorded:
    topic: str
    log_time_ns: int
    sequence: int
    message: Any


@plain_data
class Drawn(Estimate):
    """An estimate whose path is given."""

    drawn: np.ndarray
    drawn_sd: np.ndarray

    @property
    def path(self) -> np.ndarray:
        return self.drawn

    @property
    def path_sd(self) -> np.ndarray:
        return self.drawn_sd


@dataclass
class StandIn(Series):
    """What `aolink.recording.reader.Recording` offers."""

    n: int = 12
    names: tuple[str, ...] = ("o1", "o3", "open-loop")
    lost: tuple[int, ...] = ()
    with_truth: bool = True
    with_latency: bool = True
    without_time: tuple[int, ...] = ()
    """Frames that o3 skipped in the session."""
    rig: Rig = field(default_factory=lambda: load_rig("section-vi-lively"))
    path: Path = Path("session.mcap")
    metadata: dict[str, str] = field(default_factory=dict)
    digest: str = "0" * 64
    files: tuple[Path, ...] = ()
    side_of: str = ""

    def __post_init__(self) -> None:
        Series.__init__(self, self)
        rng = np.random.default_rng(7)
        period, ns = self.rig.timing.frame_period_steps, self.rig.timing.fast_step_ns
        n_steps = self.rig.timing.exposure_steps
        steps = np.arange((self.n + 1) * period)
        wander = lfilter([0.006], [1, -0.998], rng.normal(size=len(steps)))
        self.spot = 0.45 * np.sin(2 * np.pi * steps / 20_000) + wander
        self.frame_ids = [k for k in range(self.n) if k not in self.lost]
        self._exposures = []
        for k in self.frame_ids:
            path = self.spot[k * period : k * period + n_steps]
            ends = [self.spot[k * period], self.spot[k * period + n_steps]]
            start_state, end_state = (np.array([[x, 0.1 * x]]) for x in ends)
            seen = exposure_density(self.rig.sensor.kernel, line_of(self.rig).edges, path) + rng.normal(
                size=40
            ) * np.sqrt(0.01 / 0.05)
            pixels = np.clip(np.rint(20000 + 2000 * seen), 0, 65535).astype(np.uint16).reshape(1, -1)
            truth = Truth(start_state=start_state, end_state=end_state, path=path[None])
            mask = np.ones((1, 40), dtype=bool)
            if k == 5:
                mask[0, 30:34] = False
            self._exposures.append(
                Exposure(
                    frame_id=k, first_step=k * period, n_steps=n_steps, pixels=pixels, mask=mask,
                    inputs=np.zeros((n_steps, 1)), lead_inputs=np.zeros((0, 1)), chunks_lost=int(k == 5),
                    device_start_ns=DEVICE_ZERO_NS + k * period * ns,
                    device_end_ns=DEVICE_ZERO_NS + (k * period + n_steps) * ns,
                    host_start_ns=HOST_ZERO_NS + k * period * ns,
                    truth=truth if self.with_truth else None,
                )
            )  # fmt: skip

    damage = ""

    @property
    def has_truth(self) -> bool:
        return self.with_truth

    def __len__(self) -> int:
        return len(self._exposures)

    def steps(
        self, names: Sequence[str] = (), start: int = 0, stop: int | None = None, *, also: Also = NOTHING
    ) -> Iterator[Step]:
        for recorded in self.messages(*also) if also else ():
            also[recorded.topic](recorded)
        made = {name: {each.frame_id: each for each in self.estimates(name)} for name in names}
        for number, exposure in enumerate(self._exposures[start:stop], start):
            frame = exposure.frame_id
            its = {name: found[frame] for name, found in made.items() if frame in found}
            yield Step(number, exposure, its, {"o3"} if frame in self.without_time else set())

    @property
    def estimators(self) -> list[str]:
        return list(self.names)

    @property
    def counts(self) -> dict[str, int]:
        return Counter(each.topic for each in self.messages())

    @property
    def true_scene(self) -> None:
        return None

    def restored(self) -> Iterator[RestoredPictures]:
        return iter(())

    def estimates(self, name: str | None = None) -> list[Any]:
        assert name is not None
        rng = np.random.default_rng(len(name))
        sd, m = SD[name], MEASUREMENTS[name]
        made = []
        for e in self._exposures:
            true = self.spot[e.first_step : e.first_step + e.n_steps]
            path = true + sd * rng.normal() * np.linspace(1, 0.5, e.n_steps)
            made.append(
                Drawn(
                    estimator=name, frame_id=e.frame_id, first_step=e.first_step, n_steps=e.n_steps,
                    status=Status.OK if m else Status.PREDICTED, reason="",
                    start_state=np.array([[path[0], 0.0]]), start_covariance=np.diag([sd**2, 0.01])[None],
                    end_state=np.array([[path[-1], 0.1]]), end_covariance=np.diag([sd**2, 0.04])[None],
                    coefficients=np.zeros((1, 2)), coefficient_covariance=np.zeros((1, 2, 2)),
                    inputs=e.inputs, model=exposure_model(self.rig.plant, e.n_steps), drawn=path[None],
                    drawn_sd=np.full((1, e.n_steps), sd) * np.linspace(1, 1.5, e.n_steps),
                    innovation=np.zeros((1, m)), innovation_covariance=np.zeros((1, m, m)),
                    nis=rng.chisquare(max(m, 1), size=1),
                )
            )  # fmt: skip
        return made

    def messages(self, *topics: str) -> Iterator[Recorded]:
        made = [r for source in (self._blocks(), self._per_frame(), self._per_second()) for r in source]
        return iter(sorted((r for r in made if not topics or r.topic in topics), key=lambda r: r.log_time_ns))

    def _blocks(self) -> Iterator[Recorded]:
        block = self.rig.mirror.block_steps
        for i, first in enumerate(range(0, self.n * self.rig.timing.frame_period_steps, block)):
            u = self.rig.drive.inputs(first, block, self.rig.timing.fast_step_s).ravel()
            sent = wire.CommandBlock(block_id=i + 1, first_step=first, n_steps=block, u=u)
            source = wire.Applied.PARKED if i == 3 else wire.Applied.COMMAND
            held = wire.Applied(block_id=i + 1, first_step=first, n_steps=block, u=np.round(u, 4), source=source)
            yield Recorded("/mirror/command", HOST_ZERO_NS + first * 10**6, 0, sent)
            yield Recorded("/mirror/applied", HOST_ZERO_NS + (first + block) * 10**6, 0, held)

    def _per_frame(self) -> Iterator[Recorded]:
        before = -1
        for e in self._exposures:
            at = e.host_start_ns + 210_000_000
            info = schemas.ExposureInfo(
                frame_id=e.frame_id,
                first_step=e.first_step,
                chunks_lost=e.chunks_lost,
                frames_lost_before=e.frame_id - before - 1,
            )
            before = e.frame_id
            yield Recorded("/camera/exposure", at, 0, info)
            if self.with_latency:
                end = e.host_start_ns + e.n_steps * 1_000_000
                late = schemas.Latency(
                    frame_id=e.frame_id, exposure_end_ns=end, first_byte_ns=end + 400_000, complete_ns=end + 900_000
                )
                late.estimated_ns = end + 1_500_000 + 100_000 * (e.frame_id % 3)
                yield Recorded("/latency", at, 0, late)
            if self.without_time:
                skipped = e.frame_id in self.without_time
                done = schemas.Estimation(
                    estimator="o3", frame_id=e.frame_id, skipped=skipped, took_ns=0 if skipped else 10**6
                )
                yield Recorded("/estimation/o3", at, 0, done)

    def _per_second(self) -> Iterator[Recorded]:
        for s in range(self.n // 5 + 1):
            at = HOST_ZERO_NS + s * 10**9
            for i, device in enumerate(("camera", "mirror")):
                counts = schemas.ConnectionStatistics(
                    device=device, bytes_received=s * 90_000 * (i + 1), bad_crc=s // 4, round_trip_s=0.0002 + 1e-5 * i
                )
                yield Recorded("/connection", at, 0, counts)
                clock = schemas.ClockSample(
                    device=device,
                    host_receive_ns=at,
                    round_trip_ns=180_000 + 1000 * s,
                    offset_ns=1e9 + 20_000 * s,
                    frequency_ppm=20,
                    sigma_ns=9e4 / (s + 1),
                )
                yield Recorded("/clock", at, 0, clock)
            text = Log(level=Log.WARNING if s == 1 else Log.INFO, message=f"second {s}", name="session")
            yield Recorded("/log", at, 0, text)


def as_recording(stand_in: object) -> Recording:
    """For the type checker: it has what viewing asks of a recording."""
    return cast(Recording, stand_in)
