"""Settings of an environment: task, vehicle, world, sensors, actions, observations, randomization and rates."""

from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any

from dronevio.models.actions import ACTION_MODES, ActionLimits
from dronevio.models.errors import ConfigError, unknown_name
from dronevio.models.quadrotor import RESEARCH, Quadrotor
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.vehicles import check_vehicle, vehicle_of
from dronevio.sim.envs.episodes.randomization import NOTHING_RANDOM, Randomization, RandomizedParameters
from dronevio.sim.envs.sensing.camera_observation import (
    CameraObservation,
    CameraSet,
    ImageKind,
    ImageName,
    ImageSettings,
    RenderedObservation,
)
from dronevio.sim.envs.sensing.depth_errors import EXACT, DepthErrors
from dronevio.sim.envs.sensing.estimation import CameraSetup, Estimation, EstimatorFactory
from dronevio.sim.envs.sensing.observations import OwnObservation
from dronevio.sim.envs.sensing.range_beams import DEFAULT_BEAMS, BeamSettings
from dronevio.sim.envs.sensing.ray_maps import MapSettings
from dronevio.sim.envs.sensing.world_objects import WorldObjects, world_objects
from dronevio.sim.envs.tasks import AnyTask, Hover, task_named
from dronevio.sim.physics.wind import CALM, Wind
from dronevio.sim.world import resolved_world


@dataclass(frozen=True, eq=False)
class EnvironmentSettings(Settings):
    """Settings that all environments have; each is a keyword argument of `gymnasium.make`."""

    task: AnyTask = field(default_factory=Hover)
    """Task, or its name: ``hover``, ``waypoints``, ``track``, ``race``, ``navigate``, ``explore``, ``vio-hover``
    or ``vio-navigate``."""
    world: str = ""
    """Name of the world; that of the task by default. ``dronevio worlds`` lists all. A world of one's own is a file,
    such as ``yard.yaml`` or ``yard.xml`` (MJCF), or ``python:package.module:NAME``."""
    world_seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the layout of the world, and of its textures unless they are randomized."""
    vehicle: Quadrotor = RESEARCH
    """Vehicle, or a text: ``research``, ``nano``, the name of a file such as ``my-hexa.yaml`` (see
    `dronevio.models.vehicles`), or ``python:package.module:NAME``."""
    rig: Rig = field(default_factory=euroc_rig)
    """Cameras and IMU with their mounting, or the name of a rig such as ``euroc-stereo``; those of EuRoC's drone by
    default."""
    wind: Wind = CALM
    """Mean wind and gusts, to which those of the randomization are added."""
    action: str = ""
    """Action mode: ``rotors``, ``rates``, ``attitude``, ``velocity`` or ``position``; that of the task by default."""
    action_limits: ActionLimits = field(default_factory=ActionLimits)
    """Largest rates, tilt and velocities that actions command."""
    observations: tuple[str | OwnObservation, ...] = ()
    """Names of the observations, see `dronevio.sim.envs.sensing.observations`, or observations of one's own; those of
    the task by default."""
    privileged: tuple[str | OwnObservation, ...] = ()
    """Further observations for a critic. The observation is then a ``Dict`` with the entries ``policy`` and
    ``critic``."""
    flat: bool = False
    """Whether the observation is one vector, with the observations in the order of their names, instead of a
    ``Dict``."""
    randomization: Randomization = NOTHING_RANDOM
    """Distributions of the parameters that are drawn for each episode."""
    camera: Annotated[int, Range(0, 15)] = 0
    """Index of the camera of the rig whose images are observed."""
    image_size: Annotated[tuple[int, int], Range(1, 4096)] = (64, 64)
    """Width and height of images [px]: the largest centred part of the camera's image with their ratio of sides."""
    depth_errors: DepthErrors = EXACT
    """Errors of the observation ``depth``, such as `STEREO_DEPTH`; none by default."""
    imu_rate_hz: Annotated[float, Range(1.0, 10_000.0)] = 0.0
    """Rate of IMU samples and of the inner control loops [Hz]; that of the rig by default."""
    action_rate_hz: Annotated[float, Range(0.1, 10_000.0)] = 50.0
    """Rate of the actions, a fraction of that of the IMU [Hz]."""
    camera_rate_hz: Annotated[float, Range(0.1, 10_000.0)] = 0.0
    """Rate of images, a fraction of that of the actions [Hz]; in between, the last image is repeated, also that of the
    flow since the image before. That of the actions by default."""
    estimator: EstimatorFactory | None = None
    """Function that returns an estimator for a rig; the policy and the inner control loops then see its estimate
    instead of the true state, see `dronevio.sim.envs.sensing.estimation`. None uses the true state."""
    estimation: Estimation = field(default_factory=Estimation)
    """Settings of the estimator in the loop: latency, longest wait, darkness and image sensors."""
    mapping: MapSettings = field(default_factory=MapSettings)
    """Settings of the map, of a task or with the observation ``local_map``: rays, cells and observed part."""
    beams: BeamSettings = DEFAULT_BEAMS
    """Settings of the range sensor, with the observation ``ranges``: directions, reach and errors."""
    threads: Annotated[int, Range(0, 1024)] = 1
    """Number of threads of the physics; 0 means one for each processor. Results do not depend on it."""

    def __post_init__(self) -> None:
        """Check names, rates and combinations.

        Raises:
            ConfigError: A value is unknown or not possible, or two values exclude each other.
        """
        super().__post_init__()
        if self.action not in ACTION_MODES:
            raise unknown_name("action mode", self.action, ACTION_MODES)
        groups: dict[str, Any] = {"observations": self.observations, "privileged": self.privileged}
        for name, group in groups.items():
            if isinstance(group, str):
                raise ConfigError(f"{name} = {group!r}; expected a tuple of names, such as ({group!r},)")
            names = _names(group)
            if len(set(names)) < len(names):
                raise ConfigError(f"{name} = {', '.join(names)}; expected each name once")
        images = self.images
        if self.flat and images:
            raise ConfigError(f"flat observations with {images[0].text!r}; expected no images, or flat=False")
        cameras = len(self.rig.cameras)
        if images and not cameras:
            raise ConfigError(f"observation {images[0].text!r} of a rig without cameras; expected a camera")
        for image in images:
            if ":" in image.text and image.camera >= cameras:
                raise ConfigError(
                    f"observation {image.text!r} of a rig with {cameras} cameras; expected an index from 0"
                )
        if self.camera not in range(max(cameras, 1)):
            raise ConfigError(f"camera = {self.camera} of a rig with {cameras} cameras; expected an index from 0")
        if self.estimator is not None and not self.rig.cameras:
            raise ConfigError("estimator with a rig without cameras; expected a camera")
        if self.estimator is not None and not self.task.lands:
            raise ConfigError(
                f"estimator with the task {type(self.task).__name__}, which starts in the air; expected one that starts"
                " standing, such as vio-hover or vio-navigate"
            )
        if self.has_map and not cameras:
            raise ConfigError("a map with a rig without cameras; expected a camera")
        if self.has_map and self.estimator is not None:
            raise ConfigError("a map of true poses with an estimator; expected observations without 'local_map'")
        if self.has_map:
            _require_fraction("mapping.rate_hz", self.mapping.rate_hz, "action_rate_hz", self.action_rate_hz)
        if self.has_beams:
            _require_fraction("beams.rate_hz", self.beams.rate_hz, "action_rate_hz", self.action_rate_hz)
        _require_fraction("action_rate_hz", self.action_rate_hz, "imu_rate_hz", self.imu_rate_hz)
        _require_fraction("camera_rate_hz", self.camera_rate_hz, "action_rate_hz", self.action_rate_hz)

    @property
    def samples(self) -> int:
        """Number of IMU samples per action."""
        return round(self.imu_rate_hz / self.action_rate_hz)

    @property
    def observed(self) -> tuple[str, ...]:
        """Names of all observations, those of the policy first."""
        return (*self.policy_names, *self.critic_names)

    @property
    def policy_names(self) -> tuple[str, ...]:
        """Names of the observations of the policy."""
        return _names(self.observations)

    @property
    def critic_names(self) -> tuple[str, ...]:
        """Names of the observations of the critic."""
        return _names(self.privileged)

    @property
    def own_observations(self) -> dict[str, OwnObservation]:
        """Observations of one's own by name."""
        return {one.name: one for one in (*self.observations, *self.privileged) if not isinstance(one, str)}

    @property
    def images(self) -> tuple[ImageName, ...]:
        """All observed images."""
        named = (ImageName.parsed(name, self.camera) for name in self.observed)
        return tuple(image for image in named if image is not None)

    @property
    def objects(self) -> WorldObjects:
        """Names and kinds of the objects of the world by their numbers in images of ``segmentation``.

        Raises:
            ConfigError: The world is unknown.
        """
        return world_objects(self.world, self.world_seed)

    @property
    def depth_focal_px(self) -> dict[str, float]:
        """Focal lengths of the observed depth images by name [px]."""
        models = {each.text: self.rig.cameras[each.camera].model for each in self.images if each.kind == "depth"}
        return {name: float(model.fitted(*self.image_size).central_focal_px[0]) for name, model in models.items()}

    @property
    def has_map(self) -> bool:
        """Whether the environment maps, for its task or for the observation ``local_map``."""
        return self.task.maps or "local_map" in self.observed

    @property
    def has_beams(self) -> bool:
        """Whether the environment has range sensors."""
        return "ranges" in self.observed

    @property
    def steps_per_ranging(self) -> int:
        """Number of actions from one measurement of the range sensor to the next."""
        return round(self.action_rate_hz / self.beams.rate_hz)

    @property
    def steps_per_cast(self) -> int:
        """Number of actions from one cast of the rays of the map to the next."""
        return round(self.action_rate_hz / self.mapping.rate_hz)

    @property
    def has_imu(self) -> bool:
        """Whether the policy, a critic or an estimator receives measurements of the IMU."""
        return self.estimator is not None or not {"imu", "imu_bias"}.isdisjoint(self.observed)

    @property
    def steps_per_image(self) -> int:
        """Number of actions from one image to the next."""
        return round(self.action_rate_hz / self.camera_rate_hz)

    @property
    def episode_steps(self) -> int:
        """Number of actions until the time limit of the task."""
        return round(self.task.episode_s * self.action_rate_hz)

    def image_source(self, world_seed: int, texture_seed: int) -> CameraObservation:
        """Return the renderer of the observed images, of the world with a seed, and with a seed of its textures."""
        kinds: dict[int, dict[ImageKind, None]] = {}
        for image in self.images:
            kinds.setdefault(image.camera, {})[image.kind] = None
        cameras = {
            index: RenderedObservation(
                self.rig.cameras[index],
                self.world,
                world_seed,
                ImageSettings(tuple(of_camera), *self.image_size),
                texture_seed,
            )
            for index, of_camera in kinds.items()
        }
        return CameraSet(cameras, self.images)

    def cameras_of_episode(self, randomized: RandomizedParameters, noise_seed: int) -> CameraSetup:
        """Return the true cameras of an episode, with drawn mounting errors, light and textures.

        Args:
            randomized: Randomization of the episode, one row.
            noise_seed: Seed of the image noise.
        """
        error = pose_matrix(exp_so3(randomized.camera_rotation_rad[0]), randomized.camera_translation_m[0])
        cameras = tuple(replace(camera, T_imu_cam=error @ camera.T_imu_cam) for camera in self.rig.cameras)
        imaging = self.estimation.imaging
        return CameraSetup(
            rig=replace(self.rig, cameras=cameras),
            world=self.world,
            world_seed=int(randomized.world_seed[0]),
            texture_seed=int(randomized.texture_seed[0]),
            noise_seed=noise_seed,
            # the light of a frame is irradiance × exposure time / nominal exposure time
            imaging=replace(imaging, nominal_exposure_s=imaging.nominal_exposure_s / float(randomized.light[0])),
        )


def settings_of(
    task: AnyTask | str = "hover", vehicle: Quadrotor | str = RESEARCH, rig: Rig | str | None = None, **others: Any
) -> EnvironmentSettings:
    """Return settings, with the defaults of the task for values that are not given.

    Args:
        task: Task or name of a task.
        vehicle: Vehicle, name of a vehicle, or file (`vehicle_of`).
        rig: Cameras and IMU, or the name of a rig such as ``euroc-stereo``; those of EuRoC's drone by default.
        others: Other fields of `EnvironmentSettings` by name.

    Raises:
        ConfigError: A name is unknown, a value is not possible, or the vehicle cannot fly.
        InputError: The file of the vehicle is missing or wrong.
    """
    known = {one.name for one in fields(EnvironmentSettings)}
    unknown = sorted(set(others) - known)
    if unknown:
        raise ConfigError(f"unknown argument {unknown[0]!r}; expected some of {', '.join(sorted(known))}")
    chosen = task_named(task) if isinstance(task, str) else task
    rig = rig_named(rig) if isinstance(rig, str) else rig or euroc_rig()
    imu_rate_hz = others.pop("imu_rate_hz", 0.0) or rig.imu.rate_hz
    action_rate_hz = others.pop("action_rate_hz", 50.0)
    return EnvironmentSettings(
        task=chosen,
        world=resolved_world(others.pop("world", "") or chosen.world),
        vehicle=_vehicle(vehicle),
        rig=replace(rig, imu=replace(rig.imu, rate_hz=imu_rate_hz)),
        action=others.pop("action", "") or chosen.default_action,
        observations=others.pop("observations", ()) or chosen.default_observations,
        imu_rate_hz=imu_rate_hz,
        action_rate_hz=action_rate_hz,
        camera_rate_hz=others.pop("camera_rate_hz", 0.0) or action_rate_hz,
        **others,
    )


def _vehicle(vehicle: Quadrotor | str) -> Quadrotor:
    """Return a vehicle that can fly.

    Raises:
        ConfigError: There is no such vehicle, or it cannot fly.
    """
    if isinstance(vehicle, str):
        return vehicle_of(vehicle)
    check_vehicle(vehicle)
    return vehicle


def _names(observations: Iterable[str | OwnObservation]) -> tuple[str, ...]:
    """Return the names of observations."""
    return tuple(one if isinstance(one, str) else one.name for one in observations)


def _require_fraction(name: str, rate_hz: float, of: str, whole_hz: float) -> None:
    """Raise ConfigError unless a rate is positive and a fraction 1/k of another one."""
    if not (rate_hz > 0.0 and whole_hz > 0.0 and abs(whole_hz / rate_hz - round(whole_hz / rate_hz)) < 1e-9):
        raise ConfigError(f"{name} = {rate_hz:g} with {of} = {whole_hz:g}; expected a fraction 1/k of it, k = 1, 2, 3")
