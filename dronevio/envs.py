"""Registration of the environments with Gymnasium.

After ``import dronevio.envs``, ``gymnasium.make("dronevio/Hover-v0")`` makes an environment, and `gymnasium.make_vec` a
vector of environments. The call ``gymnasium.make("dronevio.envs:dronevio/Hover-v0")`` does both. Simulator and
estimator are imported when an environment is made.
"""

from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium

from dronevio.models.rig import Rig, euroc_rig

if TYPE_CHECKING:
    from dronevio.sim.envs import *  # noqa: F403 for type checkers, as `__getattr__` does it
    from dronevio.sim.envs.sensing.estimation import EstimatorFactory
    from dronevio.sim.envs.single import DroneEnv
    from dronevio.sim.envs.tasks import AnyTask

_TASKS = ("Hover", "Waypoints", "Track", "Race", "Navigate", "Explore")
_VIO_TASKS = {"VioHover": "vio-hover", "VioNavigate": "vio-navigate"}
_VIO_WIDTH, _VIO_HEIGHT, _VIO_RATE_HZ = 320, 204, 10.0


def vio_rig() -> Rig:
    """Return the default rig of the environments with visual-inertial odometry.

    It is EuRoC's monocular rig with smaller and fewer images of the same field of view, 320 × 204 px at 10 Hz: two
    simulated seconds take one second of processor time.
    """
    rig = euroc_rig()
    (camera,) = rig.cameras
    model = camera.model.resized(_VIO_WIDTH, _VIO_HEIGHT)
    return replace(rig, cameras=(replace(camera, model=model, rate_hz=_VIO_RATE_HZ),))


def vio_environment(
    task: "AnyTask | str" = "vio-hover",
    render_mode: str | None = None,
    rig: Rig | str | None = None,
    estimator: "EstimatorFactory | None" = None,
    **settings: Any,
) -> "DroneEnv":
    """Return an environment that is flown on an estimate: the entry point of the ids ``Vio…``.

    Args:
        task: Task or name of a task that starts standing.
        render_mode: None, ``rgb_array`` or ``human``.
        rig: Cameras and IMU, or the name of a rig; `vio_rig` by default.
        estimator: Function that returns an estimator for a rig; `VisualInertialOdometry` by default.
        settings: Other fields of `EnvironmentSettings` by name.

    Raises:
        ConfigError: An argument is unknown or not possible, or two exclude each other.
        GraphicsError: The render mode is ``human``, and there is no display.
    """
    from dronevio.sim.envs.single import DroneEnv

    if estimator is None:
        from dronevio.estimator.odometry import VisualInertialOdometry

        estimator = VisualInertialOdometry
    return DroneEnv(task, render_mode, rig=rig or vio_rig(), estimator=estimator, **settings)


# Environments count their time limits, which follow from the length of an episode and the rate of actions.
for _name in _TASKS:
    gymnasium.register(
        id=f"dronevio/{_name}-v0",
        entry_point="dronevio.sim.envs.single:DroneEnv",
        vector_entry_point="dronevio.sim.envs.vector:DroneVectorEnv",
        kwargs={"task": _name.lower()},
    )

for _name, _task in _VIO_TASKS.items():  # their estimators are not vectorized
    gymnasium.register(
        id=f"dronevio/{_name}-v0",
        entry_point="dronevio.envs:vio_environment",
        kwargs={"task": _task},
    )


def __getattr__(name: str) -> Any:
    """Return a name of `dronevio.sim.envs`: tasks, settings and classes, which are imported when they are used."""
    if not name.startswith("_") and name in (names := import_module("dronevio.sim.envs")).__all__:
        return getattr(names, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return the names of this module and those of `dronevio.sim.envs`."""
    return sorted({*globals(), *import_module("dronevio.sim.envs").__all__})
