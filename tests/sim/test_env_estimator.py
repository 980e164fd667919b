"""Estimators inside environments: what is perceived, latency, the wait, darkness, losses, errors, and the tasks."""

import pickle
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env, data_equivalence

import dronevio.envs  # noqa: F401 registers
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.quadrotor import RESEARCH
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.rotation import exp_so3, matrix_from_quat_wxyz, pose_matrix, rotation_z
from dronevio.models.state import CameraFrame, Estimate, Health, HealthReport, NavState, Trajectory
from dronevio.sim.envs.episodes.distributions import Constant
from dronevio.sim.envs.episodes.randomization import Randomization
from dronevio.sim.envs.policies.goal_flight import fly_to_goal
from dronevio.sim.envs.sensing.estimation import CameraSetup, Estimation
from dronevio.sim.envs.single import DroneEnv
from dronevio.sim.envs.tasks import Transition, VioHover, VioNavigate
from dronevio.sim.envs.vector import DroneVectorEnv
from dronevio.sim.physics.vehicle_states import VehicleStates
from dronevio.sim.world import flight_area

Array = np.ndarray

STATE = ("position", "height", "orientation", "rotation", "velocity", "body_velocity", "rate", "goals")
BIAS = np.array([0.01, -0.02, 0.03, 0.1, -0.2, 0.3])
VARIANCE = np.diag(np.arange(1.0, 16.0) * 1e-4)
UP = np.array([0.0, 0.0, 0.5, 0.0])
RATE = np.array([0.1, 0.2, -0.3])
VELOCITY = np.array([0.3, -0.2, 0.1])


@dataclass
class Cameras:
    """Cameras without images, which record what is asked of them."""

    setup: CameraSetup
    lit: list[tuple[int, bool]] = field(default_factory=list)
    closed: bool = False

    def ready_ns(self, exposed_ns: int) -> int:
        return exposed_ns + 2_000_000

    def frame(self, t_ns: int, exposed_ns: int, lit: bool, truth: Trajectory) -> CameraFrame:
        assert truth.t_ns[0] <= max(exposed_ns - 5_000_000, 0) and truth.t_ns[-1] >= exposed_ns + 2_000_000
        self.lit.append((t_ns, lit))
        return CameraFrame(t_ns, (np.zeros((4, 4), np.uint8),))

    def close(self) -> None:
        self.closed = True


class Scripted:
    """An estimator whose state does not depend on the measurements: a slow motion from a tilted pose of its own."""

    def __init__(self, rig: Rig, from_ns: int = 300_000_000, lost_ns: int = 10**15, moves: bool = True) -> None:
        self.rig, self.from_ns, self.lost_ns, self.moves = rig, from_ns, lost_ns, moves
        self.imu_ns: list[int] = []
        self.frames: list[tuple[int, int]] = []  # time stamp, and time of the newest IMU sample
        self.T_first = pose_matrix(rotation_z(2.0) @ exp_so3(np.array([0.02, -0.01, 0.0])), np.array([5.0, 6.0, 7.0]))
        self.T_first = self.T_first @ rig.T_vehicle_imu

    def add_imu(self, samples: ImuSamples) -> None:
        self.imu_ns += samples.t_ns.tolist()

    def add_frame(self, frame: CameraFrame) -> Estimate:
        self.frames.append((frame.t_ns, self.imu_ns[-1]))
        state = None if frame.t_ns >= self.lost_ns else self.state_at(frame.t_ns)
        health = Health.TRACKING if state else Health.LOST if self.frames[-1][0] > self.from_ns else Health.INITIALIZING
        report = HealthReport(health, "as scripted", landmarks=0 if state is None else 17)
        state = state and replace(state, covariance=VARIANCE)
        return Estimate(frame.t_ns, health, state, health_report=report)

    def state_at(self, t_ns: int) -> NavState | None:
        if not self.frames or self.frames[-1][0] < self.from_ns:
            return None
        since_s = max(t_ns - self.from_ns, 0) * 1e-9 * self.moves
        T = self.T_first.copy()
        T[:3, 3] += since_s * VELOCITY
        return NavState(t_ns, T, self.moves * VELOCITY, BIAS[:3], BIAS[3:], angular_velocity_rad_s=self.moves * RATE)


def scripted_env(
    make: Callable[[Rig], Scripted] = Scripted, estimation: dict[str, Any] | None = None, **settings: Any
) -> tuple[DroneEnv, list[Scripted], list[Cameras]]:
    """Return an environment with a scripted estimator, and lists of the estimators and cameras that it makes."""
    estimators: list[Scripted] = []
    cameras: list[Cameras] = []

    def estimator(rig: Rig) -> Scripted:
        estimators.append(make(rig))
        return estimators[-1]

    def source(setup: CameraSetup) -> Cameras:
        cameras.append(Cameras(setup))
        return cameras[-1]

    task = settings.pop("task", VioHover())
    loop = Estimation(cameras=source, **(estimation or {}))
    return DroneEnv(task, estimator=estimator, estimation=loop, **settings), estimators, cameras


# --- what is perceived


def test_the_policy_sees_the_estimate_and_the_critic_the_truth() -> None:
    env, *_ = scripted_env(observations=(*STATE, "imu_bias", "battery"), privileged=(*STATE, "imu_bias"))
    env.reset(seed=0)
    for _ in range(3):
        observation, *_, info = env.step(np.array([0.0, 0.0, 0.4, 0.0]))
    seen, true = observation["policy"], observation["critic"]
    estimate, truth = info["estimate"], info["truth"]
    area = flight_area("room", 0)
    standing = env._core.plant.standing_height_m
    goal = area.pad + [0.0, 0.0, 0.5 * info["t_ns"] * 1e-9]
    # worked out from the script: yaw and position of the first state are those of the pad
    turn = exp_so3(np.array([0.02, -0.01, 0.0]))
    since_s = info["t_ns"] * 1e-9 + env._core._episode.begun_ns[0] * 1e-9 - 0.3
    expected_R = rotation_z(0.0) @ turn
    np.testing.assert_allclose(matrix_from_quat_wxyz(estimate["quat_wxyz"]), expected_R, atol=2e-4)
    velocity = rotation_z(-2.0) @ VELOCITY
    rate = env.settings.rig.T_vehicle_imu[:3, :3] @ RATE
    np.testing.assert_allclose(seen["rate"], rate, atol=1e-6)
    at_centre = velocity - expected_R @ np.cross(rate, env.settings.rig.T_vehicle_imu[:3, 3])
    np.testing.assert_allclose(seen["velocity"], at_centre, atol=2e-4)
    lever = (expected_R - np.eye(3)) @ env.settings.rig.T_vehicle_imu[:3, 3]
    placed_s = since_s - (env._core._episode.begun_ns[0] * 1e-9 - 0.3)  # the frame is placed at the first state
    at = area.pad + [0.0, 0.0, standing] - lever + placed_s * velocity
    np.testing.assert_allclose(estimate["position_m"], at, atol=1e-4)
    np.testing.assert_allclose(seen["position"], at - goal, atol=1e-4)
    np.testing.assert_allclose(seen["height"], [at[2] - area.pad[2]], atol=1e-4)
    np.testing.assert_allclose(seen["goals"][0], expected_R.T @ (goal - at), atol=2e-4)
    np.testing.assert_allclose(seen["body_velocity"], expected_R.T @ at_centre, atol=2e-4)
    np.testing.assert_allclose(seen["imu_bias"], BIAS, atol=1e-7)
    # the truth is a vehicle that has not taken off yet
    np.testing.assert_allclose(truth["position_m"], area.pad + [0.0, 0.0, standing], atol=2e-3)
    np.testing.assert_allclose(true["position"], truth["position_m"] - goal, atol=1e-6)
    np.testing.assert_allclose(true["rotation"], np.eye(3), atol=1e-3)
    assert not np.allclose(true["imu_bias"], BIAS, atol=1e-3)
    assert info["position_error_m"] == pytest.approx(np.linalg.norm(at - truth["position_m"]), abs=1e-3)
    assert info["orientation_error_rad"] == pytest.approx(np.hypot(0.02, 0.01), abs=1e-3)


def test_the_truth_does_not_leak_into_observations() -> None:
    """Vehicles of different mass in different winds have different motions but the same scripted estimate."""
    runs, heights = [], []
    for mass, gusts in ((1.0, 0.0), (0.6, 3.0)):
        drawn = Randomization(mass=Constant(mass), wind_m_s=Constant(gusts))
        env, *_ = scripted_env(observations=STATE, randomization=drawn)
        observations = [env.reset(seed=0)[0]]
        for _ in range(25):
            observation, *_, info = env.step(np.array([0.1, 0.0, 1.0, 0.1]))
            observations.append(observation)
        runs.append(observations)
        heights.append(info["truth"]["position_m"])
    assert np.linalg.norm(heights[0] - heights[1]) > 0.02
    for first, second in zip(*runs, strict=True):
        for name in STATE:
            np.testing.assert_array_equal(first[name], second[name])


def test_inner_loops_fly_the_estimate() -> None:
    """An estimator that reports a descent makes the vehicle climb, although hover is commanded."""
    env, *_ = scripted_env(Descending)
    env.reset(seed=0)
    for _ in range(75):
        *_, terminated, _, info = env.step(np.zeros(4))
        if terminated:
            break
    assert info["truth"]["position_m"][2] > 0.3


class Descending(Scripted):
    """An estimator that reports a constant pose and a descent."""

    def state_at(self, t_ns: int) -> NavState | None:
        state = super().state_at(t_ns)
        return state and replace(
            state,
            T_world_imu=pose_matrix(self.rig.T_vehicle_imu[:3, :3], np.zeros(3)),
            velocity_m_s=np.array([0.0, 0.0, -1.0]),
            angular_velocity_rad_s=np.zeros(3),
        )


# --- the loop


@pytest.mark.parametrize("latency_s", [0.0, 0.03, 0.12])
def test_frames_arrive_with_latency_and_samples_at_once(latency_s: float) -> None:
    env, estimators, _ = scripted_env(estimation={"latency_s": latency_s})
    env.reset(seed=0)
    env.step(np.zeros(4))
    (estimator,) = estimators
    stamps, arrivals = np.array(estimator.frames).T
    np.testing.assert_array_equal(np.diff(estimator.imu_ns), 5_000_000)
    np.testing.assert_array_equal(stamps, 50_000_000 * np.arange(len(stamps)))
    delay_s = (arrivals - stamps) * 1e-9
    earliest_s = max(latency_s, 0.002)  # the exposure has to end
    assert np.all(delay_s >= earliest_s - 1e-9) and np.all(delay_s < earliest_s + 0.005)


def test_a_reset_waits_on_the_pad_for_the_first_state() -> None:
    env, estimators, cameras = scripted_env()
    for _ in range(2):
        _, info = env.reset(seed=3)
        assert info["t_ns"] == 0 and info["health"] == "tracking" and info["landmarks"] == 17
        assert estimators[-1].imu_ns[-1] == 330_000_000  # the frame of 0.3 s, and the latency
        assert info["propagated_s"] == pytest.approx(0.03) and info["waited_s"] == pytest.approx(0.33)
        np.testing.assert_array_equal(info["covariance"], VARIANCE)
        np.testing.assert_array_equal(env._core.states.rotor_speed_rad_s, 0.0)
    *_, info = env.step(np.zeros(4))
    assert info["t_ns"] == 20_000_000
    assert [source.closed for source in cameras] == [True, False]
    env.close()
    assert cameras[1].closed


def test_an_estimator_without_state_ends_the_episode() -> None:
    env, estimators, _ = scripted_env(lambda rig: Scripted(rig, from_ns=10**12), {"longest_wait_s": 0.5})
    _, info = env.reset(seed=0)
    assert estimators[0].imu_ns[-1] == 500_000_000 and info["health"] == "initializing"
    _, reward, terminated, truncated, info = env.step(np.zeros(4))
    assert terminated and not truncated and info["termination"].text == "no estimate" and not info["success"]
    assert float(reward) < -90.0


def test_a_lost_state_is_propagated() -> None:
    env, *_ = scripted_env(lambda rig: Scripted(rig, lost_ns=400_000_000))
    env.reset(seed=0)
    infos = [env.step(np.zeros(4))[-1] for _ in range(20)]
    assert infos[0]["health"] == "tracking" and infos[-1]["health"] == "lost"
    assert infos[-1]["health_reason"] == "as scripted" and infos[-1]["landmarks"] == 0
    assert infos[-1]["propagated_s"] == pytest.approx(0.33 + 0.4 - 0.35)
    np.testing.assert_array_equal(infos[-1]["covariance"], VARIANCE)
    moved = infos[-1]["estimate"]["position_m"] - infos[-2]["estimate"]["position_m"]
    np.testing.assert_allclose(moved, 0.02 * rotation_z(-2.0) @ VELOCITY, atol=1e-6)


def test_an_estimate_that_is_not_finite_is_not_used() -> None:
    class Failing(Scripted):
        def state_at(self, t_ns: int) -> NavState | None:
            state = super().state_at(t_ns)
            failed = state is not None and t_ns > 350_000_000
            return replace(state, T_world_imu=np.full((4, 4), np.nan)) if failed and state else state

    env, *_ = scripted_env(Failing, observations=STATE)
    env.reset(seed=0)
    observation, *_ = env.step(np.zeros(4))
    later, *_, info = env.step(np.zeros(4))
    np.testing.assert_array_equal(later["rotation"], observation["rotation"])
    assert later in env.observation_space and not info["termination"]


def test_an_estimate_without_angular_velocity_is_refused() -> None:
    class Slow(Scripted):
        def state_at(self, t_ns: int) -> NavState | None:
            state = super().state_at(t_ns)
            return state and replace(state, angular_velocity_rad_s=None)

    with pytest.raises(ConfigError, match="without angular velocity; expected one"):
        scripted_env(Slow)[0].reset(seed=0)


def test_darkness_counts_from_the_start_of_the_episode() -> None:
    env, _, cameras = scripted_env(estimation={"dark_from_s": 0.1, "dark_for_s": 0.1})
    env.reset(seed=0)
    for _ in range(20):
        env.step(np.zeros(4))
    dark = [t_ns * 1e-9 - 0.33 for t_ns, lit in cameras[0].lit if not lit]
    np.testing.assert_allclose(dark, [0.12, 0.17])


def test_randomization_makes_the_cameras_differ_from_the_rig() -> None:
    rotation, translation = Constant(0.02), Constant(0.01)
    drawn = Randomization(camera_rotation_rad=rotation, camera_translation_m=translation, light=Constant(0.5))
    env, estimators, cameras = scripted_env(randomization=drawn)
    env.reset(seed=0)
    (true,), (known,) = cameras[0].setup.rig.cameras, estimators[0].rig.cameras
    error = pose_matrix(exp_so3(np.full(3, 0.02)), np.full(3, 0.01))
    np.testing.assert_allclose(true.T_imu_cam, error @ known.T_imu_cam)
    assert known.T_imu_cam is env.settings.rig.cameras[0].T_imu_cam
    light = np.full((4, 4), 200.0, np.float32)
    dim, nominal = (
        imaging.digitize(light, 1.0, 0.002, 1.0, np.random.default_rng(0)).mean()
        for imaging in (cameras[0].setup.imaging, env.settings.estimation.imaging)
    )
    assert dim == pytest.approx(0.5 * nominal, abs=2.0)


def test_cameras_with_a_time_offset_are_exposed_later() -> None:
    env, estimators, _ = scripted_env(rig=replace(euroc_rig(), time_offset_s=-0.02))
    env.reset(seed=0)
    stamps, arrivals = np.array(estimators[0].frames).T
    assert stamps[0] == 50_000_000  # the first one whose exposure the IMU covers
    np.testing.assert_array_equal(arrivals, stamps + 10_000_000)


# --- errors and copies


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"task": "hover"}, "task Hover, which starts in the air; expected one that starts standing"),
        ({"rig": replace(euroc_rig(), cameras=())}, "rig without cameras"),
        ({"estimation": {"latency_s": 0.6}}, r"Estimation.latency_s = 0.6; expected a number, 0 to 0.5"),
        ({"estimation": {"dark_for_s": -1.0}}, "Estimation.dark_for_s = -1"),
    ],
)
def test_impossible_loops_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        scripted_env(**settings)


def test_native_vectors_of_estimators_are_refused() -> None:
    with pytest.raises(ConfigError, match="AsyncVectorEnv"):
        DroneVectorEnv(2, "vio-hover", estimator=Scripted)


def test_starts_in_the_air_are_refused() -> None:
    env, *_ = scripted_env()
    with pytest.raises(ConfigError, match=r"expected one that stands at a height of 0\.1"):
        env.reset(options={"position_m": np.array([0.0, 0.0, 1.0])})


def test_an_estimator_is_not_copied() -> None:
    env = DroneEnv("vio-hover", estimator=Scripted, estimation=Estimation(cameras=Cameras))
    copy = pickle.loads(pickle.dumps(env))
    first, second = env.reset(seed=1), copy.reset(seed=1)
    np.testing.assert_array_equal(first[0]["goals"], second[0]["goals"])
    with pytest.raises(ConfigError, match="with an estimator, which cannot be copied"):
        env.save_state()
    with pytest.raises(ConfigError, match="with an estimator, which cannot be copied"):
        env.restore_state({})
    with pytest.raises(ConfigError, match="with an estimator, which cannot be copied"):
        pickle.dumps(env)


def test_check_env_reports_nothing_with_an_estimator() -> None:
    check_env(DroneEnv("vio-hover", estimator=Scripted, estimation=Estimation(cameras=Cameras)), skip_render_check=True)


# --- the tasks


def test_vio_hover_lands_on_the_truth() -> None:
    env = DroneEnv(VioHover(hover_s=0.5, height_m=0.5))
    observation, info = env.reset(seed=0)
    assert "estimate" not in info
    terminated = False
    highest = 0.0
    while not terminated:
        observation, _, terminated, _, info = env.step(fly_to_goal(observation))
        highest = max(highest, float(env._core.states.position_m[0, 2]))
        assert info["t_ns"] < 10e9
    assert info["success"] and info["termination"].text == "success" and info["reward_terms"]["landed"] == 100.0
    assert 0.35 < highest < 0.55


AREA = flight_area("room", 0)


def hovered(z: float, velocity: float, t_s: float, x: float = 0.0, before: float | None = None) -> Transition:
    """Return a step of a vehicle above the pad, whose height is given relative to that of a standing one."""
    at = AREA.pad + [x, 0.0, 0.1]
    start, end = (
        VehicleStates.at((at + [0.0, 0.0, height])[None], velocity_m_s=np.array([0.0, 0.0, velocity]))
        for height in (z if before is None else before, z)
    )
    zeros = np.zeros((1, 4))
    return Transition(start, end, zeros, zeros, np.array([t_s]), np.zeros(1, bool), 0.1, np.array([0.3]))


@pytest.mark.parametrize(("x", "velocity", "landed"), [(0.0, -0.5, True), (0.25, -0.5, False), (0.0, -0.7, False)])
def test_landings_have_to_be_soft_and_on_the_pad(x: float, velocity: float, landed: bool) -> None:
    task = VioHover(uncertainty=2.0)
    _, goals = task.begin(AREA, RESEARCH, None, 1)  # type: ignore[arg-type]
    end_s = task.descent_from_s
    down = hovered(0.0, velocity, end_s + 1.0, x, before=0.05)
    goals = task.advance(AREA, goals, down)
    assert goals.impact_m_s[0] == -velocity and not task.success(AREA, goals, down)[0]
    for t_s in (end_s + 1.02, end_s + 1.5):
        resting = hovered(0.0, 0.0, t_s, x)
        goals = task.advance(AREA, goals, resting)
        assert not task.success(AREA, goals, resting)[0]
    last = hovered(0.0, 0.0, end_s + 1.53, x)
    after = task.advance(AREA, goals, last)
    assert task.success(AREA, after, last)[0] == landed and task.ends_with_success
    terms = task.reward_terms(AREA, goals, after, last)
    assert terms["landed"][0] == 100.0 * landed and terms["uncertainty"][0] == pytest.approx(-0.6)


@pytest.mark.parametrize(("hop_m", "worst_m_s"), [(0.05, 2.0), (0.02, 0.7)], ids=["hard hit", "low hop"])
def test_the_worst_touchdown_of_an_episode_counts(hop_m: float, worst_m_s: float) -> None:
    """A hard touchdown, or one after a hop of two centimetres, is followed by a hop and a soft landing."""
    task = VioHover()
    _, goals = task.begin(AREA, RESEARCH, None, 1)  # type: ignore[arg-type]
    t_s = task.descent_from_s + 0.02 * np.arange(4)
    for height, velocity, before, t in (
        (0.0, -worst_m_s, hop_m, t_s[0]),
        (0.06, 1.0, 0.0, t_s[1]),
        (0.0, -0.235, 0.05, t_s[2]),
        (0.0, 0.0, 0.0, t_s[3]),
    ):
        goals = task.advance(AREA, goals, hovered(height, velocity, t, before=before))
    last = hovered(0.0, 0.0, t_s[3] + 1.0)
    goals = task.advance(AREA, goals, last)
    assert goals.impact_m_s[0] == worst_m_s
    assert not task.success(AREA, goals, last)[0]


@pytest.mark.parametrize(("descent_m_s", "softly"), [(0.4, True), (2.0, False)])
def test_single_and_vector_environments_keep_the_worst_touchdown(descent_m_s: float, softly: bool) -> None:
    """The vehicle hits the pad, hops by some centimetres, and lands softly."""
    settings: dict[str, Any] = {"task": VioHover(hover_s=0.0, height_m=0.1), "action": "velocity"}
    single, vector = DroneEnv(**settings), DroneVectorEnv(2, **settings)
    core = single._core
    place = core.area.pad + [0.0, 0.0, core.plant.standing_height_m + 0.8]
    turning = np.full(4, single.settings.vehicle.hover_speed_rad_s)
    options = {"position_m": place, "rotor_speed_rad_s": turning}
    single.reset(seed=0, options=options)
    vector.reset(seed=0, options=options)
    velocity, ended = -descent_m_s, False
    for _ in range(200):
        height = core.states.position_m[0, 2] - core.area.pad[2] - core.plant.standing_height_m
        if velocity == -descent_m_s and height < 0.005:
            velocity = 0.6  # to the hop
        elif velocity == 0.6 and height > 0.08:
            velocity = -0.2
        action = np.array([0.0, 0.0, velocity / single.settings.action_limits.velocity_m_s, 0.0])
        _, _, ended, _, info = single.step(action)
        *_, infos = vector.step(np.tile(action, (2, 1)))
        assert info["success"] == infos["success"][0] == infos["success"][1]
        if ended:
            break
    assert velocity == -0.2 and core.states.position_m[0, 2] < place[2] - 0.79  # it stands after the hop
    for goals in (core._episode.goals, vector._core._episode.goals):
        np.testing.assert_allclose(goals.impact_m_s, descent_m_s, atol=0.1)
    assert ended == info["success"] == softly
    vector.close()


def test_standing_before_the_flight_is_no_landing() -> None:
    task = VioHover()
    _, goals = task.begin(AREA, RESEARCH, None, 1)  # type: ignore[arg-type]
    for t_s in (0.02, 5.0):
        standing = hovered(0.0, 0.0, t_s)
        goals = task.advance(AREA, goals, standing)
        assert not task.success(AREA, goals, standing)[0]


def test_the_goal_of_vio_hover_rises_stays_and_descends() -> None:
    task = VioHover(height_m=1.0, climb_m_s=0.5, hover_s=10.0, descent_m_s=0.2)
    _, goals = task.begin(AREA, RESEARCH, None, 6)  # type: ignore[arg-type]
    times = np.array([0.0, 1.0, 2.0, 12.0, 14.0, 40.0])
    heights = task.objective(AREA, goals, times).position_m[:, 0, 2] - AREA.pad[2]
    np.testing.assert_allclose(heights, [0.0, 0.5, 1.0, 1.0, 0.6, -1.0])


def test_vio_navigate_starts_on_the_pad_towards_its_goal() -> None:
    env = DroneEnv("vio-navigate", observations=("goals", "rotation"), world="room")
    observation, _ = env.reset(seed=0)
    ahead = observation["goals"][0]
    assert ahead[0] > 1.0 and abs(ahead[1]) < 1e-3
    np.testing.assert_allclose(env._core.states.position_m[0, :2], flight_area("room", 0).pad[:2], atol=1e-9)
    task = VioNavigate()
    _, goals = task.begin(AREA, RESEARCH, np.random.default_rng(0), 1)
    assert task.reward_terms(AREA, goals, goals, hovered(1.0, 0.0, 1.0))["uncertainty"][0] == pytest.approx(-0.006)


# --- the policy


def test_the_policy_flies_to_its_goal() -> None:
    goals = np.array([[[0.5, 0.0, 0.0]], [[0.0, 0.0, 10.0]], [[0.0, 4.0, 0.0]]])
    R = np.stack([np.eye(3), rotation_z(0.3), exp_so3(np.array([0.2, 0.0, 0.0]))])
    actions = fly_to_goal({"goals": goals, "rotation": R}, gain_per_s=1.0, speed_m_s=1.0)
    assert actions.dtype == np.float32
    np.testing.assert_allclose(actions[0], [0.25, 0.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(actions[1], [0.0, 0.0, 0.5, 0.0], atol=1e-6)
    np.testing.assert_allclose(actions[2], [0.0, 0.5 * np.cos(0.2), 0.5 * np.sin(0.2), np.pi / 4], atol=1e-6)
    single = fly_to_goal({"goals": goals[0], "rotation": R[0]}, gain_per_s=1.0)
    np.testing.assert_array_equal(single, actions[0])


# --- the ids


@pytest.mark.parametrize("name", ["VioHover", "VioNavigate"])
def test_check_env_reports_nothing_for_the_ids(name: str) -> None:
    loop = Estimation(cameras=Cameras, longest_wait_s=0.5)
    env = gymnasium.make(
        f"dronevio/{name}-v0", world="room", observations=STATE, flat=True, estimator=Scripted, estimation=loop
    )
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_the_ids_fly_on_odometry_deterministically() -> None:
    env: gymnasium.Env[Any, Any] = gymnasium.make("dronevio/VioHover-v0", world="repetitive")
    again: Any = [env.reset(seed=0), *(env.step(UP) for _ in range(5))]
    first: Any = [env.reset(seed=0), *(env.step(UP) for _ in range(30))]
    assert data_equivalence(first[:6], again, exact=True)
    assert 0.5 < first[0][1]["waited_s"] < 2.0
    *_, terminated, _, info = first[-1]
    assert not terminated and info["health"] in ("tracking", "inertial-only")
    assert info["truth"]["position_m"][2] > 0.2
    assert 0.0 < info["position_error_m"] < 0.1 and info["orientation_error_rad"] < 0.03
    assert info["covariance"][3:6, 3:6].trace() > 0.0
    env.close()
