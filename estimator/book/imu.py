"""Dead reckoning as a factor graph: IMU samples, summed up between states, and a prior on the first of them.

The drone flies a loop: its velocity and its turn rate are constant in its own frame. Nothing but the IMU ties the
states together, so a solution without any error exists, and Levenberg-Marquardt finds it from states far off.

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
"""White noise of the gyroscope [rad/s/√Hz]: 0.5 °/√h."""
ACCEL_NOISE_DENSITY = 0.1 / 60.0
"""White noise of the accelerometer [m/s²/√Hz]: 0.1 m/s/√h."""
ACCEL_BIAS_M_S2 = (0.0, 0.1, 0.0)
"""The accelerometer's bias, which the estimator is told [m/s²]."""
PRIOR_SIGMA = 0.1
"""How sure the priors are, and how far off the first guess is [rad, m, m/s and the units of bias]."""

_INTEGRATION_SIGMA = 1e-7  # [m/√s]: the sum itself is taken to be exact
_PATH_POINTS = 200


@dataclass(frozen=True)
class LoopFlight:
    """What is flown and how it is measured."""

    speed_m_s: float = 2.0
    """Speed, straight ahead along the body's x [m/s]."""
    pitch_rate_rad_s: float = float(np.radians(30.0))
    """Rate at which the nose goes up [rad/s]."""
    duration_s: float = 3.5
    """Length of the flight [s]."""
    imu_rate_hz: float = 10.0
    """Rate of the IMU [Hz]."""
    samples_per_factor: int = 5
    """IMU samples from one state to the next."""

    @property
    def scenario(self) -> gtsam.ConstantTwistScenario:
        """The motion as GTSAM has it: with y to the left, the nose rises with a negative turn about y."""
        return gtsam.ConstantTwistScenario([0.0, -self.pitch_rate_rad_s, 0.0], [self.speed_m_s, 0.0, 0.0])

    @property
    def radius_m(self) -> float:
        """The radius of the loop, v/ω [m]."""
        return self.speed_m_s / self.pitch_rate_rad_s

    @property
    def factors(self) -> int:
        """How many IMU factors the flight's samples make."""
        return round(self.duration_s * self.imu_rate_hz) // self.samples_per_factor


@dataclass(frozen=True, eq=False)
class ImuExperiment:
    """The graph and its solution, K + 1 states tied by K IMU factors."""

    flight: LoopFlight
    """What was flown."""
    t_s: Array
    """(K+1,) Times of the states [s]."""
    Ts_world_imu_true: Array
    """(K+1, 4, 4) True poses."""
    Ts_world_imu_initial: Array
    """(K+1, 4, 4) The optimizer's first guess."""
    Ts_world_imu: Array
    """(K+1, 4, 4) Poses found."""
    velocity_m_s: Array
    """(K+1, 3) Velocities found, in the world [m/s]."""
    path_m: Array
    """(N, 3) The true path, finely sampled [m]."""
    initial_error: float
    """Error of the graph at the first guess: half the sum of the squared, whitened residuals."""
    final_error: float
    """Error of the graph at the solution."""
    iterations: int
    """Steps that the optimizer took."""
    factors: tuple[tuple[str, ...], ...]
    """The graph: the variables that each factor ties, by name: x0 … (poses), v0 … (velocities), b0 (bias)."""
    dot: str
    """The graph in Graphviz's language."""

    @property
    def drift_m(self) -> float:
        """Distance between the last pose found and the truth [m]."""
        return float(np.linalg.norm(self.Ts_world_imu[-1, :3, 3] - self.Ts_world_imu_true[-1, :3, 3]))


def run_imu_experiment(rng: np.random.Generator, flight: LoopFlight | None = None) -> ImuExperiment:
    """Fly the loop, build the graph and solve it.

    Args:
        rng: Makes the noise of the IMU and the errors of the first guess.
        flight: What to fly; the chapter's loop if not given.

    Returns:
        The graph before and after.
    """
    flight = flight or LoopFlight()
    bias = gtsam.imuBias.ConstantBias(ACCEL_BIAS_M_S2, [0.0, 0.0, 0.0])
    graph = _imu_graph(flight, bias, rng)
    truth = [flight.scenario.navState(t) for t in _state_times_s(flight)]
    initial = _first_guess(truth, bias, rng)
    params = gtsam.LevenbergMarquardtParams()
    # The whitened equations differ by six powers of ten: QR solves them, Cholesky squares the difference and stalls.
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
    """Return the priors on the first state and the bias, and one IMU factor after every few samples."""
    params = gtsam.PreintegrationParams.MakeSharedU(GRAVITY_M_S2)
    params.setGyroscopeCovariance(GYRO_NOISE_DENSITY**2 * np.eye(3))
    params.setAccelerometerCovariance(ACCEL_NOISE_DENSITY**2 * np.eye(3))
    params.setIntegrationCovariance(_INTEGRATION_SIGMA**2 * np.eye(3))
    dt_s = 1.0 / flight.imu_rate_hz
    scenario = flight.scenario  # the runner only borrows it: it must outlive the runner
    runner = gtsam.ScenarioRunner(scenario, params, dt_s, bias)

    graph = gtsam.NonlinearFactorGraph()
    start = scenario.navState(0.0)
    graph.addPriorPose3(X(0), start.pose(), gtsam.noiseModel.Isotropic.Sigma(6, PRIOR_SIGMA))
    graph.addPriorVector(V(0), start.velocity(), gtsam.noiseModel.Isotropic.Sigma(3, PRIOR_SIGMA))
    graph.addPriorConstantBias(B(0), bias, gtsam.noiseModel.Isotropic.Sigma(6, PRIOR_SIGMA))
    pim = gtsam.PreintegratedImuMeasurements(params, bias)
    for factor in range(flight.factors):
        for sample in range(flight.samples_per_factor):
            # GTSAM holds a sample until the next one, turned as the body was when it was taken.
            t_s = (factor * flight.samples_per_factor + sample) * dt_s
            gyro_noise, accel_noise = rng.standard_normal((2, 3)) / np.sqrt(dt_s)
            gyro_rad_s = runner.actualAngularVelocity(t_s) + bias.gyroscope() + GYRO_NOISE_DENSITY * gyro_noise
            accel_m_s2 = runner.actualSpecificForce(t_s) + bias.accelerometer() + ACCEL_NOISE_DENSITY * accel_noise
            pim.integrateMeasurement(accel_m_s2, gyro_rad_s, dt_s)
        graph.push_back(gtsam.ImuFactor(X(factor), V(factor), X(factor + 1), V(factor + 1), B(0), pim))
        pim.resetIntegration()
    return graph


def _first_guess(
    truth: list[gtsam.NavState], bias: gtsam.imuBias.ConstantBias, rng: np.random.Generator
) -> gtsam.Values:
    """Return the true first state and bias, and all later states off by Gaussian errors."""
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
