"""The experiment of section 7.4.1: preintegrated IMU factors between states, and priors on the first state.

The drone flies on a vertical circle (`dronevio.estimator.book.loop`). IMU factors alone connect the states. As many
residuals as unknowns exist, so a solution without any error exists, and Levenberg-Marquardt finds it from distant
initial values. This solution is dead reckoning: it agrees with the measurements exactly, and with the truth only as far
as the measurements do.

Sources: Dellaert and Hutchinson, *Introduction to Robotics*, section 7.4.1; Forster, Carlone, Dellaert, Scaramuzza,
"On-manifold preintegration for real-time visual-inertial odometry", 2017.
"""

from dataclasses import dataclass
from typing import SupportsIndex, SupportsInt

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from dronevio.estimator.book.loop import LoopFlight
from dronevio.estimator.book.optimization import LinearizedGraph, largest_difference, solve_batch, solve_incrementally
from dronevio.estimator.imu.buffer import Increments
from dronevio.models.arrays import Array
from dronevio.models.rotation import pose_matrix

GRAVITY_M_S2 = 9.8
"""Magnitude of gravity in the chapter [m/s²]."""
GYRO_NOISE_DENSITY = np.radians(0.5) / 60.0
"""White noise density of the gyroscope, 0.5 °/√h [rad/s/√Hz]."""
ACCEL_NOISE_DENSITY = 0.1 / 60.0
"""White noise density of the accelerometer, 0.1 m/s/√h [m/s²/√Hz]."""
INTEGRATION_SIGMA = 1e-7
"""Standard deviation of the position error of the integration itself, which is regarded as exact [m/√s]."""
ACCEL_BIAS_M_S2 = (0.0, 0.1, 0.0)
"""(3,) Accelerometer bias, which the prior states correctly [m/s²]."""
PRIOR_SIGMA = 0.1
"""Standard deviation of the priors and of the errors of the initial values [rad, m, m/s and the units of bias]."""

_PATH_POINTS = 200


@dataclass(frozen=True)
class GraphFactor:
    """A factor as the graph contains it."""

    kind: str
    """Name of GTSAM's class, such as ImuFactor."""
    variables: tuple[str, ...]
    """Names of the variables that it connects: x0, x1 and so on for poses, v0 for velocities, b0 for the bias."""


@dataclass(frozen=True)
class ErrorSource:
    """The effect of one prior, or of the IMU noise, on the last position."""

    name: str
    """Name of the source."""
    sigma_m: float
    """Standard deviation of the last position due to this source, the root of the sum over three axes [m]."""


@dataclass(frozen=True, eq=False)
class ImuExperiment:
    """The factor graph and its solution: K + 1 states connected by K IMU factors."""

    flight: LoopFlight
    """Motion, IMU rate and distribution of the samples over the factors."""
    t_s: Array
    """(K+1,) Times of the states, at the end of the samples of each factor [s]."""
    Ts_world_imu_true: Array
    """(K+1, 4, 4) True poses of the IMU."""
    Ts_world_imu_initial: Array
    """(K+1, 4, 4) Initial values of the poses."""
    Ts_world_imu: Array
    """(K+1, 4, 4) Estimated poses of the IMU."""
    velocity_m_s: Array
    """(K+1, 3) Estimated velocities in the world frame [m/s]."""
    covariance_m2: Array
    """(K+1, 3, 3) Marginal covariances of the estimated positions in the world frame [m²]."""
    noise_covariance_m2: Array
    """(K+1, 3, 3) The part of these covariances that is due to the noise of the IMU: those of an exactly known first
    state and bias [m²]."""
    sources: tuple[ErrorSource, ...]
    """Standard deviation of the last position by source; the sum of their squares is that of all together."""
    condition: float
    """Condition number of the whitened Jacobian at the solution."""
    path_m: Array
    """(N, 3) True path at a finer sampling [m]."""
    initial_error: float
    """Error of the graph at the initial values: half the sum of the squared, whitened residuals."""
    final_error: float
    """Error of the graph at the solution."""
    iterations: int
    """Number of iterations of the optimizer."""
    incremental_difference: float
    """Largest difference between the batch solution and that of iSAM2 in local coordinates [rad, m, m/s]."""
    incremental_updates: int
    """Number of updates of iSAM2 until its solution settled."""
    dead_reckoning_difference_m: float
    """Largest distance between a position of the solution and that of integration from the true first state [m]."""
    noise_free_drift_m: float
    """Distance of the last position from the true one when the measurements have no noise: the effect of the IMU's
    sampling [m]."""
    factors: tuple[GraphFactor, ...]
    """All factors of the graph, in its order."""
    dot: str
    """The graph in the DOT language of Graphviz."""

    @property
    def drift_m(self) -> float:
        """Distance between the last estimated position and the true one [m]."""
        return float(np.linalg.norm(self.Ts_world_imu[-1, :3, 3] - self.Ts_world_imu_true[-1, :3, 3]))

    @property
    def sigma_m(self) -> Array:
        """(K+1,) Standard deviations of the positions, the root of the sum over three axes [m]."""
        return np.asarray(np.sqrt(np.trace(self.covariance_m2, axis1=1, axis2=2)))


def run_imu_experiment(rng: np.random.Generator, flight: LoopFlight | None = None) -> ImuExperiment:
    """Simulate the flight, build the factor graph and solve it, both in batch and incrementally.

    Args:
        rng: Random generator of the IMU noise and of the errors of the initial values.
        flight: Motion and IMU rate; those of the chapter if not given.

    Returns:
        The graph with its initial values, its solution and the covariance.
    """
    flight = flight or LoopFlight()
    bias = _bias()
    preintegrated = _preintegrated(flight, bias, simulate_samples(flight, rng))
    graph = _imu_graph(flight, bias, preintegrated)
    initial = _initial_values(flight, bias, rng)
    batch, incremental = solve_batch(graph, initial), solve_incrementally(graph, initial)
    linear = LinearizedGraph.of(graph, batch.values)
    states = len(flight.t_s)
    truth, Ts_world_imu = flight.states(flight.t_s), _poses(batch.values, states)
    reckoned_m = _dead_reckoning(flight, bias, preintegrated)
    noise_free_m = _dead_reckoning(flight, bias, _preintegrated(flight, bias, simulate_samples(flight, None)))
    return ImuExperiment(
        flight=flight,
        t_s=flight.t_s,
        Ts_world_imu_true=pose_matrix(truth.R_world_imu, truth.p_world_imu),
        Ts_world_imu_initial=_poses(initial, states),
        Ts_world_imu=Ts_world_imu,
        velocity_m_s=np.stack([batch.values.atVector(V(i)) for i in range(states)]),
        covariance_m2=_position_covariances(linear, Ts_world_imu, slice(0, linear.residuals[-1].stop)),
        noise_covariance_m2=_position_covariances(linear, Ts_world_imu, _imu_residuals(linear)),
        sources=_sources(linear, states - 1),
        condition=linear.condition,
        path_m=flight.states(np.linspace(0.0, flight.duration_s, _PATH_POINTS)).p_world_imu,
        initial_error=graph.error(initial),
        final_error=graph.error(batch.values),
        iterations=batch.iterations,
        incremental_difference=largest_difference(batch.values, incremental.values),
        incremental_updates=incremental.updates,
        dead_reckoning_difference_m=float(np.linalg.norm(Ts_world_imu[:, :3, 3] - reckoned_m, axis=1).max()),
        noise_free_drift_m=float(np.linalg.norm(noise_free_m[-1] - truth.p_world_imu[-1])),
        factors=tuple(map(_factor, (graph.at(i) for i in range(graph.size())))),
        dot=graph.dot(batch.values, _name),
    )


def simulate_samples(flight: LoopFlight, rng: np.random.Generator | None) -> Increments:
    """Return the IMU samples of all factors, one after another.

    A sample is held until the next one: it contains the angular velocity and the specific force at the start of its
    interval, with the accelerometer bias and white noise.

    Args:
        flight: Motion, IMU rate and number of samples.
        rng: Random generator of the noise; without one the samples have no noise.
    """
    bias, scenario, dt_s = _bias(), flight.scenario, flight.dt_s  # the runner only refers to the scenario
    runner = gtsam.ScenarioRunner(scenario, _preintegration_params(), dt_s, bias)
    gyro_rad_s, accel_m_s2 = [], []
    for sample in range(sum(flight.factor_samples)):
        t_s = sample * dt_s
        gyro_noise, accel_noise = np.zeros((2, 3)) if rng is None else rng.standard_normal((2, 3)) / np.sqrt(dt_s)
        gyro_rad_s.append(runner.actualAngularVelocity(t_s) + bias.gyroscope() + GYRO_NOISE_DENSITY * gyro_noise)
        accel_m_s2.append(runner.actualSpecificForce(t_s) + bias.accelerometer() + ACCEL_NOISE_DENSITY * accel_noise)
    return Increments(np.full(len(gyro_rad_s), dt_s), np.array(gyro_rad_s), np.array(accel_m_s2))


def _bias() -> gtsam.imuBias.ConstantBias:
    return gtsam.imuBias.ConstantBias(ACCEL_BIAS_M_S2, [0.0, 0.0, 0.0])


def _preintegration_params() -> gtsam.PreintegrationParams:
    params = gtsam.PreintegrationParams.MakeSharedU(GRAVITY_M_S2)
    params.setGyroscopeCovariance(GYRO_NOISE_DENSITY**2 * np.eye(3))
    params.setAccelerometerCovariance(ACCEL_NOISE_DENSITY**2 * np.eye(3))
    params.setIntegrationCovariance(INTEGRATION_SIGMA**2 * np.eye(3))
    return params


def _preintegrated(
    flight: LoopFlight, bias: gtsam.imuBias.ConstantBias, samples: Increments
) -> list[gtsam.PreintegratedImuMeasurements]:
    """Return the preintegrated measurements of each factor."""
    params, preintegrated, sample = _preintegration_params(), [], 0
    for count in flight.factor_samples:
        pim = gtsam.PreintegratedImuMeasurements(params, bias)
        for i in range(sample, sample + count):
            pim.integrateMeasurement(samples.accel_m_s2[i], samples.gyro_rad_s[i], flight.dt_s)
        preintegrated.append(pim)
        sample += count
    return preintegrated


def _imu_graph(
    flight: LoopFlight,
    bias: gtsam.imuBias.ConstantBias,
    preintegrated: list[gtsam.PreintegratedImuMeasurements],
) -> gtsam.NonlinearFactorGraph:
    """Return the graph: priors on the first state and the bias, and the IMU factors."""
    graph, start = gtsam.NonlinearFactorGraph(), flight.scenario.navState(0.0)
    graph.addPriorPose3(X(0), start.pose(), gtsam.noiseModel.Isotropic.Sigma(6, PRIOR_SIGMA))
    graph.addPriorVector(V(0), start.velocity(), gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_SIGMA))
    graph.addPriorConstantBias(B(0), bias, gtsam.noiseModel.Isotropic.Sigma(6, PRIOR_SIGMA))
    for i, pim in enumerate(preintegrated):
        graph.push_back(gtsam.ImuFactor(X(i), V(i), X(i + 1), V(i + 1), B(0), pim))
    return graph


def _initial_values(flight: LoopFlight, bias: gtsam.imuBias.ConstantBias, rng: np.random.Generator) -> gtsam.Values:
    """Return the true first state and bias, and all later states at their nominal times with Gaussian errors."""
    values, scenario = gtsam.Values(), flight.scenario
    values.insert(B(0), bias)
    for i, t_s in enumerate(flight.nominal_t_s.tolist()):
        state = scenario.navState(t_s)
        error = np.zeros(9) if i == 0 else rng.normal(scale=PRIOR_SIGMA, size=9)
        values.insert(X(i), state.pose().retract(error[:6]))
        values.insert(V(i), state.velocity() + error[6:])
    return values


def _dead_reckoning(
    flight: LoopFlight,
    bias: gtsam.imuBias.ConstantBias,
    preintegrated: list[gtsam.PreintegratedImuMeasurements],
) -> Array:
    """Return the positions (K+1, 3) that follow from the true first state by integration [m]."""
    state = flight.scenario.navState(0.0)
    positions = [state.position()]
    for pim in preintegrated:
        state = pim.predict(state, bias)
        positions.append(state.position())
    return np.stack(positions)


def _position_covariances(linear: LinearizedGraph, Ts_world_imu: Array, residuals: slice) -> Array:
    """Return the covariances (K+1, 3, 3) of all positions due to some residuals, in the world frame [m²].

    GTSAM's perturbation of a position is in the body frame.
    """
    response = np.stack([linear.response[linear.columns[X(i)]][3:, residuals] for i in range(len(Ts_world_imu))])
    response = Ts_world_imu[:, :3, :3] @ response
    return np.asarray(response @ response.swapaxes(1, 2))


def _imu_residuals(linear: LinearizedGraph) -> slice:
    """Return the columns of the residuals of all IMU factors, which follow those of the three priors."""
    return slice(linear.residuals[3].start, linear.residuals[-1].stop)


def _sources(linear: LinearizedGraph, state: int) -> tuple[ErrorSource, ...]:
    """Return the standard deviation of the position of a state by source.

    GTSAM orders a pose as rotation and position, and a bias as accelerometer and gyroscope.
    """
    response = linear.response[linear.columns[X(state)]][3:]
    pose, velocity, bias = (linear.residuals[i].start for i in range(3))
    columns = {
        "initial orientation": slice(pose, pose + 3),
        "initial position": slice(pose + 3, pose + 6),
        "initial velocity": slice(velocity, velocity + 3),
        "accelerometer bias": slice(bias, bias + 3),
        "gyroscope bias": slice(bias + 3, bias + 6),
        "IMU noise": _imu_residuals(linear),
    }
    return tuple(ErrorSource(name, float(np.linalg.norm(response[:, part]))) for name, part in columns.items())


def _poses(values: gtsam.Values, count: int) -> Array:
    return np.stack([values.atPose3(X(i)).matrix() for i in range(count)])


def _factor(factor: gtsam.NonlinearFactor) -> GraphFactor:
    """Return the class of a factor and the names of its variables."""
    return GraphFactor(type(factor).__name__, tuple(map(_name, factor.keys())))


def _name(key: SupportsInt | SupportsIndex) -> str:
    """Return a variable's name, such as x3."""
    symbol = gtsam.Symbol(int(key))
    return f"{chr(symbol.chr())}{symbol.index()}"
