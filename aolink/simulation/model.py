"""The simulated rig's physics: plant, mirror value and camera in fast steps, without a wire and without time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aolink.exposure import Exposure, Picture, Truth, step_shares
from aolink.numerics.arrays import FloatArray
from aolink.numerics.covariance import psd_root
from aolink.optics.camera import pixel_noise_sd, shot_gain, to_counts
from aolink.optics.frame import frame_density
from aolink.rig import Rig, load_rig
from aolink.rig.rows import inputs_by_axis
from aolink.simulation.disturbance import DisturbancePlayer
from aolink.simulation.scene import SceneCamera


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraFrame:
    """A frame as the simulated camera makes it, with the truth."""

    frame_id: int
    """The camera's own count, from 1."""
    first_step: int
    """Fast step at which the exposure starts."""
    n_steps: int
    pixels: NDArray[np.uint16]
    """Counts, (rows, columns)."""
    scene: NDArray[np.uint16] | None
    """Counts of the picture sensor, (rows, columns), where the rig has one."""
    truth: Truth


class RigPhysics:
    """Plant, mirror and camera of a rig, advanced in fast steps.

    Frames depend on the rig, the seed, the inputs and the camera's start, and not on how the steps are split into calls
    of `advance`: initial state, process noise, read-out noise, photo-electrons, disturbance and scene have random
    streams of their own, drawn in the order of time.
    """

    def __init__(self, rig: Rig, seed: int | None = None) -> None:
        plant = rig.plant
        self.rig = rig
        self.step = 0
        """The next fast step."""
        # 5 to 7 are the link's.
        seeds = np.random.SeedSequence(rig.simulation.seed if seed is None else seed).spawn(10)
        streams = map(np.random.default_rng, (*seeds[:5], *seeds[8:]))
        initial, self._process_noise, self._pixel_noise, self._electrons, disturbed, seen, self._faulty = streams
        scatter = initial.standard_normal((plant.axes, plant.n_states, 1))
        self._state = plant.initial_mean + (psd_root(plant.initial_covariance) @ scatter)[..., 0]
        self._noise_input = plant.B_w @ psd_root(plant.process_noise)
        self._transition = np.ascontiguousarray(plant.A.T)
        self._disturbance = DisturbancePlayer(rig, disturbed) if rig.disturbance else None
        self._scene = SceneCamera(rig, seen) if rig.scene else None
        if rig.disturbance and not rig.disturbance.plant_noise:
            self._noise_input = np.zeros_like(self._noise_input)
            self._state = np.tile(plant.initial_mean, (plant.axes, 1))
        self._frames = 0
        self._exposure: int | None = None  # first step of the exposure that runs, or of the next one
        self._exposures_left = 0
        self._delay, self._readout = rig.axis_delays, rig.readout_steps
        self._kept_from = 0  # first fast step of what is kept of exposures that run
        self._outputs: list[FloatArray] = []
        self._states: list[FloatArray] = []
        self._lights = iter(rig.simulation.light)
        self._light = rig.simulation.light[0]
        self._rest: FloatArray | None = None  # where a still spot is held

    def start_camera(self, first_step: int, exposures: int = 0) -> None:
        """Expose from ``first_step`` on, ``exposures`` times (0: until stopped); an earlier run is dropped."""
        if first_step < self.step:
            raise ValueError(f"fast step {first_step} has gone by, the next one is {self.step}")
        self._exposure, self._exposures_left = first_step, exposures
        self._light, self._rest = next(self._lights, self._light), None

    def stop_camera(self) -> None:
        """Stop exposing; an exposure under way gives no frame."""
        self._exposure = None

    def advance(self, u: FloatArray) -> list[CameraFrame]:
        """Apply the mirror values ``u``, (k, axes * n_inputs), for k fast steps; gives the frames that end within
        them."""
        first, states, timing = self.step, self._run(u), self.rig.timing
        outputs = (self.rig.plant.C @ states[:-1, ..., None]).reshape(len(u), self.rig.n_outputs)
        if self._disturbance is not None and len(u):
            outputs = outputs + self._disturbance.slopes(first, len(u))
        self.step += len(u)
        self._keep(first, outputs, states[:-1])
        frames: list[CameraFrame] = []
        long = timing.exposure_steps + self._readout
        while self._exposure is not None and self._exposure + long <= self.step:
            start, whole = self._exposure, slice(self._exposure - self._kept_from, None)
            if len(self._outputs) > 1:
                self._outputs, self._states = [np.concatenate(self._outputs)], [np.concatenate(self._states)]
            before = np.concatenate([self._states[0][whole][: long + 1], self._state[None]])
            frames.append(self._frame(start, self._outputs[0][whole][:long], before[: long + 1]))
            self._exposures_left -= 1
            self._exposure = None if self._exposures_left == 0 else start + timing.frame_period_steps
        return frames

    def _keep(self, first: int, outputs: FloatArray, states: FloatArray) -> None:
        """Keep outputs and states of the fast steps from ``first`` on, while an exposure needs them."""
        needed = self.step if self._exposure is None else self._exposure
        while self._outputs and self._kept_from + len(self._outputs[0]) <= needed:
            self._kept_from += len(self._outputs.pop(0))
            self._states.pop(0)
        if len(outputs) and needed < self.step:
            self._kept_from = self._kept_from if self._outputs else first
            self._outputs.append(outputs)
            self._states.append(states)

    def _run(self, u: FloatArray) -> FloatArray:
        """States before each of k steps and after the last, (k + 1, axes, n_states), by Mishra & Wen (1)."""
        plant = self.rig.plant
        w = self._process_noise.standard_normal((len(u), plant.axes, self._noise_input.shape[1], 1))
        # One small product for each step: the bits of a product over all steps would depend on their number.
        forcing = plant.B @ u.reshape(len(u), plant.axes, plant.n_inputs, 1) + self._noise_input @ w
        forcing = forcing[..., 0]
        states = np.empty((len(u) + 1, plant.axes, plant.n_states))
        states[0] = self._state
        for k in range(len(u)):
            np.dot(states[k], self._transition, out=states[k + 1])
            states[k + 1] += forcing[k]
        self._state = states[-1].copy()
        return states

    def _frame(self, first_step: int, outputs: FloatArray, states: FloatArray) -> CameraFrame:
        """The frame of an exposure, from the outputs at the fast steps from the first row's first to the last row's
        last, and the states there and after them."""
        sensor, faults, n_steps = self.rig.sensor, self.rig.simulation.faults, self.rig.timing.exposure_steps
        every = np.ascontiguousarray(outputs.T)
        held = np.concatenate([every, every[:, -1:]], axis=1) if self._readout else every  # read with a share of zero
        path = self._own_path(every)
        axes = np.arange(self.rig.plant.axes)
        start_state = states[self._delay, axes]
        end_state = states[self._delay + self.rig.window_steps, axes]
        self._frames += 1
        path, density = self._illuminate(path, held, end_state)
        if faults.dark_rate and self._faulty.random() < faults.dark_rate:
            density = np.zeros_like(density)
        if sensor.photoelectrons:
            density_of_one = shot_gain(sensor)
            density = np.asarray(self._electrons.poisson(np.maximum(density, 0) / density_of_one) * density_of_one)
        density = density + pixel_noise_sd(sensor) * self._pixel_noise.standard_normal(sensor.shape)
        pixels = to_counts(sensor, density)
        if faults.saturation_rate:
            pixels[self._faulty.random(pixels.shape) < faults.saturation_rate] = (1 << sensor.bit_depth) - 1
        return CameraFrame(
            frame_id=self._frames, first_step=first_step, n_steps=n_steps, pixels=pixels,
            scene=None if self._scene is None else self._scene_picture(path, held, end_state),
            truth=Truth(start_state=start_state, end_state=end_state, path=path),
        )  # fmt: skip

    def _own_path(self, every: FloatArray) -> FloatArray:
        """Each output in the model's window of its axis, (n_outputs, window_steps), from all steps of the exposure."""
        n_steps = self.rig.window_steps
        if not self._delay.any():
            return every[:, :n_steps].copy()
        starts = np.repeat(self._delay, self.rig.plant.n_outputs)
        return np.stack([row[start : start + n_steps] for row, start in zip(every, starts, strict=True)])

    def _illuminate(self, path: FloatArray, every: FloatArray, end_state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The path that the camera sees and the mean densities, (n_outputs, steps) and (rows, columns)."""
        sensor, light = self.rig.sensor, self._light
        if light.kind == "dark":
            return path, np.zeros(sensor.shape)
        if light.kind == "flat":
            middle = (sensor.full_scale - sensor.black_level) / (2 * sensor.counts_per_density)
            return path, np.full(sensor.shape, middle if light.level is None else light.level)
        if light.kind == "still":
            self._rest = path[:, :1] if self._rest is None else self._rest
            path = np.repeat(self._rest, path.shape[1], axis=1)
            return path, frame_density(sensor, path)
        if sensor.row_starts_s.any():
            return path, self._by_rows(every)
        density, offset = frame_density(sensor, path), self.rig.timing.exposure_offset
        if offset:
            held, weights = self._held(path, end_state)
            gained = frame_density(sensor, held[:, -1:]) - frame_density(sensor, path[:, :1])
            density = np.maximum(density + weights[-1] * gained, 0.0)
        return path, density

    def _by_rows(self, every: FloatArray) -> FloatArray:
        """The mean density where each row of pixels has its own interval: (rows, columns)."""
        sensor, n_steps = self.rig.sensor, self.rig.timing.exposure_steps
        height = sensor.shape[0] // sensor.grid[0]
        density, row_of = np.empty(sensor.shape), np.repeat(sensor.lit // sensor.grid[1], sensor.directions)
        for k in range(height):
            starts = self._row_starts(sensor.row_starts_s[k::height])
            whole, part = np.floor(starts).astype(np.intp), starts - np.floor(starts)
            path = np.stack([each[n : n + n_steps + 1] for each, n in zip(every, whole[row_of], strict=True)])
            first, last = (frame_density(sensor, path[:, each])[k::height] for each in (np.s_[:1], np.s_[n_steps:]))
            mean = frame_density(sensor, path[:, :n_steps])[k::height]
            density[k::height] = np.maximum(mean + part[:, None] / n_steps * (last - first), 0.0)
        return density

    def _row_starts(self, starts_s: FloatArray) -> FloatArray:
        """When rows start, fast steps after the first step of the exposure."""
        return np.round(starts_s / self.rig.timing.fast_step_s, 6) + self.rig.timing.exposure_offset

    def _scene_picture(self, path: FloatArray, every: FloatArray, end_state: FloatArray) -> NDArray[np.uint16]:
        assert self._scene is not None
        assert self.rig.scene is not None
        starts_s = self.rig.scene.row_starts_s
        if self._light.kind == "moving" and starts_s.any():
            return self._scene.frame_by_rows(every, self._row_starts(starts_s), self.rig.timing.exposure_steps)
        seen = every[:, : self.rig.timing.exposure_steps] if self._light.kind == "moving" else path
        return self._scene.frame(*self._held(seen, end_state), self._light.kind)

    def _held(self, path: FloatArray, end_state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions of the spots, step by step, (n_outputs, k), and each step's share of the exposure, (k,).

        With an offset, that part of the first step is not in the exposure, but the same part of the one after its last.
        """
        n_steps, offset = path.shape[1], self.rig.timing.exposure_offset
        if not offset or self._light.kind == "still":
            return path, step_shares(n_steps, 0.0)
        after = (self.rig.plant.C @ end_state[..., None]).reshape(-1, 1)
        return np.concatenate([path, after], axis=1), step_shares(n_steps, offset)


def simulate(
    rig: Rig | str | Path, n_exposures: int, seed: int | None = None, *, inputs: FloatArray | None = None
) -> list[Exposure]:
    """Exposures of the simulated rig with their truth, without a wire.

    Parameters
    ----------
    rig:
        A rig, the name of one that comes with aolink, or a TOML file.
    n_exposures:
        Number of exposures; the first one starts at fast step 0.
    seed:
        Seed of the random numbers; the rig file's own where None.
    inputs:
        Inputs that the mirror applies at each fast step, (steps, n_inputs); where None, the rig's drive, rounded by its
        converter.

    Examples
    --------
    >>> exposures = simulate("section-vi", 3)
    >>> exposures[2].first_step, exposures[2].truth.path.shape
    (400, (1, 200))
    """
    rig = rig if isinstance(rig, Rig) else load_rig(rig)
    timing = rig.timing
    n_steps = (n_exposures - 1) * timing.frame_period_steps + timing.exposure_steps if n_exposures else 0
    n_steps += rig.readout_steps if n_exposures else 0
    if inputs is None:
        inputs = rig.mirror.quantise(rig.drive.inputs(0, n_steps, timing.fast_step_s))
    elif inputs.ndim != 2 or inputs.shape[0] < n_steps or inputs.shape[1] != rig.n_inputs:
        raise ValueError(f"inputs have shape {inputs.shape}, expected at least ({n_steps}, {rig.n_inputs})")
    model = RigPhysics(rig, seed)
    if n_exposures:
        model.start_camera(0, n_exposures)
    frames = model.advance(inputs[:n_steps])
    long, late = rig.window_steps, rig.axis_delays
    ends = [-int(late.max())] + [frame.first_step + long for frame in frames]
    return [
        exposure_of(
            rig, frame, inputs_by_axis(rig.plant, late, inputs, frame.first_step, long).copy(),
            inputs_by_axis(rig.plant, late, inputs, after, frame.first_step - after).copy(),
        )
        for frame, after in zip(frames, ends, strict=False)
    ]  # fmt: skip


def exposure_of(rig: Rig, frame: CameraFrame, inputs: FloatArray, lead_inputs: FloatArray) -> Exposure:
    """The exposure of a frame, with the inputs of each axis in its window and since that of the exposure before, (k,
    n_inputs)."""
    start, end = frame.first_step, frame.first_step + frame.n_steps
    step_ns, late_ns = rig.timing.fast_step_ns, rig.timing.exposure_offset_ns
    return Exposure(
        frame_id=frame.frame_id, first_step=start, n_steps=len(inputs), pixels=frame.pixels,
        mask=np.ones(frame.pixels.shape, dtype=np.bool_), inputs=inputs, lead_inputs=lead_inputs,
        start_offset=late_ns / step_ns, device_start_ns=start * step_ns + late_ns,
        device_end_ns=end * step_ns + late_ns, host_start_ns=start * step_ns + late_ns,
        host_receive_ns=end * step_ns + late_ns, clock_sigma_ns=0.0,
        scene=None if frame.scene is None else Picture(pixels=frame.scene, mask=np.ones(frame.scene.shape, dtype=bool)),
        truth=frame.truth,
    )  # fmt: skip
