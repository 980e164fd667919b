"""Gymnasium environments; importing ``dronevio.envs`` registers them."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.models.actions import ActionLimits
    from dronevio.sim.envs.episodes.distributions import Constant, LogUniform, Normal, Uniform
    from dronevio.sim.envs.episodes.endings import Termination
    from dronevio.sim.envs.episodes.randomization import MODERATE, Randomization
    from dronevio.sim.envs.policies.conversion import policy_from_sb3, policy_from_torch, provenance_of
    from dronevio.sim.envs.policies.goal_flight import fly_to_goal
    from dronevio.sim.envs.policies.mission import PolicyMission, policy_mission, policy_outcome
    from dronevio.sim.envs.policies.pilot import PolicyPilot
    from dronevio.sim.envs.sensing.depth_errors import STEREO_DEPTH, DepthErrors
    from dronevio.sim.envs.sensing.estimation import Estimation
    from dronevio.sim.envs.sensing.observations import ObservedState, OwnObservation
    from dronevio.sim.envs.sensing.range_beams import BeamSettings
    from dronevio.sim.envs.sensing.ray_maps import MapSettings
    from dronevio.sim.envs.settings import EnvironmentSettings
    from dronevio.sim.envs.single import DroneEnv
    from dronevio.sim.envs.tasks import (
        BaseTask,
        Explore,
        Hover,
        Navigate,
        Objective,
        PointGoals,
        Race,
        Start,
        Task,
        Track,
        Transition,
        VioHover,
        VioNavigate,
        Waypoints,
    )
    from dronevio.sim.envs.vector import DroneVectorEnv
    from dronevio.sim.envs.vector_checker import check_vector_env

__all__ = [
    "MODERATE",
    "STEREO_DEPTH",
    "ActionLimits",
    "BaseTask",
    "BeamSettings",
    "Constant",
    "DepthErrors",
    "DroneEnv",
    "DroneVectorEnv",
    "EnvironmentSettings",
    "Estimation",
    "Explore",
    "Hover",
    "LogUniform",
    "MapSettings",
    "Navigate",
    "Normal",
    "Objective",
    "ObservedState",
    "OwnObservation",
    "PointGoals",
    "PolicyMission",
    "PolicyPilot",
    "Race",
    "Randomization",
    "Start",
    "Task",
    "Termination",
    "Track",
    "Transition",
    "Uniform",
    "VioHover",
    "VioNavigate",
    "Waypoints",
    "check_vector_env",
    "fly_to_goal",
    "policy_from_sb3",
    "policy_from_torch",
    "policy_mission",
    "policy_outcome",
    "provenance_of",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.models.actions": ("ActionLimits",),
        "dronevio.sim.envs.policies.conversion": ("policy_from_sb3", "policy_from_torch", "provenance_of"),
        "dronevio.sim.envs.episodes.distributions": ("Constant", "LogUniform", "Normal", "Uniform"),
        "dronevio.sim.envs.sensing.depth_errors": ("STEREO_DEPTH", "DepthErrors"),
        "dronevio.sim.envs.sensing.estimation": ("Estimation",),
        "dronevio.sim.envs.policies.goal_flight": ("fly_to_goal",),
        "dronevio.sim.envs.policies.mission": ("PolicyMission", "policy_mission", "policy_outcome"),
        "dronevio.sim.envs.policies.pilot": ("PolicyPilot",),
        "dronevio.sim.envs.episodes.endings": ("Termination",),
        "dronevio.sim.envs.episodes.randomization": ("MODERATE", "Randomization"),
        "dronevio.sim.envs.sensing.observations": ("ObservedState", "OwnObservation"),
        "dronevio.sim.envs.sensing.range_beams": ("BeamSettings",),
        "dronevio.sim.envs.sensing.ray_maps": ("MapSettings",),
        "dronevio.sim.envs.settings": ("EnvironmentSettings",),
        "dronevio.sim.envs.single": ("DroneEnv",),
        "dronevio.sim.envs.tasks": (
            "BaseTask",
            "Explore",
            "Hover",
            "Navigate",
            "Objective",
            "PointGoals",
            "Race",
            "Start",
            "Task",
            "Track",
            "Transition",
            "VioHover",
            "VioNavigate",
            "Waypoints",
        ),
        "dronevio.sim.envs.vector": ("DroneVectorEnv",),
        "dronevio.sim.envs.vector_checker": ("check_vector_env",),
    },
)
