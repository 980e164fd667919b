"""Simulate a quadrotor, estimate its motion from camera and IMU, and evaluate the estimate.

The public names are imported when they are first used, so that ``import dronevio`` loads nothing. By convention:

    import dronevio as dv

    recording = dv.fly("room", "recordings/room", seed=3)
    run = dv.estimate(recording)
    print(dv.evaluate(recording, run).scores.ate_m.rmse)

The package consists of ``dronevio.models`` (data types, sensor models and recordings), ``dronevio.sim`` (physics and
sensors with MuJoCo), ``dronevio.estimator`` (visual-inertial odometry with GTSAM and OpenCV), ``dronevio.eval``
(metrics, benchmarks and reports) and the application layer (the command line and what connects the others).
"""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.api import dense, estimate, fly, fly_on_estimate, sfm
    from dronevio.autonomy.exploration import Exploration, explore
    from dronevio.autonomy.settings import ExploreSettings
    from dronevio.dense_mapping import DenseMap, map
    from dronevio.estimator.config import VioConfig
    from dronevio.estimator.imu.forward_propagation import ImuRatePropagator
    from dronevio.estimator.mapping.config import DenseMapConfig
    from dronevio.estimator.odometry import VisualInertialOdometry
    from dronevio.estimator.slam.config import SlamConfig
    from dronevio.estimator.slam.visual_slam import VisualSlam
    from dronevio.estimators.driver import estimate_recording
    from dronevio.eval.metrics.scores import ScoredTrajectory, Scores
    from dronevio.eval.run import EstimatorRun
    from dronevio.evaluation import ate, evaluate
    from dronevio.inspection.inspection import inspect
    from dronevio.inspection.model import Finding, Inspection
    from dronevio.models.camera import CameraModel
    from dronevio.models.errors import DronevioError
    from dronevio.models.imu import ImuModel, ImuSamples
    from dronevio.models.policies.policy import Policy
    from dronevio.models.policies.policy_file import load_policy, save_policy
    from dronevio.models.protocols import Estimator, Recording, measurements
    from dronevio.models.recordings.open import open_recording, read_trajectory
    from dronevio.models.recordings.tum import write_tum
    from dronevio.models.rig import Rig, RigCamera
    from dronevio.models.rig_presets import rig_named
    from dronevio.models.state import CameraFrame, Estimate, Health, NavState, Trajectory
    from dronevio.plotting import plot
    from dronevio.policy_evaluation import PolicyEvaluation, evaluate_baseline, evaluate_policy
    from dronevio.sim.scenario import Scenario
    from dronevio.sim.scenarios import scenario_named

__all__ = [
    "CameraFrame",
    "CameraModel",
    "DenseMap",
    "DenseMapConfig",
    "DronevioError",
    "Estimate",
    "Estimator",
    "EstimatorRun",
    "Exploration",
    "ExploreSettings",
    "Finding",
    "Health",
    "ImuModel",
    "ImuRatePropagator",
    "ImuSamples",
    "Inspection",
    "NavState",
    "Policy",
    "PolicyEvaluation",
    "Recording",
    "Rig",
    "RigCamera",
    "Scenario",
    "ScoredTrajectory",
    "Scores",
    "SlamConfig",
    "Trajectory",
    "VioConfig",
    "VisualInertialOdometry",
    "VisualSlam",
    "ate",
    "dense",
    "estimate",
    "estimate_recording",
    "evaluate",
    "evaluate_baseline",
    "evaluate_policy",
    "explore",
    "fly",
    "fly_on_estimate",
    "inspect",
    "load_policy",
    "map",
    "measurements",
    "open_recording",
    "plot",
    "read_trajectory",
    "rig_named",
    "save_policy",
    "scenario_named",
    "sfm",
    "write_tum",
]

__version__ = "0.1.0"

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.api": ("dense", "estimate", "fly", "fly_on_estimate", "sfm"),
        "dronevio.autonomy.exploration": ("Exploration", "explore"),
        "dronevio.autonomy.settings": ("ExploreSettings",),
        "dronevio.dense_mapping": ("DenseMap", "map"),
        "dronevio.estimator.mapping.config": ("DenseMapConfig",),
        "dronevio.estimators.driver": ("estimate_recording",),
        "dronevio.estimator.config": ("VioConfig",),
        "dronevio.estimator.imu.forward_propagation": ("ImuRatePropagator",),
        "dronevio.estimator.slam.config": ("SlamConfig",),
        "dronevio.estimator.slam.visual_slam": ("VisualSlam",),
        "dronevio.estimator.odometry": ("VisualInertialOdometry",),
        "dronevio.eval.metrics.scores": ("ScoredTrajectory", "Scores"),
        "dronevio.eval.run": ("EstimatorRun",),
        "dronevio.evaluation": ("ate", "evaluate"),
        "dronevio.inspection.inspection": ("inspect",),
        "dronevio.inspection.model": ("Finding", "Inspection"),
        "dronevio.models.camera": ("CameraModel",),
        "dronevio.models.errors": ("DronevioError",),
        "dronevio.models.imu": ("ImuModel", "ImuSamples"),
        "dronevio.models.policies.policy": ("Policy",),
        "dronevio.models.policies.policy_file": ("load_policy", "save_policy"),
        "dronevio.models.protocols": ("Estimator", "Recording", "measurements"),
        "dronevio.models.recordings.open": ("open_recording", "read_trajectory"),
        "dronevio.models.recordings.tum": ("write_tum",),
        "dronevio.models.rig": ("Rig", "RigCamera"),
        "dronevio.models.rig_presets": ("rig_named",),
        "dronevio.models.state": ("CameraFrame", "Estimate", "Health", "NavState", "Trajectory"),
        "dronevio.plotting": ("plot",),
        "dronevio.policy_evaluation": ("PolicyEvaluation", "evaluate_baseline", "evaluate_policy"),
        "dronevio.sim.scenario": ("Scenario",),
        "dronevio.sim.scenarios": ("scenario_named",),
    },
)
