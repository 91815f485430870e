"""Every number that the paper prints, beside the value that follows from its equations and the value from our runs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import integrate

from aolink.estimation import ESTIMATOR_NAMES, exposure_model, run
from aolink.estimation.frames.moments import measure_moments
from aolink.exposure import Exposure
from aolink.numerics.arrays import FloatArray
from aolink.optics.camera import pixel_noise_sd, to_counts
from aolink.optics.kernel import exposure_density
from aolink.plant.lifting import input_response, lift
from aolink.plant.observability import observability
from aolink.rig import Plant, Rig
from paper_report.ensemble import IntervalEstimate, ensemble, mean, measure_errors, ratio, rms, variant
from paper_report.judge import Plan, Size
from paper_report.printed import FORMS, output_errors


@dataclass(frozen=True, kw_only=True)
class Effort:
    """How much is simulated."""

    noise_frames: int = 200_000
    runs: int = 120
    """Runs of each table."""
    exposures: int = 40
    """Exposures of each run, the first ``skip`` of which are not scored."""
    cycle_exposures: int = 65
    """Exposures of runs with the slow input: ``skip`` and half a period, to one side and back."""
    skip: int = 15
    map_runs: int = 200
    shake_runs: int = 200
    limit_runs: int = 6
    limit_exposures: int = 14
    limit_skip: int = 4
    o1_runs: int = 60
    """Runs of each scene without the sampler."""
    o1_exposures: int = 24
    film_frames: tuple[int, ...] = (8, 12, 24)
    film_exposures: int | None = None
    """Number of exposures of each length; all that the film has if None."""
    made_kinds: tuple[int, int] = (0, 11)
    """Range of the kinds of made films, from the first number to before the second."""
    made_seeds: int = 5
    made_exposures: int = 14
    family: Plan | None = None
    """What is judged over the family; the rows that the repository keeps if None."""
    particles: int | None = None
    """Particles of the sampler."""
    offsets: tuple[float, ...] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5)
    densities: tuple[float, ...] = (0.1, 0.03, 0.01, 0.003, 0.001)
    process_noises: tuple[float, ...] = (0.1, 1.0, 10.0)
    frequencies: int = 1200
    dpi: int = 200


FULL = Effort()
QUICK = Effort(
    noise_frames=20_000, runs=16, exposures=14, cycle_exposures=20, skip=4, map_runs=16, shake_runs=6,
    limit_runs=2, limit_exposures=4, limit_skip=1, o1_runs=4, o1_exposures=4, particles=150,
    film_exposures=3, made_kinds=(3, 4), made_seeds=1, made_exposures=5,
    family=Plan(
        scenes=4, pixel_scenes=2, limit_scenes=1,
        size=Size(runs=4, exposures=5, skip=2, pixel_runs=1, limit_runs=1, particles=150),
    ),
    offsets=(0.0, 0.5), densities=(0.1, 0.01), process_noises=(0.1, 10.0), frequencies=100, dpi=70,
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One printed number."""

    quantity: str
    printed: str
    expected: str
    """The value that follows from the equations, in closed form or by quadrature."""
    measured: str
    """The value from our runs, with a standard error; empty where there is nothing to measure."""
    verdict: str


def number(value: float, digits: int = 3) -> str:
    """A number for a table."""
    return f"{value:.{digits}g}"


@dataclass(frozen=True)
class MomentNoise:
    """Covariance of y_1 and y_2 over many frames of a spot at rest, with standard errors."""

    y1: IntervalEstimate
    y2: IntervalEstimate
    cross: IntervalEstimate


def moment_noise(rig: Rig, frames: int, position: float = 0.2) -> MomentNoise:
    """Monte Carlo through the whole camera: pixels, integer counts, moments with the kernel taken out."""
    sensor, rng = rig.sensor.profile, np.random.default_rng(7)
    density = exposure_density(sensor.kernel, sensor.edges, np.full(1, position))
    noise = pixel_noise_sd(sensor) * rng.standard_normal((frames, sensor.pixels))
    measured = measure_moments(sensor, to_counts(sensor, density + noise), (1, 2))
    assert not isinstance(measured, str)
    centred = measured.value - measured.value.mean(axis=0)
    products = centred[:, [0, 1, 0]] * centred[:, [0, 1, 1]]
    value, se = products.mean(axis=0), products.std(axis=0) / math.sqrt(frames)
    return MomentNoise(*(IntervalEstimate(v, s, v - 1.96 * s, v + 1.96 * s) for v, s in zip(value, se, strict=True)))


def kernel_rows(rig: Rig) -> list[Row]:
    """Mass and variance of the kernel, by quadrature of the printed formula and of the corrected one."""
    sigma = rig.sensor.kernel.sigma
    reach = 12 * sigma

    def bell(w: float) -> float:
        return math.exp(-(w**2) / sigma**2)

    mass = integrate.quad(bell, -reach, reach)[0]
    variance = integrate.quad(lambda w: w * w * bell(w), -reach, reach)[0] / mass
    printed_line, printed_plane = 1 / math.sqrt(2 * math.pi * sigma), 1 / math.sqrt(2 * math.pi * sigma**2)
    D = rig.sensor.pixel_width
    return [
        Row("mass of the kernel (section VI)", "(1, by (5))", f"{number(mass * printed_line)} = √(σ/2)",
            f"{number(mass / (sigma * math.sqrt(math.pi)))} with 1/(σ√π)", "misprint"),
        Row("mass of the kernel (4), Σ = σI", "(1, by (5))", f"{number(mass**2 * printed_plane)} = σ√(π/2)",
            f"{number(mass**2 / (math.pi * sigma**2))} with 1/(π|Σ|)", "misprint"),
        Row("variance of the kernel, σ = 0.05", "—", f"{number(variance, 4)} = σ²/2", "", "not σ²"),
        Row("what kernel and pixels add to y_2", "0", f"{number(rig.sensor.kernel.variance + D**2 / 12, 4)}"
            " = σ²/2 + D²/12", "", "taken out"),
    ]  # fmt: skip


def noise_rows(rig: Rig, frames: int) -> list[Row]:
    """Rows for 2/3 V, 2/5 V and no cross-covariance, by Monte Carlo; and for the signal-to-noise ratio."""
    V, D = rig.sensor.noise_density, rig.sensor.pixel_width
    found = moment_noise(rig, frames)
    sd = pixel_noise_sd(rig.sensor)
    peak = math.erf(D / 2 / rig.sensor.kernel.sigma) / D
    return [
        Row("variance of y_1", f"2/3 V = {number(2 / 3 * V)}", number(2 / 3 * V, 4), str(found.y1), "reproduced"),
        Row("variance of y_2, (11)", f"2/5 V = {number(2 / 5 * V)}", number(2 / 5 * V, 4), str(found.y2),
            "reproduced"),
        Row("covariance of y_1 and y_2", "0", "0", str(found.cross),
            "reproduced; not for (7), which divides by the light"),
        Row("signal to noise at a pixel, V = 0.1", "0.05", f"V/D = {number(sd**2)}, sd {number(sd)}",
            f"resting peak {number(peak / sd)} sd, mean light {number(0.5 / sd)} sd",
            f"not found; V times mean light: {number(V / 2)}"),
    ]  # fmt: skip


def lifted_noise(rig: Rig, runs: int, exposures: int, seed: int = 31) -> tuple[IntervalEstimate, IntervalEstimate]:
    """Variances that one exposure's process noise adds to both states, from simulated states."""
    _, series = ensemble(variant(rig, offset=0.0), runs, exposures, seed)
    transition, _ = lift(rig.plant, rig.timing.exposure_steps)
    added = [e.truth.end_state - e.truth.start_state @ transition.T for e in series if e.truth is not None]
    squares = np.array(added) ** 2  # (exposures, runs, states)
    return mean(squares[..., 0].T), mean(squares[..., 1].T)


def plant_rows(rig: Rig, effort: Effort) -> list[Row]:
    """Rows for C, timing and the process noise."""
    plant, N = rig.plant, rig.timing.exposure_steps
    _, Q = lift(plant, N)
    printed = plant.B_w @ plant.process_noise @ plant.B_w.T
    W = float(plant.process_noise[0, 0])
    first, second = lifted_noise(rig, effort.runs, effort.exposures)
    return [
        Row("C", "[0.001 0]", "[1 0]", "", "figure 4 says x_1 = θ"),
        Row("T_f, N, T_e", "1 ms, 200, 200 ms", f"T_e = N T_f = {N * rig.timing.fast_step_s * 1e3:.0f} ms", "",
            "consistent"),
        Row("V (a density: pixel variance V/D)", "0.1", number(rig.sensor.noise_density), "", "taken as printed"),
        Row("noise of one exposure, variance of x_2", f"W = 0.1: (B_w W B_wᵀ)₂₂ = {number(printed[1, 1])}",
            f"Σ Aⁱ B_w W_f B_wᵀ Aⁱᵀ: {number(Q[1, 1])}", str(second), f"misprint, {Q[1, 1] / printed[1, 1]:.1f} times"),
        Row("noise of one exposure, variance of x_1", "(B_w W B_wᵀ)₁₁ = 0", number(Q[0, 0]), str(first), "misprint"),
        Row("W_f for which 200 steps give the printed x_2", "—", number(W * printed[1, 1] / Q[1, 1]), "",
            "then the spot's sd is " + number(math.sqrt(plant.initial_covariance[0, 0] * printed[1, 1] / Q[1, 1]))),
    ]  # fmt: skip


def mean_norm(covariance: FloatArray) -> float:
    """E|x| for a Gaussian x of two states, by quadrature over the angle: |x| = r sqrt(cos² v_1 + sin² v_2)."""
    low, high = np.linalg.eigvalsh(covariance)
    inner = integrate.quad(lambda a: math.sqrt(high * math.cos(a) ** 2 + low * math.sin(a) ** 2), 0, math.pi / 2)[0]
    return math.sqrt(math.pi / 2) * inner * 2 / math.pi


@dataclass(frozen=True)
class Norms:
    """Norms of the start state's error, of the plant's own state first."""

    reading: str
    state_rms: float
    """Root mean square of the state itself about its mean, in closed form."""
    state_mean: float
    rms: dict[str, IntervalEstimate]
    """Root mean square of the norms by estimator."""
    mean: dict[str, IntervalEstimate]
    gain: IntervalEstimate
    """Ratio o3/o1 of the root mean squares."""


NORM_NAMES = ("open-loop", "o1", "o2", "o3")


def norms(reading: str, rig: Rig, runs: int, exposures: int, skip: int, seed: int) -> Norms:
    """Steady-state norms of the error of the start state (what figure 5 shows)."""
    many, series = ensemble(rig, runs, exposures, seed)
    found = measure_errors(many, series, table_names(NORM_NAMES), skip)
    covariance = rig.plant.initial_covariance
    return Norms(
        reading=reading,
        state_rms=math.sqrt(np.trace(covariance)),
        state_mean=mean_norm(covariance),
        rms={name: rms(each.start) for name, each in found.items()},
        mean={name: mean(np.sqrt(each.start)) for name, each in found.items()},
        gain=ratio(found["o3"].start, found["o1"].start),
    )


def table_names(names: Sequence[str]) -> tuple[str, ...]:
    """Estimators of a table: those named, and `moments` where there is one."""
    return tuple(names) + (("moments",) if "moments" in ESTIMATOR_NAMES else ())


def norm_readings(rig: Rig, lively: Rig, effort: Effort) -> list[Norms]:
    """The steady-state norms under several interpretations of section VI, which leaves some values open."""
    W = float(rig.plant.process_noise[0, 0])
    _, Q = lift(rig.plant, rig.timing.exposure_steps)
    small = W * float((rig.plant.B_w @ rig.plant.process_noise @ rig.plant.B_w.T)[1, 1]) / Q[1, 1]
    pixel, cycle = 0.1 * rig.sensor.pixel_width, effort.cycle_exposures
    readings = {
        "as printed, C = [1 0], slow input": (rig, cycle),
        "the same without input": (variant(rig, offset=0.0), effort.exposures),
        "the same, held at 0.5": (variant(rig, offset=0.5), effort.exposures),
        "C = [0.001 0] as printed, no input": (variant(rig, offset=0.0, output=[0.001, 0.0]), effort.exposures),
        f"V the variance of a pixel (density {pixel:.3g}), slow input": (variant(rig, noise_density=pixel), cycle),
        f"W = 0.1 per exposure (W_f = {small:.2g}), slow input": (variant(rig, process_noise=small), cycle),
        "lively: W_f = 10, V = 0.01, slow input": (lively, cycle),
    }
    return [
        norms(name, each, effort.runs, exposures, effort.skip, seed=410 + 2 * i)
        for i, (name, (each, exposures)) in enumerate(readings.items())
    ]


@dataclass(frozen=True)
class ErrorRow:
    """RMSE of the path for one pair of noises."""

    process_noise: float
    noise_density: float
    offset: float
    expected: float
    """RMSE of open loop, by the stationary covariance."""
    rmse: dict[str, IntervalEstimate]
    gain: IntervalEstimate
    """Ratio o3/o1."""


def error_table(rig: Rig, effort: Effort) -> list[ErrorRow]:
    """RMSE of the path without input, from the printed noise to little noise on a lively plant, and off centre."""
    points = [(0.1, 0.1, 0.0), (0.1, 0.001, 0.0), (10.0, 0.1, 0.0), (10.0, 0.01, 0.0), (10.0, 0.001, 0.0),
              (0.1, 0.1, 0.5), (10.0, 0.01, 0.5)]  # fmt: skip
    rows = []
    for i, (process_noise, density, offset) in enumerate(points):
        point = variant(rig, process_noise=process_noise, noise_density=density, offset=offset)
        many, series = ensemble(point, effort.runs, effort.exposures, seed=510 + 2 * i)
        found = measure_errors(many, series, table_names(("open-loop", "o1", "o2", "o3")), effort.skip)
        rmse = {name: rms(each.path) for name, each in found.items()}
        expected = math.sqrt((rig.plant.C @ point.plant.initial_covariance @ rig.plant.C.T)[0, 0])
        gain = ratio(found["o3"].path, found["o1"].path)
        rows.append(ErrorRow(process_noise, density, offset, expected, rmse, gain))
    return rows


@dataclass(frozen=True)
class FormRow:
    """The cost of one printed form: RMSE of theta at the exposures' ends."""

    form: str
    rmse: IntervalEstimate
    ratio: IntervalEstimate
    """Ratio to the corrected form, paired."""


def form_table(rig: Rig, effort: Effort) -> tuple[list[FormRow], IntervalEstimate]:
    """RMSE of o3 under each printed form, and that of open loop."""
    many, series = ensemble(rig, effort.runs, effort.cycle_exposures, seed=61)
    found = {name: output_errors(many, series, form, effort.skip) for name, form in FORMS.items()}
    right = found["all corrected"]
    rows = [FormRow(name, rms(squares), ratio(squares, right)) for name, squares in found.items()]
    return rows, open_loop_output_error(many, series, effort.skip)


def open_loop_output_error(rig: Rig, series: Sequence[Exposure], skip: int) -> IntervalEstimate:
    """RMSE of theta at the exposures' ends by prediction only."""
    difference = [
        (estimate.end_state - exposure.truth.end_state) @ rig.plant.C[0]
        for exposure, estimate in zip(series, run(rig, series, ["open-loop"])["open-loop"], strict=True)
        if exposure.truth is not None
    ]
    return rms((np.array(difference) ** 2)[skip:].T)


def late_input_error(rig: Rig, jumping: bool) -> float:
    """RMS error of theta at exposures' ends by the predictor's inputs one step late, without any noise.

    ``jumping``: inputs drawn anew at each step, as a closed loop's are, of the slow input's rms.
    """
    N, plant = rig.timing.exposure_steps, rig.plant
    inputs = rig.drive.inputs(0, 100 * N + 1, rig.timing.fast_step_s)
    if jumping:
        inputs = np.random.default_rng(3).standard_normal(inputs.shape) * np.sqrt(np.mean(inputs**2))
    late, right = (input_response(plant, u[None])[0][0, 0] for u in (inputs[1:], inputs[:-1]))
    return float(np.sqrt(np.mean((late - right)[15 * N :] ** 2)))


def input_inside(rig: Rig) -> float:
    """Largest mean over an exposure of what its own input does to theta: what (12) to (15) leave out."""
    N = rig.timing.exposure_steps
    model = exposure_model(rig.plant, N)
    inputs = rig.drive.inputs(0, 100 * N, rig.timing.fast_step_s)
    return max(abs(float(model.response(u).mean[0, 0])) for u in inputs.reshape(100, N, 1))


def resonance(rig: Rig, frequency_hz: float, damping: float = 0.0) -> Plant:
    """A rotation by the frequency in each fast step, its first coordinate seen; like the rig's plant otherwise."""
    turn = 2 * math.pi * frequency_hz * rig.timing.fast_step_s
    A = math.exp(-damping * turn) * np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    return dataclasses.replace(rig.plant, A=A, B=np.zeros((2, 1)), B_w=np.array([[0.0], [0.01]]),
                               initial_covariance=np.eye(2) * 0.04)  # fmt: skip


@dataclass(frozen=True)
class Remark1:
    """The observability of an undamped eigenmode by centroids, by its frequency."""

    frequency_hz: FloatArray
    gain: FloatArray
    """The gain |C-bar|, which is 1 for a spot at rest."""
    smallest: FloatArray
    """Smallest singular value of [C-bar; C-bar A^N]: 0 where a state is lost."""
    ranks: dict[float, tuple[int, int, int]]
    """States seen at the fast rate, by centroids, and by centroids and y_2 to first order, at chosen frequencies."""


def remark_1(rig: Rig, count: int) -> Remark1:
    """Observability by centroids over frequency (remark 1)."""
    N = rig.timing.exposure_steps
    # The frequencies include those at which a state is lost.
    frequencies = np.union1d(np.linspace(0.5, 20.5, count), np.arange(2.5, 20.5, 2.5))
    gains, smallest = [], []
    for frequency in frequencies:
        model = exposure_model(resonance(rig, float(frequency)), N)
        stack = np.concatenate([model.mean_row, model.mean_row @ model.transition])
        gains.append(np.linalg.norm(model.mean_row))
        smallest.append(np.linalg.svd(stack, compute_uv=False)[-1])
    ranks = {}
    for frequency in (3.0, 10.0, 12.5):
        plant = resonance(rig, frequency)
        report = observability(plant, N, rig.timing.fast_step_s)
        ranks[frequency] = (report.rank, report.centroid_rank, _rank_with_y2(plant, N))
    return Remark1(frequencies, np.array(gains), np.array(smallest), ranks)


def _rank_with_y2(plant: Plant, n_steps: int, exposures: int = 6) -> int:
    """Number of states that y_1 and y_2 of several exposures determine to first order, about a state of no symmetry."""
    model, x = exposure_model(plant, n_steps), np.array([0.2, 0.1])
    rows, power = [], np.eye(2)
    for _ in range(exposures):
        rows += [model.mean_row[0] @ power, (power @ x) @ model.quadratic[0] @ power]
        power = model.transition @ power
    return int(np.linalg.matrix_rank(np.array(rows), tol=1e-9))


@dataclass(frozen=True)
class Remark2:
    """The performance of o2 by the spot's offset: path RMSE over open loop's."""

    offsets: tuple[float, ...]
    o2: list[IntervalEstimate]
    o1: list[IntervalEstimate]


def remark_2(lively: Rig, effort: Effort) -> Remark2:
    """o2 and o1 against open loop on the lively plant, centred and off centre."""
    over: dict[str, list[IntervalEstimate]] = {"o2": [], "o1": []}
    for offset in effort.offsets:
        many, series = ensemble(variant(lively, offset=offset), effort.runs, effort.exposures, seed=71)
        found = measure_errors(many, series, ("open-loop", "o1", "o2"), effort.skip)
        for name, chosen in over.items():
            chosen.append(ratio(found[name].path, found["open-loop"].path))
    return Remark2(effort.offsets, over["o2"], over["o1"])


@dataclass(frozen=True)
class Mechanism:
    """The error of o3 at an offset against that of o1 on centre, with the V that is equivalent to two measurements of
    the position."""

    offset: float
    noise_density: float
    equivalent: float
    """V / (1 + (4 offset²)(2/3)/(2/5))."""
    o1: IntervalEstimate
    o3: IntervalEstimate
    o1_equivalent: IntervalEstimate


def mechanism(lively: Rig, effort: Effort, offset: float = 0.5, noise_density: float = 0.1) -> Mechanism:
    """Check the mechanism of the map in the linear regime: y_2 acts as a second measurement of the position."""
    equivalent = noise_density / (1 + 4 * offset**2 * (2 / 3) / (2 / 5))

    def path_rmse(at: float, density: float, name: str) -> IntervalEstimate:
        rig = variant(lively, offset=at, noise_density=density)
        many, series = ensemble(rig, effort.runs, effort.exposures, seed=81)
        return rms(measure_errors(many, series, (name,), effort.skip)[name].path)

    return Mechanism(
        offset, noise_density, equivalent,
        o1=path_rmse(offset, noise_density, "o1"),
        o3=path_rmse(offset, noise_density, "o3"),
        o1_equivalent=path_rmse(0.0, equivalent, "o1"),
    )  # fmt: skip
