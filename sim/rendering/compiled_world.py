"""Compiled worlds: the models, illumination and moving objects that rendering processes load."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.imu import Times
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.models.state import Trajectory
from dronevio.sim.cameras.atlas_renderer import MoverPoses
from dronevio.sim.cameras.interpolation import interpolated_poses
from dronevio.sim.world import Mover, build_world, instance_spec

Array = npt.NDArray[np.float64]

_NEAREST_M = 0.3  # smallest distance of the centre of a moving object


@dataclass(frozen=True, eq=False)
class CompiledWorld:
    """A world in files that any process can load and render."""

    model_path: Path
    """File of the compiled model."""
    instances_path: Path
    """File of the model without textures and with one geom per object instance, for segmentation."""
    instance_names: tuple[str, ...]
    """Names of the object instances by the index of their geom."""
    illumination: float
    """Illumination relative to a well-lit world."""
    movers: dict[str, Trajectory]
    """Trajectories of the moving objects by the name of their body, on the clock of the IMU."""

    def movers_at(self, t_ns: int) -> MoverPoses:
        """Return the poses of all moving objects at a time [ns]."""
        return {name: interpolated_poses(path, np.array([t_ns]))[0] for name, path in self.movers.items()}

    def angle_swept_rad(self, from_ns: int, to_ns: int, p_world: Array) -> float:
        """Return the largest motion of any object between two times [ns] as seen from a point (3,) [rad]."""
        ends = [interpolated_poses(path, np.array([from_ns, to_ns]))[:, :3, 3] for path in self.movers.values()]
        ranges_m = (max(float(np.linalg.norm(start - p_world)), _NEAREST_M) for start, _ in ends)
        paths_m = (float(np.linalg.norm(end - start)) for start, end in ends)
        return max((path_m / away_m for path_m, away_m in zip(paths_m, ranges_m, strict=True)), default=0.0)


@contextmanager
def compiled_world(world: str, seed: int, t_ns: Times) -> Iterator[CompiledWorld]:
    """Build a world and keep it in temporary files during the context.

    Args:
        world: Name of the world.
        seed: Seed of the world.
        t_ns: (N,) Times of the trajectories of moving objects [ns]; the flight starts at the first.

    Raises:
        ConfigError: The world is unknown.
    """
    built = build_world(world, seed)
    with TemporaryDirectory(prefix="dronevio-") as scratch:
        whole, unpainted = Path(scratch) / "world.mjb", Path(scratch) / "things.mjb"
        mujoco.mj_saveModel(built.spec.compile(), str(whole), None)
        things = instance_spec(world, seed).compile()
        mujoco.mj_saveModel(things, str(unpainted), None)
        names = tuple(str(things.geom(number).name) for number in range(things.ngeom))
        movers = {mover.body: _sampled(mover, t_ns) for mover in built.movers}
        yield CompiledWorld(whole, unpainted, names, built.illumination, movers)


def _sampled(mover: Mover, t_ns: Times) -> Trajectory:
    """Return the trajectory of a moving object at the given times."""
    poses = mover.poses((t_ns - t_ns[0]) * 1e-9)
    return Trajectory(t_ns, poses[:, :3, 3].copy(), quat_wxyz_from_matrix(poses[:, :3, :3]))
