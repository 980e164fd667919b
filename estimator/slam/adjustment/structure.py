"""The structure of a map: its landmarks at the final poses of the keyframes, and the images that observe them.

Landmarks are triangulated from all observations, those of loops included, as at the start of bundle adjustment.
Observations with a large reprojection error are then left out, and the others are triangulated again.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.observations import ObservationTable
from dronevio.estimator.slam.adjustment.bundle_adjustment import (
    AdjustmentConfig,
    AdjustmentInputs,
    map_observations,
    triangulated,
)
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array, Integers
from dronevio.models.camera import CameraModel
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions.recorded import RecordedReconstruction, image_name

MAX_ERROR_PX = 2.0
"""Largest reprojection error of an observation [px]: five standard deviations of an aligned patch."""
NO_COLOUR = 128
"""Gray value of the points until images are read."""


def map_structure(inputs: AdjustmentInputs, config: AdjustmentConfig, stamps_ns: Integers) -> RecordedReconstruction:
    """Return the keyframes of a map and their landmarks as a reconstruction in the map frame.

    Pixels are those of a camera with a global shutter that is exposed at the time of the keyframe: the observations of
    rolling shutters, and of cameras with time offsets of their own, are moved to where they would be then.

    Args:
        inputs: The measurements of the map, with its final poses.
        config: Settings of bundle adjustment: the smallest number of views and the smallest parallax.
        stamps_ns: (K,) Time stamps of the frames of the keyframes [ns].
    """
    cameras = tuple(_corrected_model(inputs.calibration, index) for index in range(len(inputs.calibration.rig.cameras)))
    images = Reconstruction(
        cameras=cameras,
        image_names=tuple(image_name(index, t_ns) for t_ns in stamps_ns.tolist() for index in range(len(cameras))),
        image_camera=np.tile(np.arange(len(cameras)), len(stamps_ns)),
        Ts_world_cam=np.concatenate([k.T_map_imu @ inputs.calibration.Ts_imu_cam for k in inputs.keyframes]),
        points=np.zeros((0, 3)),
        colours=np.zeros((0, 3), np.uint8),
        observation_image=np.zeros(0, np.int64),
        observation_point=np.zeros(0, np.int64),
        observation_px=np.zeros((0, 2)),
    )
    numbers = np.array([keyframe.number for keyframe in inputs.keyframes], dtype=np.int64)
    table = map_observations(inputs, config)
    while True:
        table, landmarks = triangulated(table, inputs, config)
        structure = _with_landmarks(images, numbers, table, landmarks)
        is_wrong = _is_wrong(structure)
        if not is_wrong.any():
            return RecordedReconstruction(structure, np.repeat(stamps_ns, len(cameras)), inputs.calibration.Ts_imu_cam)
        table = table[~is_wrong]


def _is_wrong(structure: Reconstruction) -> npt.NDArray[np.bool_]:
    """Return which observations (M,) to leave out in this round.

    A wrong one moves its point, so that right ones seem wrong, too, but less so.
    """
    errors = np.nan_to_num(structure.reprojection_errors_px(), nan=np.inf)
    largest = np.zeros(len(structure.points))
    np.maximum.at(largest, structure.observation_point, errors)
    return np.asarray((errors > MAX_ERROR_PX) & (errors >= 0.5 * largest[structure.observation_point]))


def _with_landmarks(
    images: Reconstruction, numbers: Integers, table: ObservationTable, landmarks: Mapping[int, Array]
) -> Reconstruction:
    """Return a reconstruction with landmarks.

    Args:
        images: A reconstruction without points, whose images are those of all cameras at each keyframe.
        numbers: (K,) Numbers of the keyframes, increasing.
        table: The observations of the landmarks.
        landmarks: Their positions (3,) by their identities, in increasing order.
    """
    ids = np.array(list(landmarks), dtype=np.int64)
    pixels = np.zeros((len(table), 2))
    for index, camera in enumerate(images.cameras):
        rows = table.camera == index
        pixels[rows] = camera.project(np.column_stack([table.xy[rows], np.ones(rows.sum())]))
    return replace(
        images,
        points=np.array(list(landmarks.values())).reshape(-1, 3),
        colours=np.full((len(ids), 3), NO_COLOUR, np.uint8),
        observation_image=len(images.cameras) * np.searchsorted(numbers, table.keyframe) + table.camera,
        observation_point=np.searchsorted(ids, table.landmark),
        observation_px=pixels,
    )


def _corrected_model(calibration: Calibration, index: int) -> CameraModel:
    """Return the model of a camera with its corrected intrinsics.

    The corrections are those of undistorted coordinates; where the lens distorts, they are exact at the axis. Lenses
    whose first coefficient is not that of the third order of the radius keep it.
    """
    model = calibration.rig.cameras[index].model
    corrections = calibration.intrinsics
    if corrections is None:
        return model
    (fx, fy), focal, (x, y) = model.central_focal_px, 1.0 + corrections.focal[index], corrections.principal[index]
    distortion = model.distortion
    if model.lens in ("radtan", "equidistant"):
        distortion = (distortion[0] + float(corrections.radial[index]), *distortion[1:])
    return replace(
        model,
        fx=focal * model.fx,
        fy=focal * model.fy,
        cx=model.cx + fx * x,
        cy=model.cy + fy * y,
        distortion=distortion,
    )
