"""Tasks of the environments: how episodes start, what is rewarded, and when they end."""

from dronevio.models.errors import unknown_name
from dronevio.sim.envs.tasks.explore import Explore
from dronevio.sim.envs.tasks.hover import Hover
from dronevio.sim.envs.tasks.navigate import Navigate
from dronevio.sim.envs.tasks.race import Race
from dronevio.sim.envs.tasks.task import AnyTask, BaseTask, Objective, PointGoals, Start, Task, Transition
from dronevio.sim.envs.tasks.track import Track
from dronevio.sim.envs.tasks.vio_hover import VioHover
from dronevio.sim.envs.tasks.vio_navigate import VioNavigate
from dronevio.sim.envs.tasks.waypoints import Waypoints

__all__ = [
    "TASKS",
    "AnyTask",
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
    "task_named",
]

TASKS: dict[str, AnyTask] = {
    "hover": Hover(),
    "waypoints": Waypoints(),
    "track": Track(),
    "race": Race(),
    "navigate": Navigate(),
    "explore": Explore(),
    "vio-hover": VioHover(),
    "vio-navigate": VioNavigate(),
}
"""The tasks by name, with default settings."""


def task_named(name: str) -> AnyTask:
    """Return the task with a given name.

    Raises:
        ConfigError: There is no task with this name.
    """
    if name not in TASKS:
        raise unknown_name("task", name, TASKS)
    return TASKS[name]
