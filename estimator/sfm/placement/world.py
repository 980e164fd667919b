"""World frame of a reconstruction: position, orientation and scale, which images alone do not determine.

Known poses determine all of them. Otherwise the baselines of a rig determine the scale. The IMU of a recording
determines the direction of gravity, and the scale unless a rig does. Without an IMU, the positions of photographs (GPS)
and ground control points determine a frame in east, north and up, and the scale unless a rig does. Without any of them,
the frame is arbitrary.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from dronevio.estimator.initialization.static import level_rotation
from dronevio.estimator.sfm.adjustment import BundleAdjustmentConfig, adjust
from dronevio.estimator.sfm.config import InertialConfig, SfmConfig
from dronevio.estimator.sfm.model import KnownPoses, Scene, SfmState
from dronevio.estimator.sfm.placement.gauge import aligned, transformed
from dronevio.estimator.sfm.placement.georeference import geo_origin, georeference
from dronevio.estimator.sfm.placement.inertial import InertialAlignment, align_with_imu
from dronevio.estimator.sfm.placement.rig import impose_rig, rig_poses
from dronevio.models.errors import ConfigError
from dronevio.models.geodesy import GeodeticPoint
from dronevio.models.georeference import GeoReference, PositionSource
from dronevio.models.image_sets import ImageSet
from dronevio.models.rotation import rotation_z, yaw_rad_from_matrix

Indices = npt.NDArray[np.int64]
ScaleSource = Literal["arbitrary", "rig", "imu", "poses", "earlier"] | PositionSource
"""What determines the unit of a reconstruction; if it is not arbitrary, the unit is the metre."""

MIN_POSES = 3
"""Smallest number of images with measured poses that determine a world frame."""
PRIOR_TOLERANCE = 1e-3
"""Relative decrease of the error at which the adjustment with measured poses stops."""


@dataclass(frozen=True)
class WorldFrame:
    """How the world frame of a reconstruction is determined."""

    scale: ScaleSource = "arbitrary"
    """What determines the scale."""
    is_vertical: bool = False
    """Whether the z axis points up."""
    imu: InertialAlignment | None = None
    """Gravity and scale by the IMU, None if it was not used."""
    note: str = ""
    """Why the IMU, or the positions of photographs, do not determine gravity or scale; empty if they do or were not
    used."""
    geo: GeoReference | None = None
    """How measured positions determine the frame, None if they were not used."""
    origin: GeodeticPoint | None = None
    """Where the origin is on Earth, if x points east, y north and z up; None if it is unknown."""

    @property
    def is_metric(self) -> bool:
        """Whether the unit is the metre."""
        return self.scale != "arbitrary"


def place(
    scene: Scene,
    state: SfmState,
    images: ImageSet,
    config: SfmConfig,
    poses: KnownPoses | None = None,
    origin: GeodeticPoint | None = None,
) -> tuple[SfmState, WorldFrame]:
    """Return a reconstruction in a world frame that is determined as well as possible, and how it is determined.

    Args:
        scene: The measurements.
        state: The reconstruction, of arbitrary scale unless some of its poses are fixed.
        images: The images, with the mounting of their cameras on a rig and the IMU.
        config: Settings.
        poses: Known poses of the images, None without any.
        origin: Origin of a frame by measured positions; by default that of the positions.

    Raises:
        ConfigError: The IMU, or measured positions, are required and do not determine gravity and scale.
    """
    cauchy_px = config.mapper.final_cauchy_sigmas * state.noise_px(scene)
    if poses is not None:
        known = int((poses.is_known & state.is_registered).sum())
        if poses.is_exact and (scene.is_fixed & state.is_registered).any():
            return state, WorldFrame("poses", poses.is_vertical)
        if not poses.is_exact and known >= MIN_POSES:
            adjustment = BundleAdjustmentConfig(relative_tolerance=PRIOR_TOLERANCE, cauchy_px=cauchy_px)
            state = adjust(scene, aligned(state, poses.Ts_world_cam), state.used(scene), adjustment, priors=poses)
            return state, WorldFrame("poses", poses.is_vertical)
    state, is_metric = impose_rig(scene, state, images, cauchy_px)
    world = WorldFrame("rig" if is_metric else "arbitrary")
    if config.inertial.use == "required" or (config.inertial.use != "off" and images.inertial is not None):
        return _level(state, images, config.inertial, world)
    if config.gps.use == "off" or (images.geotags is None and images.control_points is None):
        if config.gps.use == "required":
            raise ConfigError("images without positions, which are required; expected GPS tags or control points")
        return _level(state, images, config.inertial, world)
    rig = rig_poses(images, state.is_registered) if is_metric else []
    chosen = origin or geo_origin(images)
    state, geo, is_metric = georeference(scene, state, images, config, cauchy_px, chosen, rig)
    if isinstance(geo, str):
        if config.gps.use == "required":
            raise ConfigError(f"positions do not determine the world frame: {geo}")
        scale = world.scale if world.is_metric or not is_metric else "gps"
        return state, WorldFrame(scale, note=geo)
    return state, WorldFrame(world.scale if world.is_metric else geo.source, True, geo=geo, origin=chosen)


def _level(state: SfmState, images: ImageSet, config: InertialConfig, world: WorldFrame) -> tuple[SfmState, WorldFrame]:
    """Return a reconstruction with z up, and in metres unless it was before, as far as an IMU determines it.

    The origin of the new frame is the first position of the IMU, in arbitrary units that of the camera. The yaw of the
    first pose of the IMU is zero.
    """
    if config.use == "off":
        return state, world
    if images.inertial is None or images.t_ns is None or images.Ts_imu_cam is None:
        if config.use == "required":
            raise ConfigError("images without measurements of an IMU, which is required; expected a recording with one")
        return state, world
    # Gravity and scale by the IMU
    index = _one_per_frame(state, images)
    Ts_imu_cam = images.Ts_imu_cam[images.image_camera[index]]
    alignment = align_with_imu(
        images.t_ns[index], state.Ts_world_cam[index], Ts_imu_cam, images.inertial, config, world.is_metric
    )
    note, has_scale = _insufficient(alignment, config)
    if note and config.use == "required":
        raise ConfigError(f"the IMU does not determine gravity and scale: {note}")
    if isinstance(alignment, str) or np.degrees(alignment.tilt_sigma_rad) > config.max_tilt_sigma_deg:
        return state, replace(world, note=note)
    # Frame of the first image: levelled, with yaw zero, at the IMU
    R_world_imu = state.Ts_world_cam[index[0], :3, :3] @ Ts_imu_cam[0, :3, :3].T
    R = level_rotation(-alignment.gravity)
    R = rotation_z(-yaw_rad_from_matrix(R @ R_world_imu)) @ R
    state = transformed(state, alignment.scale if has_scale else 1.0, R, np.zeros(3))
    source: ScaleSource = "imu" if has_scale and not world.is_metric else world.scale
    # In arbitrary units, the distance between camera and IMU is unknown.
    lever = R @ R_world_imu @ Ts_imu_cam[0, :3, 3] if source != "arbitrary" else np.zeros(3)
    origin = state.Ts_world_cam[index[0], :3, 3] - lever
    return transformed(state, 1.0, np.eye(3), -origin), WorldFrame(source, True, alignment, note)


def _insufficient(alignment: InertialAlignment | str, config: InertialConfig) -> tuple[str, bool]:
    """Return why the IMU does not determine gravity or scale, empty if it does, and whether the scale is determined."""
    if isinstance(alignment, str):
        return alignment, False
    tilt_deg, scale_percent = float(np.degrees(alignment.tilt_sigma_rad)), 100.0 * alignment.scale_sigma
    if tilt_deg > config.max_tilt_sigma_deg:
        limit = f"{config.max_tilt_sigma_deg:g}°"
        return (
            f"the direction of gravity has a standard deviation of {tilt_deg:.1f}°; at most {limit} is allowed",
            False,
        )
    if alignment.scale <= 0.0 or alignment.scale_sigma > config.max_scale_sigma:
        deviation = f"the scale has a standard deviation of {scale_percent:.1f} %"
        limit = f"{100.0 * config.max_scale_sigma:g} %"
        return f"too little acceleration: {deviation}; at most {limit} is allowed", False
    return "", True


def _one_per_frame(state: SfmState, images: ImageSet) -> Indices:
    """Return the registered images in the order of time, one of each time."""
    assert images.t_ns is not None
    index = np.flatnonzero(state.is_registered)
    _, first = np.unique(images.t_ns[index], return_index=True)
    return np.asarray(index[first])
