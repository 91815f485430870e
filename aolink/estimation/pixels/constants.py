"""The constants of the estimator `profile`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Constants:
    """All numbers in the update of `profile`, in the order in which it uses them, each with its reason."""

    # Windowed moments, which are wide where the posterior has several modes.
    broad_passes: int = 2
    """Passes of their linearisation: they only show where to search."""
    # Starts of the search for modes.
    wide_path: float = 0.5
    """Variance of the path, in variances of the kernel, above which a search starts along more than one direction."""
    directions: int = 3
    """Most directions: those that leave the path most uncertain."""
    start_reach: float = 1.3
    """Distance of a start from the mean, in standard deviations: near enough to be likely, far enough to lead to
    another mode."""
    reversed_to: float = 0.2
    """A start for a reversed path fits it to this many standard deviations of the kernel, if the prior allows."""
    # The search, by Levenberg and Marquardt's method.
    passes: int = 16
    """Most steps, which bounds the work."""
    converged: float = 0.03
    """Nats by which the objective still changes at a mode: near enough to draw points about it."""
    apart: float = 0.7
    """Modes that are nearer to each other than this many standard deviations count as one."""
    # The innovation.
    new_directions: int = 4
    """Directions of the pixels, for each output; the others hold hardly more than noise."""
    no_information: float = 1e-13
    """Information of a direction, as a share of the largest, that is rounding."""
    # A mode that was lost is found again.
    doubt: float = 1e-3
    """Share of the prior that is the prediction without any measurement."""
    doubted: float = 1e-3
    """Its modes are searched for where the NIS is as large as it is by chance with this probability."""
    # The density that points are drawn from.
    wide: float = 0.3
    """Share of it that is the Gaussians of windowed moments, which cover what no search has found."""
    inflation: float = 1.5
    """The modes' covariances are multiplied by this: tails that are too thin cost more than ones that are too thick."""
    evidence: float = 0.5
    """The modes' log-evidence is multiplied by this: Laplace's evidence of a mode that is bent is rough."""
    # Importance sampling.
    rounds: int = 4
    """Most rounds, which bounds the work."""
    points: int = 14
    """Points of a round for each pair of coefficients, rounded up to a power of two."""
    fewest_points: int = 128
    """For one or two coefficients that would be too few."""
    fewest_of_a_share: int = 32
    """And the fewest, whatever share of them is asked for."""
    most_points: int = 2048
    """The most points of a round."""
    work: float = 2.5e6
    """And as many as about this number of products allow, so that an exposure of a spot on a plane, whose points are
    three times the work, takes about as long as its frame."""
    enough: float = 100.0
    """The effective sample size at which rounds end."""
    share_of_one_mode: float = 0.25
    """Share of the points, and of that effective sample size, that is enough for a posterior with one mode. Where there
    are several, random errors of the modes' weights would add up from exposure to exposure."""
    least_share: float = 0.05
    """A second mode of this share of the posterior is reported as another path."""
    least_doubted_share: float = 0.005
    """From a tenth of that all points are drawn, since the evidence of modes is rough."""
    too_few: float = 0.5
    """With less than this share of the wanted effective sample size the estimate's reason says that it is wider."""
    least_effective: float = 128.0
    """Weights are flattened (raised to a power below one) until the effective sample size is this, since a fit to a
    handful of points is too sure of itself."""
    halvings: int = 6
    """Steps of the search for that power."""
    # The Gaussians that are fitted to the weighted points, by one step of expectation and maximisation (EM).
    prior_points: float = 2.0
    """Between rounds, a Gaussian's old covariance counts as this many points for each coefficient: few, so that it soon
    finds its place."""
    last_prior_points: float = 3.0
    """And in the last round, where a covariance of few points would be too narrow."""
    tightened: float = 1 / 1.5
    """Factor of the old covariances if the last round is the first: the inflation is taken back."""
    loosened: float = 1.2
    """And otherwise. (With twenty coefficients, where they count as sixty points, a factor of two makes intervals of
    95 % hold 98 to 99 %.)"""
    negligible: float = 1e-3
    """A Gaussian of less than this weight is dropped."""
    # What goes on to the next exposure.
    carried: int = 4
    """Most Gaussians: with twelve the errors are the same, with one the path's error may grow by a third."""
    free: float = 0.01
    """They are merged further while a merger costs less than this, in nats."""


PROFILE = Constants()
