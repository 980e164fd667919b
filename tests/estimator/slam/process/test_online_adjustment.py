"""Bundle adjustment during the flight: when it begins, when it takes effect, and what it does to the map."""

from dataclasses import dataclass, field, replace

import numpy as np

from dronevio.estimator.imu.preintegration import PreintegrationConfig, PreintegrationParams
from dronevio.estimator.slam.adjustment.adjuster import AdjustmentOutcome
from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentInputs
from dronevio.estimator.slam.adjustment.flight_measurements import KeyframeMeasurements
from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.correction import Correction
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.mapper import MappingConfig
from dronevio.estimator.slam.schedule import AdjustmentScheduleConfig
from dronevio.estimator.slam.worker.map_builder import (
    LocalMap,
    MapBuilder,
    MarginalizedKeyframe,
    OdometryMap,
    TrackLost,
)
from dronevio.estimator.slam.worker.map_process import MapProcess
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import NavState
from tests.estimator.slam.process.conftest import PLACES, keyframe, one_camera
from tests.estimator.slam.process.test_saved_maps import lap_map
from tests.estimator.slam.process.test_visual_slam import in_second_frame

TURN = exp_so3(np.array([0.2, 0.0, 0.0]))
"""Rotation of all keyframes by the adjustment of these tests. Its axis is horizontal, and the choice of the map frame
leaves the inclination."""
DELAY = 3
"""Number of keyframes after which an adjustment takes effect."""
CONFIG = SlamConfig(
    mapping=MappingConfig(optimization_interval_s=0.0),
    adjustment_schedule=AdjustmentScheduleConfig(min_loops=2, growth=100.0, keyframes=DELAY),
)


@dataclass
class TurningAdjuster:
    """An adjuster that rotates all keyframes together."""

    cpu_s: float = 0.0
    started: list[AdjustmentInputs] = field(default_factory=list)

    def start(self, inputs: AdjustmentInputs) -> None:
        """Keep the measurements."""
        self.started.append(inputs)

    def result(self) -> AdjustmentOutcome | None:
        """Return the keyframes of the last measurements, rotated."""
        T = pose_matrix(TURN, np.zeros(3))
        return AdjustmentOutcome({each.number: T @ each.T_map_imu for each in self.started[-1].keyframes}, "rotated")


def measured(message: MarginalizedKeyframe) -> MarginalizedKeyframe:
    """Return a keyframe with measurements, whose velocity is 1 m/s along x of the odometry frame."""
    t_ns, rig = message.estimate.t_ns, message.keyframe.rig
    state = NavState(t_ns, message.estimate.T_odom_imu, np.array([1.0, 0.0, 0.0]), np.zeros(3), np.zeros(3))
    imu = ImuSamples(np.array([t_ns]), np.zeros((1, 3)), np.zeros((1, 3)))
    noise = PreintegrationParams.of(rig.imu, PreintegrationConfig())
    observations = message.keyframe.observations
    return replace(message, measured=KeyframeMeasurements(state, observations, Calibration(rig), imu, noise, t_ns))


def laps(count: int) -> list[MarginalizedKeyframe]:
    """Return the keyframes of laps through the same places, with measurements."""
    rig = one_camera()
    return [measured(keyframe(rig, place, lap)) for lap in range(count) for place in range(PLACES)]


def built(messages: list[MarginalizedKeyframe], config: SlamConfig = CONFIG) -> tuple[TurningAdjuster, list[Array]]:
    """Return the adjuster after a flight, and the rotations (3, 3) of the odometry frame at its keyframes."""
    adjuster = TurningAdjuster()
    builder = MapBuilder(one_camera(), config, None, adjuster)
    found = []
    for message in messages:
        correction = builder.process(message)
        assert isinstance(correction, Correction) and correction.T_map_odom is not None
        found.append(correction.T_map_odom[:3, :3])
    return adjuster, found


def test_adjustment_takes_effect_after_its_delay() -> None:
    messages = laps(2)
    adjuster, corrections = built(messages)
    _, expected = built(messages, replace(CONFIG, adjustment_schedule=AdjustmentScheduleConfig(enabled=False)))
    (inputs,) = adjuster.started
    begun = len(inputs.keyframes)
    assert begun > PLACES and len(inputs.loops) >= 2
    assert all(len(loop.observations) for loop in inputs.loops)
    np.testing.assert_array_equal(inputs.imu.t_ns, [each.estimate.t_ns for each in messages[:begun]])
    turn = np.array(corrections) @ np.swapaxes(expected, 1, 2)
    effect = begun + DELAY - 1  # row of the keyframe at which it is due
    np.testing.assert_allclose(turn[:effect], np.tile(np.eye(3), (effect, 1, 1)), atol=1e-9)
    assert len(turn) > effect
    np.testing.assert_allclose(turn[effect:, 2], np.tile(TURN[2], (len(turn) - effect, 1)), atol=0.002)


def test_velocities_are_turned_into_the_map_frame() -> None:
    messages = laps(2)
    (inputs,) = built(messages)[0].started
    for each, message in zip(inputs.keyframes, messages, strict=False):
        R_map_odom = each.T_map_imu[:3, :3] @ message.estimate.T_odom_imu[:3, :3].T
        np.testing.assert_allclose(each.velocity_m_s, R_map_odom[:, 0], atol=1e-12)


def test_map_without_measurements_is_not_adjusted() -> None:
    adjuster, _ = built([replace(each, measured=None) for each in laps(2)])
    assert adjuster.started == []


def test_adjustment_of_a_map_that_was_given_up_has_no_effect() -> None:
    adjuster = TurningAdjuster()
    config = replace(CONFIG, adjustment_schedule=replace(CONFIG.adjustment_schedule, keyframes=30))
    builder = MapBuilder(one_camera(), config, None, adjuster)
    for message in laps(2):
        builder.process(message)
    assert len(adjuster.started) == 1
    builder.mapper.adjust({10_000: np.eye(4)})
    graph = builder.mapper.graph
    assert graph is not None and graph.fixed == ()


def test_a_lost_track_begins_no_adjustment() -> None:
    adjuster = TurningAdjuster()
    builder = MapBuilder(one_camera(), CONFIG, None, adjuster)
    first, second = laps(1), [measured(keyframe(one_camera(), 20 + place, 1)) for place in range(PLACES)]
    for message in first:
        builder.process(message)
    builder.process(TrackLost(second[0].estimate.t_ns - 1))
    for message in second:
        builder.process(message)
    assert adjuster.started == []


def answers(map_: OdometryMap, messages: list[MarginalizedKeyframe]) -> list[bytes]:
    """Return the corrections of the odometry by the answers of a map."""
    for message in messages:
        map_.send(message)
    found = [map_.receive() for _ in messages]
    return [b"" if each is None or each.T_map_odom is None else each.T_map_odom.tobytes() for each in found]


def test_adjusted_map_in_a_worker_process_is_the_same() -> None:
    messages = laps(2)
    worker = MapProcess(one_camera(), CONFIG)
    try:
        found = answers(worker, messages)
    finally:
        worker.close()
    assert found == answers(LocalMap(one_camera(), CONFIG), messages)
    without = replace(CONFIG, adjustment_schedule=AdjustmentScheduleConfig(enabled=False))
    assert found != answers(LocalMap(one_camera(), without), messages)  # adjustments have had an effect


def test_flight_in_a_loaded_map_is_adjusted_during_it() -> None:
    """Loops of the file do not count; the adjusted poses are in the frame of the file."""
    adjuster, saved = TurningAdjuster(), lap_map().known()
    eye = tuple(RelativePose(0, i, np.eye(4), np.eye(6)) for i in range(2, PLACES))
    known = replace(saved, graph=replace(saved.graph, loops=eye))
    builder = MapBuilder(one_camera(), CONFIG, known, adjuster)
    for place in range(PLACES):
        builder.process(measured(in_second_frame(keyframe(one_camera(), place, 1))))
    (inputs,) = adjuster.started
    assert inputs.keyframes[0].number == PLACES and len(inputs.loops) >= CONFIG.adjustment_schedule.min_loops
    assert all(loop.second >= PLACES for loop in inputs.loops)
    assert inputs.saved is not None and inputs.saved.graph.loops == eye and len(inputs.saved.observations)
