"""Chase camera: images of the drone in its world from a third-person viewpoint."""

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import GraphicsError
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import Rig
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.sim.cameras.gl import Context, create_context, free, is_usable, make_current
from dronevio.sim.physics.vehicle import quadrotor_spec
from dronevio.sim.rendering.shared import Lease, SharedPool
from dronevio.sim.world import World, build_world, resolved_world

_DISTANCE_ARMS, _AZIMUTH_DEG, _ELEVATION_DEG = 8.5, 60.0, -20.0
_MARKERS_MAX = 16
_MARKER_ARMS = 0.3  # radius of a marker
_MARKER_RGB = (0.1, 0.9, 0.3)
_FIRST_OPACITY, _OTHER_OPACITY = 0.9, 0.35  # of the first marker, and of the others
_NO_MARKERS = np.empty((0, 3))


class ChaseCamera:
    """A camera that looks at the drone from a constant distance and direction, off screen. Close it after use."""

    def __init__(self, world: World, quadrotor: Quadrotor, rig: Rig, width: int = 640, height: int = 480) -> None:
        """Load the world and the drone into graphics memory.

        Args:
            world: The world of the drone; it is not modified.
            quadrotor: The vehicle.
            rig: The sensors of the vehicle.
            width: Width of the images [px].
            height: Height of the images [px].

        Raises:
            GraphicsError: Off-screen OpenGL is not available.
        """
        spec = world.spec.copy()
        spec.visual.quality.offsamples = 4  # antialiasing; these images are for display only
        spec.attach(quadrotor_spec(quadrotor, rig), prefix="drone/", frame=spec.worldbody.add_frame())
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._gl: Context | None = create_context(width, height)
        self._drawing = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_resizeOffscreen(width, height, self._drawing)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._drawing)
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + _MARKERS_MAX)
        self._options = mujoco.MjvOption()
        self._view = mujoco.MjvCamera()
        self._view.distance = _DISTANCE_ARMS * quadrotor.reach_m
        self._view.azimuth, self._view.elevation = _AZIMUTH_DEG, _ELEVATION_DEG
        self._marker_m = _MARKER_ARMS * quadrotor.reach_m
        self._rectangle = mujoco.MjrRect(0, 0, width, height)
        self._picture = np.empty((height, width, 3), np.uint8)

    def render(self, T_world_vehicle: Array, markers_m: Array = _NO_MARKERS) -> npt.NDArray[np.uint8]:
        """Return an RGB image (H, W, 3) of the drone.

        Args:
            T_world_vehicle: (4, 4) Pose of the drone.
            markers_m: (K, 3) Points in the world that are shown as green balls [m], of which the first is the most
                opaque; at most 16.

        Raises:
            GraphicsError: The camera has been closed.
        """
        if self._gl is None:
            raise GraphicsError("the chase camera has been closed")
        make_current(self._gl)
        self._data.qpos[:3] = T_world_vehicle[:3, 3]
        self._data.qpos[3:7] = quat_wxyz_from_matrix(T_world_vehicle[:3, :3])
        mujoco.mj_kinematics(self._model, self._data)
        self._view.lookat = T_world_vehicle[:3, 3]
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, self._data, self._options, None, self._view, everything, self._scene)
        for index, point in enumerate(markers_m[:_MARKERS_MAX]):
            self._mark(point, _OTHER_OPACITY if index else _FIRST_OPACITY)
        mujoco.mjr_render(self._rectangle, self._scene, self._drawing)
        mujoco.mjr_readPixels(self._picture, None, self._rectangle, self._drawing)
        return self._picture[::-1].copy()  # the first row of OpenGL is the lowest

    def _mark(self, point_m: Array, opacity: float) -> None:
        """Add a ball at a point (3,) [m] to the scene."""
        ball, size = mujoco.mjtGeom.mjGEOM_SPHERE, np.array([self._marker_m, 0.0, 0.0])
        colour = np.array([*_MARKER_RGB, opacity], np.float32)
        mujoco.mjv_initGeom(self._scene.geoms[self._scene.ngeom], ball, size, point_m, np.eye(3).ravel(), colour)
        self._scene.ngeom += 1

    def usable(self) -> bool:
        """Return whether the graphics memory is neither released nor lost."""
        return self._gl is not None and is_usable(self._gl)

    def close(self) -> None:
        """Release the graphics memory; further calls have no effect."""
        if self._gl is not None:
            make_current(self._gl)
            self._drawing.free()
            free(self._gl)
            self._gl = None


CHASE_CAMERAS: SharedPool[ChaseCamera] = SharedPool(idle_max=1)
"""All chase cameras that the environments of this process share."""


def lease_chase_camera(world: str, seed: int, quadrotor: Quadrotor, rig: Rig) -> Lease[ChaseCamera]:
    """Return a lease of a chase camera of 640 × 480 px, shared by all users of the same world and vehicle.

    Args:
        world: Name of the world.
        seed: Seed of the world.
        quadrotor: The vehicle.
        rig: The sensors of the vehicle.

    Raises:
        ConfigError: The world is unknown.
        GraphicsError: Off-screen OpenGL is not available.
    """
    world = resolved_world(world)
    key = (world, seed, quadrotor_spec(quadrotor, rig).to_xml())
    return CHASE_CAMERAS.lease(key, lambda: ChaseCamera(build_world(world, seed), quadrotor, rig))
