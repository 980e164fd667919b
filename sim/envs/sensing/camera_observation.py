"""Camera observations: the images that environments add to their observations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Protocol

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import RigCamera
from dronevio.sim.appearance.textures import PIXELS_PER_M
from dronevio.sim.cameras.atlas_renderer import NO_MOVERS, MoverPoses
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.envs.sensing.image_flow import ImagePoses, flow_since
from dronevio.sim.rendering.loaded_world import LoadedWorld, WorldKey, lease_instances, lease_world
from dronevio.sim.rendering.shared import Lease

Images = dict[str, npt.NDArray[Any]]
ImageKind = Literal["grey", "rgb", "depth", "segmentation", "flow"]

IMAGES: tuple[ImageKind, ...] = ("grey", "rgb", "depth", "segmentation", "flow")
"""Kinds of images."""
_CHANNELS: dict[ImageKind, int] = {"grey": 1, "rgb": 3, "depth": 1, "segmentation": 1, "flow": 2}
_MOST_OBJECTS = 65535  # as in recordings, whatever the world
_SHARP_FROM_M = 1.5  # distance from which reduced textures are as fine as the rendered pixels
_REDUCTIONS = (4, 2, 1)
_SUPERSAMPLING = 1.5  # rendered pixels per image pixel along each axis; published environments depend on it


@dataclass(frozen=True)
class ImageName:
    """Name of an observed image: its kind, as in ``grey``, or kind and camera, as in ``grey:1``."""

    text: str
    """The name."""
    kind: ImageKind
    """Kind of the image."""
    camera: int
    """Index of the camera in the rig."""

    @classmethod
    def parsed(cls, text: str, camera: int) -> "ImageName | None":
        """Return the image of a name; None if it is not that of an image.

        Args:
            text: The name.
            camera: Index of the camera of names without one.
        """
        kind, colon, index = text.partition(":")
        if kind not in IMAGES or (colon and not (index.isascii() and index.isdecimal())):
            return None
        return cls(text, kind, int(index) if colon else camera)

    def __str__(self) -> str:
        """Return the name."""
        return self.text


class CameraObservation(Protocol):
    """Interface of the renderer of the images of environments."""

    def spaces(self) -> dict[str, spaces.Box]:
        """Return the spaces of the images of one environment by name."""

    def observe(self, T_world_imu: Array, t_ns: Times | None = None, previous: ImagePoses | None = None) -> Images:
        """Return images by name.

        Args:
            T_world_imu: (k, 4, 4) Poses of the IMUs of k environments.
            t_ns: (k,) Times since the starts of their episodes [ns], at which moving objects are shown; 0 by default.
            previous: Poses and times of their previous images; by default there were none.

        Returns:
            Arrays (k, H, W, C).
        """

    def close(self) -> None:
        """Release the resources of rendering; further calls have no effect."""


@dataclass(frozen=True)
class ImageSettings(Settings):
    """Kinds and size of the images of an environment."""

    kinds: tuple[ImageKind, ...] = ("grey",)
    """Kinds of images: ``grey``, ``rgb``, ``depth``, ``segmentation`` or ``flow``. Depth, segmentation and flow are
    rendered once for all three."""
    width: Annotated[int, Range(1, 4096)] = 64
    """Width of the images [px]."""
    height: Annotated[int, Range(1, 4096)] = 64
    """Height of the images [px]. They show the largest centred part of the camera's image with their ratio of sides."""
    depth_max_m: Annotated[float, Range(above=0.0, high=1e4)] = 20.0
    """Largest depth: farther surfaces, and pixels without a surface, have this depth [m]."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: A kind is unknown or listed twice, or a number is out of range.
        """
        super().__post_init__()
        if not self.kinds or len(set(self.kinds)) < len(self.kinds) or not set(self.kinds) <= set(_CHANNELS):
            raise ConfigError(f"images of kinds {self.kinds}; expected some of {', '.join(_CHANNELS)}, each once")


@dataclass(frozen=True, eq=False)
class _Renderer:
    """A camera in a loaded world."""

    lease: Lease[LoadedWorld]
    camera: OffscreenCamera

    @classmethod
    def opened(cls, lease: Lease[LoadedWorld], model: CameraModel) -> "_Renderer":
        """Return the renderer of a camera model in a leased world."""
        return cls(lease, OffscreenCamera(lease.value.model, model, _SUPERSAMPLING, lease.value.context))

    def mover_poses(self, t_ns: Times | None, count: int) -> list[MoverPoses]:
        """Return the poses of the moving objects of ``count`` environments at their times (count,) [ns]."""
        movers = self.lease.value.movers
        if t_ns is None or not movers:
            return [NO_MOVERS] * count
        poses = {mover.body: mover.poses(np.asarray(1e-9 * t_ns, dtype=np.float64)) for mover in movers}
        return [{body: each[row] for body, each in poses.items()} for row in range(count)]


class RenderedObservation:
    """Images of one camera of a rig in one world, for any number of environments; implements `CameraObservation`.

    The world is loaded at the first call of `observe` and shared with the other environments of the process. Its
    textures are painted for grey levels and colours only. The lens is that of the rig's camera. Images have no noise
    and no motion blur, and are exposed as the textures are painted. Depth is the z coordinate in the camera frame for
    ``radtan`` lenses, and the length of the ray for fisheyes. Depth, segmentation and flow are those at the centres of
    the pixels: at edges, they are of one surface and never between two.
    """

    def __init__(
        self,
        mounted: RigCamera,
        world: str,
        seed: int,
        settings: ImageSettings | None = None,
        texture_seed: int | None = None,
    ) -> None:
        """Define camera and world.

        Args:
            mounted: The camera and its mounting on the rig.
            world: Name of the world.
            seed: Seed of the world.
            settings: Kinds and size of the images.
            texture_seed: Seed of the textures, by default that of the world.
        """
        self._settings = settings or ImageSettings()
        self._model = mounted.model.fitted(self._settings.width, self._settings.height)
        self._T_imu_cam = mounted.T_imu_cam
        self._key = WorldKey(
            world, seed, seed if texture_seed is None else texture_seed, texture_reduction(self._model)
        )
        self._scenery: _Renderer | None = None
        self._instances: _Renderer | None = None

    def spaces(self) -> dict[str, spaces.Box]:
        """Return the spaces of the images of one environment.

        ``grey`` (H, W, 1) and ``rgb`` (H, W, 3) are uint8, ``depth`` (H, W, 1) is float32 [m], ``segmentation``
        (H, W, 1) is int32, and ``flow`` (H, W, 2) is float32 [px].

        Raises:
            ConfigError: The world is unknown.
        """
        return {kind: _space(kind, self._settings) for kind in self._settings.kinds}

    def observe(self, T_world_imu: Array, t_ns: Times | None = None, previous: ImagePoses | None = None) -> Images:
        """Return the images of k environments by kind.

        Args:
            T_world_imu: (k, 4, 4) Poses of the IMUs.
            t_ns: (k,) Times since the starts of the episodes [ns], at which moving objects are shown; 0 by default.
            previous: Poses and times of the previous images of the k environments, from which the flow begins; where
                there was none, the flow is 0.

        Returns:
            Arrays (k, H, W, C).

        Raises:
            ConfigError: The world is unknown.
            GraphicsError: Off-screen OpenGL is not available.
        """
        count, wanted = len(T_world_imu), self._settings.kinds
        images: Images = {kind: np.zeros((count, *space.shape), space.dtype) for kind, space in self.spaces().items()}
        Ts_world_cam = T_world_imu @ self._T_imu_cam
        if not {"grey", "rgb"}.isdisjoint(wanted):
            self._observe_light(images, Ts_world_cam, t_ns)
        if not {"depth", "segmentation", "flow"}.isdisjoint(wanted):
            self._observe_surfaces(images, Ts_world_cam, t_ns, previous or ImagePoses.none(count))
        return images

    def close(self) -> None:
        """Release the renderers; the process keeps recently used worlds for other environments."""
        renderers, self._scenery, self._instances = (self._scenery, self._instances), None, None
        for renderer in renderers:
            if renderer is not None:
                renderer.lease.release()

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes without the renderers, which cannot be pickled."""
        return {**self.__dict__, "_scenery": None, "_instances": None}

    def _observe_light(self, images: Images, Ts_world_cam: Array, t_ns: Times | None) -> None:
        """Render grey levels and colours from poses (k, 4, 4)."""
        self._scenery = renderer = self._scenery or _Renderer.opened(lease_world(self._key), self._model)
        movers = renderer.mover_poses(t_ns, len(Ts_world_cam))
        renders = {"grey": renderer.camera.render, "rgb": renderer.camera.render_rgb}
        for kind in renders.keys() & images.keys():
            for image, T_world_cam, poses in zip(images[kind], Ts_world_cam, movers, strict=True):
                image[:] = renders[kind](T_world_cam, poses).reshape(image.shape)

    def _observe_surfaces(self, images: Images, Ts_world_cam: Array, t_ns: Times | None, previous: ImagePoses) -> None:
        """Render depth, segmentation and flow from poses (k, 4, 4), in the world without textures."""
        if self._instances is None:
            self._instances = _Renderer.opened(lease_instances(self._key.name, self._key.seed), self._model)
        renderer = self._instances
        movers = renderer.mover_poses(t_ns, len(Ts_world_cam))
        before, movers_before = previous.T_world_imu @ self._T_imu_cam, renderer.mover_poses(previous.t_ns, len(movers))
        for row, T_world_cam in enumerate(Ts_world_cam):
            if images.keys().isdisjoint(("depth", "segmentation")) and not previous.exists[row]:
                continue
            seen = renderer.camera.render_surfaces(T_world_cam, movers[row])
            if "depth" in images:
                farthest_m = np.float32(self._settings.depth_max_m)
                np.fmin(seen.depth_m, farthest_m, out=images["depth"][row, ..., 0])  # also for NaN
            if "segmentation" in images:
                images["segmentation"][row, ..., 0] = seen.geom + 1
            if "flow" in images and previous.exists[row]:
                poses, moved = (before[row], T_world_cam), (movers_before[row], movers[row])
                images["flow"][row] = flow_since(renderer.camera, seen, poses, moved)


class CameraSet:
    """Images of several cameras of a rig; implements `CameraObservation`."""

    def __init__(self, cameras: Mapping[int, RenderedObservation], names: Sequence[ImageName]) -> None:
        """Define the cameras.

        Args:
            cameras: Images of each camera by its index in the rig.
            names: The images in order.
        """
        self._cameras, self._names = cameras, tuple(names)

    def spaces(self) -> dict[str, spaces.Box]:
        """Return the spaces of the images of one environment by name."""
        return {str(name): self._cameras[name.camera].spaces()[name.kind] for name in self._names}

    def observe(self, T_world_imu: Array, t_ns: Times | None = None, previous: ImagePoses | None = None) -> Images:
        """Return the images of k environments by name; see `RenderedObservation.observe`."""
        images = {index: camera.observe(T_world_imu, t_ns, previous) for index, camera in self._cameras.items()}
        return {str(name): images[name.camera][name.kind] for name in self._names}

    def close(self) -> None:
        """Release the renderers."""
        for camera in self._cameras.values():
            camera.close()


def _space(kind: ImageKind, settings: ImageSettings) -> spaces.Box:
    """Return the space of an image of a kind."""
    shape = settings.height, settings.width, _CHANNELS[kind]
    if kind == "depth":
        return spaces.Box(0.0, settings.depth_max_m, shape, np.float32)
    if kind == "segmentation":
        return spaces.Box(0, _MOST_OBJECTS, shape, np.int32)
    if kind == "flow":
        bound = np.broadcast_to(np.array([settings.width, settings.height], np.float32), shape)
        return spaces.Box(-bound, bound, shape, np.float32)
    return spaces.Box(0, 255, shape, np.uint8)


def texture_reduction(camera: CameraModel) -> int:
    """Return the factor by which textures can be smaller for a camera, which sees them from one metre or more."""
    rendered_px_per_m = _SUPERSAMPLING * max(camera.central_focal_px) / _SHARP_FROM_M
    return next((factor for factor in _REDUCTIONS if rendered_px_per_m * factor <= PIXELS_PER_M), 1)
