"""Paths of the entities of a recording."""

from typing import NamedTuple

import rerun as rr

SURROUNDINGS = "world/surroundings"
MOVING_OBJECTS = "world/moving_objects"
TRUE_PATH = "world/truth/path"
TRUE_PATH_SO_FAR = "world/truth/path_so_far"
ESTIMATES = "world/estimates"
RIG = "world/rig"
TRUE_BODY = f"{RIG}/body"
EVENTS = "events"
HEALTH = "health"
GYRO = "imu/gyroscope"
ACCEL = "imu/accelerometer"
GYRO_BIAS = "bias/gyroscope"
ACCEL_BIAS = "bias/accelerometer"
SPEED = "speed"
POSITION_ERROR = "error/position"
ORIENTATION_ERROR = "error/orientation"
COST = "cost/cpu"
TRACK_COUNT = "cost/tracks"
SUMMARY = "summary"
CORRECTION_POSITION = "correction/position"
CORRECTION_YAW = "correction/yaw"
LOOP_COUNT = "loops"


def camera(index: int) -> str:
    """Return the path of a camera of the rig."""
    return f"{RIG}/cam{index}"


def image(index: int) -> str:
    """Return the path of the images of a camera."""
    return f"{RIG}/cam{index}/image"


class ErrorEntities(NamedTuple):
    """Paths of the curves of one kind of error of one estimator."""

    aligned: str
    """Path of the error after alignment."""
    anchored: str
    """Path of the error with yaw and position anchored at the first pose."""
    three_sigma: str
    """Path of three estimated standard deviations."""


class MapEntities:
    """Paths of the entities of the map of one estimator."""

    def __init__(self, name: str) -> None:
        """Take the name of the estimator."""
        part = rr.escape_entity_path_part(name)
        self.root = f"{ESTIMATES}/{part}/map"
        self.path, self.path_so_far = f"{self.root}/path", f"{self.root}/path_so_far"
        self.points = f"{self.root}/points"
        self.graph_before, self.graph_after = f"{self.root}/graph/before", f"{self.root}/graph/after"
        self.loops, self.rejected_loops = f"{self.root}/loops/closed", f"{self.root}/loops/rejected"
        self.position, self.yaw = f"{CORRECTION_POSITION}/{part}", f"{CORRECTION_YAW}/{part}"
        self.loop_count = f"{LOOP_COUNT}/{part}"


class EstimateEntities:
    """Paths of the entities of one estimator."""

    def __init__(self, name: str) -> None:
        """Take the name of the estimator."""
        self.part = rr.escape_entity_path_part(name)
        root = f"{ESTIMATES}/{self.part}"
        self.path, self.path_so_far = f"{root}/path", f"{root}/path_so_far"
        self.imu, self.covariance = f"{root}/imu", f"{root}/covariance"
        self.body = f"{self.imu}/body"
        self.keyframes, self.loops, self.event_markers = f"{root}/keyframes", f"{root}/loops", f"{root}/events"
        self.landmarks, self.visible_landmarks = f"{root}/landmarks/all", f"{root}/landmarks/visible"
        self.tracks = f"{image(0)}/tracks/{self.part}"
        self.events, self.health = f"{EVENTS}/{self.part}", f"{HEALTH}/{self.part}"
        self.speed = f"{SPEED}/{self.part}"
        self.gyro_bias, self.accel_bias = f"{GYRO_BIAS}/{self.part}", f"{ACCEL_BIAS}/{self.part}"
        self.cost, self.track_count = f"{COST}/{self.part}", f"{TRACK_COUNT}/{self.part}"
        self.map = MapEntities(name)
        self.position_error = self._errors(POSITION_ERROR)
        self.orientation_error = self._errors(ORIENTATION_ERROR)

    def _errors(self, kind: str) -> ErrorEntities:
        return ErrorEntities(*(f"{kind}/{self.part}/{curve}" for curve in ErrorEntities._fields))


IMAGE_TIMELINE = "image"
"""Timeline of a recording of a reconstruction: the number of the image."""
CURRENT_IMAGE = "image"
KEYPOINTS = f"{CURRENT_IMAGE}/keypoints"
RESIDUALS = f"{CURRENT_IMAGE}/residuals"


class ComponentEntities:
    """Paths of the entities of one component of a reconstruction."""

    def __init__(self, index: int) -> None:
        """Take the index of the component."""
        self.root = f"component{index}"
        self.points, self.observed_points = f"{self.root}/points", f"{self.root}/observed_points"
        self.current_camera = f"{self.root}/current_camera"

    def camera(self, image_name: str) -> str:
        """Return the path of the camera of an image."""
        return f"{self.root}/cameras/{rr.escape_entity_path_part(image_name)}"
