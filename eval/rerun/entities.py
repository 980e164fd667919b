"""Where in a recording things are."""

from typing import NamedTuple

import rerun as rr

ROOM = "world/room"
MOVERS = "world/movers"
TRUE_WHOLE = "world/truth/whole"
TRUE_FLOWN = "world/truth/flown"
ESTIMATES = "world/estimates"
RIG = "world/rig"
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


def camera(index: int) -> str:
    """Return where a camera of the rig is."""
    return f"{RIG}/cam{index}"


def image(index: int) -> str:
    """Return where the images of a camera are."""
    return f"{RIG}/cam{index}/image"


class ErrorEntities(NamedTuple):
    """The curves of one kind of error of one estimator."""

    aligned: str
    """After alignment."""
    tied: str
    """Tied to the truth at the first pose."""
    band: str
    """Three standard deviations, as claimed."""


class EstimateEntities:
    """Where the things of one estimator are."""

    def __init__(self, name: str) -> None:
        """Take the estimator's name."""
        self.part = rr.escape_entity_path_part(name)
        root = f"{ESTIMATES}/{self.part}"
        self.whole, self.flown = f"{root}/path/whole", f"{root}/path/flown"
        self.body, self.covariance = f"{root}/imu", f"{root}/covariance"
        self.keyframes, self.loops, self.markers = f"{root}/keyframes", f"{root}/loops", f"{root}/events"
        self.map, self.map_in_sight = f"{root}/map/all", f"{root}/map/in_sight"
        self.tracks = f"{image(0)}/tracks/{self.part}"
        self.events, self.health = f"{EVENTS}/{self.part}", f"{HEALTH}/{self.part}"
        self.speed = f"{SPEED}/{self.part}"
        self.gyro_bias, self.accel_bias = f"{GYRO_BIAS}/{self.part}", f"{ACCEL_BIAS}/{self.part}"
        self.cost, self.track_count = f"{COST}/{self.part}", f"{TRACK_COUNT}/{self.part}"
        self.position_error = self._errors(POSITION_ERROR)
        self.orientation_error = self._errors(ORIENTATION_ERROR)

    def _errors(self, kind: str) -> ErrorEntities:
        return ErrorEntities(*(f"{kind}/{self.part}/{curve}" for curve in ("aligned", "tied", "three_sigma")))
