"""The exposure model with its dense arrays, for any plant."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from aolink.estimation.model.base import ExposureModel, InputResponse, by_axis
from aolink.numerics import batched
from aolink.numerics.arrays import FloatArray
from aolink.numerics.covariance import psd_root
from aolink.plant.lifting import input_response, output_rows
from aolink.rig import Plant

# Most cosines for each noise channel, of 0, 1, 2, ... half periods in an exposure; fewer where fewer do.
_MOST_NOISE_MODES = 24
# Share of the noise path (rms) that may be left out.
_NOISE_LEFT_OUT = 0.02
_TIME_BLOCK = 256
# Most states of a plant that is stepped through an exposure by compiled code; products of matrices are faster for more.
_FEW_STATES = 8


class DenseModel(ExposureModel):
    """`ExposureModel` of any plant."""

    def __init__(self, plant: Plant, n_steps: int) -> None:
        self._state_rows = output_rows(plant, n_steps)
        super().__init__(plant, n_steps, self._state_rows.mean(axis=1))
        if self.delays:
            self.mean_row = self.seen(self._state_rows).mean(axis=1)
        # Where outputs are more than states, and each has no unmodelled slope of its own, they are sums of the states:
        # paths of the states are computed then.
        few = plant.n_outputs > plant.n_states and not self.n_unmodelled
        self._few = replace(plant, C=np.eye(plant.n_states)) if few else plant

    @property
    def state_rows(self) -> FloatArray:
        return self._state_rows

    def times_quadratic(self, state: FloatArray) -> FloatArray:
        return np.asarray(np.matmul(self.quadratic, state[:, None, :, None])[..., 0])

    @property
    def basis(self) -> FloatArray:
        outputs, paths = self.factors
        return paths if outputs is None else np.tensordot(outputs, paths, axes=1)

    @property
    def factors(self) -> tuple[FloatArray | None, FloatArray]:
        return None if self._few is self.plant else self.plant.C, self._with_noise[0]

    @property
    def end_rows(self) -> FloatArray:
        return self._with_noise[1]

    @cached_property
    def end_remainder(self) -> FloatArray:
        reached = self.end_rows[:, self.plant.n_states :]
        root = psd_root(self.process_noise - reached @ reached.T)
        return root @ root.T

    @cached_property
    def _with_noise(self) -> tuple[FloatArray, FloatArray]:
        """Start columns and noise columns of path and end state; of the states' paths where they are fewer.

        Each noise channel is a sum of cosines, of unit variance each and orthonormal over the fast steps.
        """
        plant, n_steps = self._few, self.n_steps
        rows = self.state_rows if plant is self.plant else output_rows(plant, n_steps)
        root = plant.B_w @ psd_root(plant.process_noise)
        impulse = rows @ root  # C A^i B_w, (n_outputs, n_steps, n_noises)
        energy = (np.arange(n_steps - 1, -1, -1)[:, None] * self._squares(impulse)).sum()
        paths, ends, found = [rows], [self.transition], 0.0
        if self.n_unmodelled:
            own = self.unmodelled_sd * np.eye(self.n_unmodelled)
            paths.append(np.repeat(own[:, None], n_steps, axis=1))
            ends.append(np.zeros((plant.n_states, self.n_unmodelled)))
        phase = np.pi * (np.arange(n_steps) + 0.5) / n_steps
        driven = [replace(plant, B=column[:, None], axes=1) for column in root.T]
        for m in range(min(_MOST_NOISE_MODES, n_steps)):
            if energy - found <= _NOISE_LEFT_OUT**2 * energy:
                break
            cosine = np.cos(m * phase) * np.sqrt((2 if m else 1) / n_steps)
            channels = [input_response(channel, cosine[None, :, None]) for channel in driven]
            paths.append(np.stack([path[0] for path, _ in channels], axis=-1))
            ends.append(np.stack([end[0] for _, end in channels], axis=-1))
            found += float(self._squares(paths[-1]).sum())
        return np.concatenate(paths, axis=2), np.concatenate(ends, axis=1)

    def _squares(self, paths: FloatArray) -> FloatArray:
        """Terms whose sum is the sum of squares over outputs, from paths of the `_few` plant, (., n_steps, n)."""
        if self._few is self.plant:
            return paths**2
        C = self.plant.C
        return np.asarray(paths * np.tensordot(C.T @ C, paths, axes=1))

    def mixed_rows(self, weights: FloatArray, count: int) -> FloatArray:
        outputs, paths = self.factors
        mixed = weights if outputs is None else weights @ outputs
        return np.tensordot(mixed, paths[:, :, :count], axes=1)

    def responses(self, inputs: FloatArray) -> InputResponse:
        if not (inputs[:, -1].any() or inputs.any()):
            return self._at_rest(len(inputs) * self.plant.axes)
        few = self.plant.n_states <= _FEW_STATES and not self.delays
        found = (self._stepped if few else self._multiplied)(inputs)
        if not self.moved:
            return found
        # Inputs have done nothing yet in the first step.
        late = self.moved * self.last_response(found.end)
        return replace(
            found, mean=found.mean + late, square=found.square + late * late / self.moved,
            slope=found.slope + late[..., None] * self.last_rows,
        )  # fmt: skip

    def _at_rest(self, axes: int) -> InputResponse:
        """The response to no inputs."""
        n, outputs = self.plant.n_states, self.plant.n_outputs
        none = np.zeros((axes, outputs))
        return InputResponse(
            end=np.zeros((axes, n)), mean=none, slope=np.zeros((axes, outputs, n)), square=none,
            whole=lambda: np.zeros((axes, outputs, self.n_steps)),
        )  # fmt: skip

    def _stepped(self, inputs: FloatArray) -> InputResponse:
        """`responses` by compiled steps; c is only written where it is asked for."""
        from aolink.estimation.compiled.responses import responses, responses_of_two_states  # not before it is needed

        plant, axes, n, outputs = self.plant, len(inputs) * self.plant.axes, self.plant.n_states, self.plant.n_outputs
        given = [_constant(each) for each in (plant.A, plant.B, plant.C, self._state_rows, inputs)]
        found = [np.empty((*rows, axes)) for rows in ((n,), (outputs,), (outputs, n), (outputs,))]
        if (n, plant.n_inputs, outputs) == (2, 1, 1):
            responses_of_two_states(*given, *found)
        else:
            responses(*given, *found, np.empty((0, outputs, self.n_steps)))

        def path() -> FloatArray:
            path = np.empty((axes, outputs, self.n_steps))
            responses(*given, *(np.empty_like(each) for each in found), path)
            return path

        end, mean, slope, square = found
        return InputResponse(end=end.T, mean=mean.T, slope=np.moveaxis(slope, -1, 0), square=square.T, whole=path)

    def _multiplied(self, inputs: FloatArray) -> InputResponse:
        """`responses` by products of matrices, of many steps at once."""
        path, end = input_response(self.plant, by_axis(self.plant, inputs))
        seen = self.seen_path(path)
        mean, square = batched.mean_over_path(seen), batched.mean_over_path(seen * seen)
        if self.delays:
            slope = np.einsum("aoi,ois->aos", seen, self.seen(self.state_rows)) / self.exposed_steps
        elif self._few is self.plant:
            # Column by column, so that the products lie in memory as they are summed.
            columns = [batched.mean_over_path(path * column) for column in self._columns[: self.plant.n_states]]
            slope = np.stack(columns, axis=-1)
        else:
            slope = np.matmul(path[:, :, None], self.state_rows)[:, :, 0] / self.n_steps
        return InputResponse(end=batched.batch_last(end), mean=mean, slope=slope, square=square, whole=lambda: path)

    def path(self, coefficients: FloatArray, input_path: FloatArray) -> FloatArray:
        path = input_path.copy()
        if self._few is not self.plant:
            paths = self._with_noise[0][..., : coefficients.shape[1]]
            states = np.matmul(paths, coefficients[:, None, :, None])[..., 0]
            return np.asarray(path + np.matmul(self.plant.C, states))
        for j in range(coefficients.shape[1]):
            path += self._columns[j] * coefficients[:, j, None, None]
        return path

    def path_sd(self, covariance: FloatArray) -> FloatArray:
        count = covariance.shape[1]
        covariance = np.ascontiguousarray(covariance)[:, None]
        if self._few is not self.plant:
            C, paths = np.ascontiguousarray(self.plant.C.T), self._with_noise[0].swapaxes(0, 1)[..., :count]
            of_states = np.matmul(np.matmul(paths, covariance), paths.swapaxes(1, 2))  # at each step
            each = [np.maximum((np.matmul(of_states[:, k], C) * C).sum(axis=1), 0.0) for k in range(self.n_steps)]
            return np.asarray(np.sqrt(np.stack(each, axis=-1)))
        variance = np.empty((len(covariance), self.plant.n_outputs, self.n_steps))
        basis = self.state_rows if count <= self.plant.n_states else self.basis
        for start in range(0, self.n_steps, _TIME_BLOCK):
            rows = np.ascontiguousarray(basis[:, start : start + _TIME_BLOCK, :count])
            variance[..., start : start + _TIME_BLOCK] = batched.dot(batched.matmul(rows, covariance), rows)
        if count > self.plant.n_states:
            variance += self.unmodelled_rest
        return np.sqrt(np.maximum(variance, 0.0))

    @cached_property
    def _columns(self) -> FloatArray:
        """The basis column by column, (n_coefficients, n_outputs, n_steps)."""
        return np.ascontiguousarray(self.basis.transpose(2, 0, 1))


def _constant(values: FloatArray) -> FloatArray:
    """The same values as all callers of compiled code give them, so that it is compiled once."""
    view = np.ascontiguousarray(values, dtype=np.float64).view()
    view.flags.writeable = False
    return view
