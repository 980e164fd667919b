"""Figures of the experiment ``dronevio book imu``."""

from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from dronevio.estimator.book.drift import DriftStudy
from dronevio.estimator.book.imu import GraphFactor, ImuExperiment
from dronevio.estimator.book.visual_inertial import CameraStudy
from dronevio.eval.colours import AXES, ESTIMATE, ESTIMATORS, SECOND, SIGMA, SURROUNDINGS, TRUTH
from dronevio.models.arrays import Array

NOISE_MAGNIFICATION = 30
"""Factor by which the ellipses of the IMU noise are magnified in the plot of the path."""
RATIO_BOUNDS = (0.8, 1.25)
"""Bounds between which measured and predicted drift are regarded as equal."""

_AXIS_M = 0.35
_LABEL_OFFSET_M = 0.28
_CIRCLE = np.linspace(0.0, 2.0 * np.pi, 61)
_BELOW_VELOCITIES = 0.65  # of the rows of the factor graph
_PLANE = [0, 2]  # the path is in the plane of x and z


def draw_imu_path(experiment: ImuExperiment) -> Figure:
    """Draw the path from the side with ellipses of covariance: of the IMU noise alone, and with the priors."""
    figure = Figure(figsize=(13.0, 6.2), layout="constrained")
    noise, priors = figure.subplots(1, 2, width_ratios=(1.0, 1.3))
    flight = experiment.flight
    _draw_states(noise, experiment)
    initial = experiment.Ts_world_imu_initial[:, _PLANE, 3]
    noise.scatter(
        *initial.T, color=SURROUNDINGS, marker="x", s=40, label=f"initial values, error {experiment.initial_error:.3g}"
    )
    _draw_ellipses(noise, experiment, NOISE_MAGNIFICATION**2 * experiment.noise_covariance_m2)
    sigma_mm = 1e3 * np.sqrt(np.trace(experiment.noise_covariance_m2[-1]))
    noise.set(title=f"IMU noise alone,\n1σ ellipses × {NOISE_MAGNIFICATION}; σ of the last position {sigma_mm:.1f} mm")
    _draw_states(priors, experiment)
    _draw_ellipses(priors, experiment, experiment.covariance_m2)
    priors.set(
        title=f"With the priors on the first state,\n1σ ellipses; σ of the last position {experiment.sigma_m[-1]:.1f} m"
    )
    for axes, place in ((noise, "upper left"), (priors, "lower right")):
        axes.set(xlabel="x [m]", ylabel="z [m]")
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        axes.grid(alpha=0.3)
        axes.legend(loc=place, fontsize="small")
    figure.suptitle(
        f"Dead reckoning on a circle of {flight.radius_m:.2f} m: {len(flight.factor_samples)} IMU factors in "
        f"{experiment.t_s[-1]:.1f} s"
    )
    return figure


def draw_factor_graph(factors: Sequence[GraphFactor]) -> Figure:
    """Draw a factor graph with poses x, velocities v and biases b in three rows.

    Args:
        factors: The factors with their variables, read from the graph.
    """
    names = sorted({name for factor in factors for name in factor.variables})
    positions = {name: _variable_position(name, names) for name in names}
    states = max(int(name[1:]) for name in names) + 1
    figure = Figure(figsize=(1.2 * states + 1.0, 4.4), layout="constrained")
    axes: Axes = figure.add_subplot(111)
    for factor in factors:
        ends = {name: positions[name] for name in factor.variables}
        prior = len(ends) == 1
        centre = _prior_position(ends[factor.variables[0]]) if prior else _motion_position(ends)
        for name, end in ends.items():
            bias = name[0] == "b"
            # An edge to the bias first leads down between the velocities, so that it does not cross one of them.
            below = [np.array([centre[0], _BELOW_VELOCITIES])] if bias and not prior else []
            axes.plot(
                *np.transpose([centre, *below, end]), color=SURROUNDINGS, linewidth=0.8 if bias else 1.3, zorder=1
            )
        axes.plot(*centre, "o" if prior else "s", color="black", markersize=6, zorder=3)
    colours = {"x": ESTIMATE, "v": SIGMA, "b": TRUTH}
    for name, (x, y) in positions.items():
        axes.plot(x, y, "o", markersize=28, markerfacecolor="white", markeredgecolor=colours[name[0]], zorder=2)
        axes.text(x, y, f"${name[0]}_{{{name[1:]}}}$", ha="center", va="center", fontsize=13, zorder=4)
    kinds = [factor.kind for factor in factors]
    marks = {kind: "●" if kind.startswith("Prior") else "■" for kind in kinds}
    lines = "\n".join(f"{mark} {kinds.count(kind)} × {kind}" for kind, mark in marks.items())
    axes.text(1.0, 0.0, lines, transform=axes.transAxes, ha="right", va="bottom", fontsize=8)
    axes.set(xlim=(-0.8, states - 0.5), ylim=(-0.5, 2.5), title="x poses   v velocities   b bias")
    axes.axis("off")
    return figure


def draw_drift(studies: Mapping[str, DriftStudy]) -> Figure:
    """Draw the spread of dead reckoning over time, measured and predicted, and the ratio of both.

    Args:
        studies: One study for each name of an IMU.
    """
    figure = Figure(figsize=(13.0, 5.6), layout="constrained")
    spread, ratio = figure.subplots(1, 2)
    for (name, study), colour in zip(studies.items(), cycle(ESTIMATORS), strict=False):
        spread.plot(study.t_s, study.sigma_m, color=colour, label=name)
        spread.plot(study.t_s[::2], study.rms_m[::2], "o", markersize=3, color=colour)
        ratio.plot(study.t_s, study.ratio, color=colour, label=name)
    spread.set(
        title="Spread of the position: predicted (lines), measured (dots)",
        xlabel="time [s]",
        ylabel="RMS distance from the true position [m]",
        xscale="log",
        yscale="log",
    )
    ratio.axhspan(*RATIO_BOUNDS, color=SURROUNDINGS, alpha=0.15, label="0.8 to 1.25")
    ratio.axhline(1.0, color=SURROUNDINGS, linewidth=0.8)
    ratio.set(title="Ratio of measured to predicted spread", xlabel="time [s]", ylabel="ratio", ylim=(0.6, 1.5))
    for axes in (spread, ratio):
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize="small")
    figure.suptitle(
        f"Dead reckoning with the IMU alone, {len(next(iter(studies.values())).error_m)} flights for each IMU"
    )
    return figure


def draw_camera(study: CameraStudy, name: str) -> Figure:
    """Draw error and standard deviation of the position over time, with and without the camera.

    Args:
        study: Errors and standard deviations.
        name: Name of the IMU.
    """
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    axes: Axes = figure.add_subplot(111)
    runs = len(study.error_m)
    for sensors, colour, rms_m, sigma_m in (
        ("IMU alone", SECOND, study.imu_rms_m, study.imu_sigma_m),
        ("IMU and camera", ESTIMATE, study.rms_m, study.rms_sigma_m),
    ):
        axes.plot(study.t_s, sigma_m, color=colour, label=f"{sensors}: predicted standard deviation")
        axes.plot(study.t_s, rms_m, "o", markersize=4, color=colour, label=f"{sensors}: RMS error of {runs} flights")
    axes.set(xlabel="time [s]", ylabel="position [m]", yscale="log")
    axes.set(title=f"The newest position with the IMU {name}: a camera stops the drift")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize="small")
    return figure


def _draw_states(axes: Axes, experiment: ImuExperiment) -> None:
    """Draw the true path, and the estimated states with their forward and upward axes."""
    estimated = experiment.Ts_world_imu[:, _PLANE, 3]
    axes.plot(*experiment.path_m[:, _PLANE].T, color=TRUTH, label="true path")
    true = experiment.Ts_world_imu_true[:, _PLANE, 3]
    axes.scatter(true[:, 0], true[:, 1], facecolors="none", edgecolors=TRUTH, s=45, zorder=3, label="true states")
    axes.scatter(
        estimated[:, 0],
        estimated[:, 1],
        color=ESTIMATE,
        s=22,
        zorder=4,
        label=f"estimated states, error {experiment.final_error:.1g}",
    )
    for axis in _PLANE:
        tips = estimated + _AXIS_M * experiment.Ts_world_imu[:, _PLANE, axis]
        axes.add_collection(
            LineCollection(list(np.stack([estimated, tips], axis=1)), colors=AXES[axis], linewidths=1.5)
        )
    for i, p in enumerate(estimated):
        x, z = p - _LABEL_OFFSET_M * experiment.Ts_world_imu[i, _PLANE, 2]
        axes.text(x, z, f"$x_{{{i}}}$", color=ESTIMATE, ha="center", va="center")


def _draw_ellipses(axes: Axes, experiment: ImuExperiment, covariances: Array) -> None:
    """Draw the 1σ ellipses of position covariances (K+1, 3, 3) in the plane of the path."""
    for p, P in zip(experiment.Ts_world_imu[:, _PLANE, 3], covariances[:, _PLANE][:, :, _PLANE], strict=True):
        values, vectors = np.linalg.eigh(P)
        half_axes = vectors * np.sqrt(np.maximum(values, 0.0))
        x, z = p[:, None] + half_axes @ np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
        axes.fill(x, z, facecolor=SIGMA, edgecolor=SECOND, alpha=0.25, linewidth=1.0, zorder=1)


def _variable_position(name: str, names: Sequence[str]) -> Array:
    """Return the position (2,) of a variable: the column of its state, or the middle for a bias, and its kind's row."""
    row = {"x": 2.0, "v": 1.0, "b": 0.0}[name[0]]
    states = max(int(other[1:]) for other in names) + 1
    return np.array([0.5 * (states - 1) if name[0] == "b" else float(name[1:]), row])


def _prior_position(variable: Array) -> Array:
    """Return the position (2,) of a factor on one variable (2,): to its left."""
    return variable - [0.42, 0.0]


def _motion_position(ends: Mapping[str, Array]) -> Array:
    """Return the position (2,) of a factor on two states and the bias: the centre of the states."""
    return np.asarray(np.mean([end for name, end in ends.items() if name[0] != "b"], axis=0))
