"""Dead reckoning as a factor graph: preintegrated IMU factors between states, and a prior on the first state.

The drone flies a loop with constant velocity and constant angular velocity in the body frame. Only IMU factors connect
the states, so a solution with zero error exists, and Levenberg-Marquardt finds it from distant initial values.

Sources: Dellaert and Hutchinson, *Introduction to Robotics*, section 7.4.1; Forster, Carlone, Dellaert, Scaramuzza,
"On-manifold preintegration for real-time visual-inertial odometry", 2017.
"""

from dataclasses import dataclass
from typing import SupportsIndex, SupportsInt

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import B, V, X

Array = npt.NDArray[np.float64]

GRAVITY_M_S2 = 9.8
"""Magnitude of gravity in the chapter [m/s²]."""
GYRO_NOISE_DENSITY = np.radians(0.5) / 60.0
"""White noise density of the gyroscope, 0.5 °/√h [rad/s/√Hz]."""
ACCEL_NOISE_DENSITY = 0.1 / 60.0
"""White noise density of the accelerometer, 0.1 m/s/√h [m/s²/√Hz]."""
ACCEL_BIAS_M_S2 = (0.0, 0.1, 0.0)
"""(3,) Accelerometer bias, known to the estimator [m/s²]."""
PRIOR_SIGMA = 0.1
"""Standard deviation of the priors and of the errors of the initial values [rad, m, m/s and the units of bias]."""

_INTEGRATION_SIGMA = 1e-7  # integration is regarded as exact [m/√s]
_PATH_POINTS = 200


@dataclass(frozen=True)
class LoopFlight:
    """Motion of the drone and rate of its IMU."""

    speed_m_s: float = 2.0
    """Forward speed along the x axis of the body frame [m/s]."""
    pitch_rate_rad_s: float = float(np.radians(30.0))
    """Rate at which the nose rises [rad/s]."""
    duration_s: float = 3.5
    """Duration of the flight [s]."""
    imu_rate_hz: float = 10.0
    """Sampling rate of the IMU [Hz]."""
    samples_per_factor: int = 5
    """Number of IMU samples in each IMU factor."""

    @property
    def scenario(self) -> gtsam.ConstantTwistScenario:
        """The motion as a GTSAM scenario; with y to the left, the nose rises with a negative rotation about y."""
        return gtsam.ConstantTwistScenario([0.0, -self.pitch_rate_rad_s, 0.0], [self.speed_m_s, 0.0, 0.0])

    @property
    def radius_m(self) -> float:
        """Radius of the loop, v/ω [m]."""
        return self.speed_m_s / self.pitch_rate_rad_s

    @property
    def factors(self) -> int:
        """Number of IMU factors."""
        return round(self.duration_s * self.imu_rate_hz) // self.samples_per_factor


@dataclass(frozen=True, eq=False)
class ImuExperiment:
    """The factor graph and its solution: K + 1 states connected by K IMU factors."""

    flight: LoopFlight
    """Motion and IMU rate of the experiment."""
    t_s: Array
    """(K+1,) Times of the states [s]."""
    Ts_world_imu_true: Array
    """(K+1, 4, 4) True poses of the IMU."""
    Ts_world_imu_initial: Array
    """(K+1, 4, 4) Initial values of the poses."""
    Ts_world_imu: Array
    """(K+1, 4, 4) Estimated poses of the IMU."""
    velocity_m_s: Array
    """(K+1, 3) Estimated velocities in the world frame [m/s]."""
    path_m: Array
    """(N, 3) True path at a finer sampling [m]."""
    initial_error: float
    """Error of the graph at the initial values: half the sum of the squared, whitened residuals."""
    final_error: float
    """Error of the graph at the solution."""
    iterations: int
    """Number of iterations of the optimizer."""
    factors: tuple[tuple[str, ...], ...]
    """Names of the variables that each factor connects: x0, x1 and so on for poses, v0 for velocities, b0 for the
    bias."""
    dot: str
    """The graph in the DOT language of Graphviz."""

    @property
    def drift_m(self) -> float:
        """Distance between the last estimated position and the true one [m]."""
        return float(np.linalg.norm(self.Ts_world_imu[-1, :3, 3] - self.Ts_world_imu_true[-1, :3, 3]))


def run_imu_experiment(rng: np.random.Generator, flight: LoopFlight | None = None) -> ImuExperiment:
    """Simulate the flight, build the factor graph and optimize it.

    Args:
        rng: Random generator of the IMU noise and of the errors of the initial values.
        flight: Motion and IMU rate; those of the chapter if not given.

    Returns:
        The graph with its initial values and its solution.
    """
    flight = flight or LoopFlight()
    bias = gtsam.imuBias.ConstantBias(ACCEL_BIAS_M_S2, [0.0, 0.0, 0.0])
    graph = _imu_graph(flight, bias, rng)
    truth = [flight.scenario.navState(t) for t in _state_times_s(flight)]
    initial = _initial_values(truth, bias, rng)
    params = gtsam.LevenbergMarquardtParams()
    # The whitened equations differ by a factor of 1e6, which Cholesky squares; QR converges, Cholesky does not.
    params.setLinearSolverType("MULTIFRONTAL_QR")
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, initial, params)
    result = optimizer.optimize()
    fine_s = np.linspace(0.0, flight.duration_s, _PATH_POINTS)
    return ImuExperiment(
        flight=flight,
        t_s=_state_times_s(flight),
        Ts_world_imu_true=np.stack([state.pose().matrix() for state in truth]),
        Ts_world_imu_initial=_poses(initial, len(truth)),
        Ts_world_imu=_poses(result, len(truth)),
        velocity_m_s=np.stack([result.atVector(V(i)) for i in range(len(truth))]),
        path_m=np.stack([flight.scenario.pose(t).translation() for t in fine_s]),
        initial_error=graph.error(initial),
        final_error=graph.error(result),
        iterations=optimizer.iterations(),
        factors=tuple(tuple(map(_name, graph.at(i).keys())) for i in range(graph.size())),
        dot=graph.dot(result, _name),
    )


def _imu_graph(
    flight: LoopFlight, bias: gtsam.imuBias.ConstantBias, rng: np.random.Generator
) -> gtsam.NonlinearFactorGraph:
    """Return the graph: priors on the first state and the bias, and the IMU factors."""
    params = gtsam.PreintegrationParams.MakeSharedU(GRAVITY_M_S2)
    params.setGyroscopeCovariance(GYRO_NOISE_DENSITY**2 * np.eye(3))
    params.setAccelerometerCovariance(ACCEL_NOISE_DENSITY**2 * np.eye(3))
    params.setIntegrationCovariance(_INTEGRATION_SIGMA**2 * np.eye(3))
    dt_s = 1.0 / flight.imu_rate_hz
    scenario = flight.scenario  # the runner keeps a reference only, so this has to outlive it
    runner = gtsam.ScenarioRunner(scenario, params, dt_s, bias)

    graph = gtsam.NonlinearFactorGraph()
    start = scenario.navState(0.0)
    graph.addPriorPose3(X(0), start.pose(), gtsam.noiseModel.Isotropic.Sigma(6, PRIOR_SIGMA))
    graph.addPriorVector(V(0), start.velocity(), gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_SIGMA))
    graph.addPriorConstantBias(B(0), bias, gtsam.noiseModel.Isotropic.Sigma(6, PRIOR_SIGMA))
    pim = gtsam.PreintegratedImuMeasurements(params, bias)
    for factor in range(flight.factors):
        for sample in range(flight.samples_per_factor):
            # GTSAM holds a sample until the next one, in the body frame at its time.
            t_s = (factor * flight.samples_per_factor + sample) * dt_s
            gyro_noise, accel_noise = rng.standard_normal((2, 3)) / np.sqrt(dt_s)
            gyro_rad_s = runner.actualAngularVelocity(t_s) + bias.gyroscope() + GYRO_NOISE_DENSITY * gyro_noise
            accel_m_s2 = runner.actualSpecificForce(t_s) + bias.accelerometer() + ACCEL_NOISE_DENSITY * accel_noise
            pim.integrateMeasurement(accel_m_s2, gyro_rad_s, dt_s)
        graph.push_back(gtsam.ImuFactor(X(factor), V(factor), X(factor + 1), V(factor + 1), B(0), pim))
        pim.resetIntegration()
    return graph


def _initial_values(
    truth: list[gtsam.NavState], bias: gtsam.imuBias.ConstantBias, rng: np.random.Generator
) -> gtsam.Values:
    """Return the true first state and bias, and all later states with Gaussian errors."""
    values = gtsam.Values()
    values.insert(B(0), bias)
    for i, state in enumerate(truth):
        error = np.zeros(9) if i == 0 else rng.normal(scale=PRIOR_SIGMA, size=9)
        values.insert(X(i), state.pose().retract(error[:6]))
        values.insert(V(i), state.velocity() + error[6:])
    return values


def _state_times_s(flight: LoopFlight) -> Array:
    return np.arange(flight.factors + 1) * flight.samples_per_factor / flight.imu_rate_hz


def _poses(values: gtsam.Values, count: int) -> Array:
    return np.stack([values.atPose3(X(i)).matrix() for i in range(count)])


def _name(key: SupportsInt | SupportsIndex) -> str:
    """Return a variable's name, such as x3."""
    symbol = gtsam.Symbol(int(key))
    return f"{chr(symbol.chr())}{symbol.index()}"
