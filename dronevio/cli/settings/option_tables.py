"""The settings that are options, and when somebody changes them: the tables of docs/how-to/tune.md.

A setting is an option if that page says when to change it. All others are changed with ``--set`` and ``--settings``.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

OptionTable = Mapping[str, str]
"""Names of settings relative to their group, such as ``smoother.max-keyframes``, and when to change them."""

ESTIMATOR: OptionTable = MappingProxyType(
    {
        "gravity-m-s2": "The flight is not near 45° of latitude at sea level, and one camera has to give lengths within"
        " half a percent.",
        "tracker.corners.cell-px": "The images are larger or smaller than 752×480: cells in proportion keep the number"
        " of features. Smaller cells give more features, which takes more time.",
        "tracker.corners.min-score": "Few features are found in hazy or weakly lit images: decrease.",
        "tracker.window-px": "Images have little texture or much noise: enlarge.",
        "tracker.pyramid-levels": "Features move by more than some 40 px beyond their prediction, as with large images"
        " or a poor IMU: one level more.",
        "tracker.ransac-threshold-px": "Good tracks are rejected, because the lens is calibrated poorly or the image is"
        " compressed: increase.",
        "preintegration.gyro-noise-inflation": "The gyroscope is noisier than its data sheet, or its stated noise"
        " contains the vibration already (then 1).",
        "preintegration.accel-noise-inflation": "The airframe vibrates more than usual (increase), or the stated noise"
        " of the accelerometer was measured in flight (then 1).",
        "zero-velocity.max-flow-px": "A tripod or a still hover is not recognized as rest, since images are noisy:"
        " increase. 0 turns zero-velocity updates off.",
        "initialization.static-window-s": "The vehicle rests for a shorter time before it takes off: decrease.",
        "initialization.dynamic.window-s": "Starts in motion fail for lack of parallax, as in slow or high flights:"
        " increase.",
        "keyframe.interval-s": "The motion is slower (increase) or faster (decrease) than that of a drone indoors.",
        "smoother.max-keyframes": "Accuracy counts more than time (increase), or time more than accuracy (decrease).",
        "smoother.pixel-sigma": "One camera whose images are blurred, compressed or poorly calibrated: increase.",
        "smoother.stereo-pixel-sigma": "Several cameras whose images are blurred, compressed or poorly calibrated:"
        " increase.",
        "landmarks.max-distance-m": "The scene is farther away than 60 m, as in high flights: increase.",
        "calibration.time-offset.online": "The clocks of cameras and IMU are one by hardware: off.",
        "calibration.time-offset.sigma": "The offset between the clocks is known to be less or more uncertain than 10"
        " ms.",
        "calibration.rotation.online": "The rotations from the IMU to the cameras are exact: off.",
        "calibration.rotation.sigma": "The rotations of the cameras are known to be less or more uncertain than 0.02"
        " rad.",
        "calibration.gravity.online": "The value of gravity at the place is exact: off.",
        "calibration.translation.online": "The positions of the cameras were measured by hand: on.",
        "calibration.focal.online": "The focal lengths are exact: off.",
        "calibration.principal.online": "The principal points are exact: off.",
        "health.max-inertial-sigma-m": "The flight passes through darkness: increase to go on with the IMU for longer.",
    }
)
"""Options of the odometry."""

MAP: OptionTable = MappingProxyType(
    {
        "places.features.corners": "Places are not recognized although they are seen again: increase, which takes more"
        " time.",
        "places.min-age-s": "Loops are shorter than ten seconds: decrease.",
        "places.verification.min-total-inliers": "Scenes that repeat give wrong loops (increase), or loops are missed"
        " where there is little texture (decrease).",
        "places.verification.max-distance-m": "Scenes are larger than rooms, as in high flights: increase.",
        "adjustment.rig-rotation-sigma-deg": "Several cameras whose relative orientation is exact (0) or poorly known.",
        "adjustment-schedule.enabled": "Only the map after the flight counts: off to adjust it just once.",
        "correction-delay.initial-s": "The odometry waits for the map on a slow computer (increase), or corrections"
        " have to come sooner (decrease).",
        "worker": "The computer has one core, or you debug: off.",
    }
)
"""Options of the map."""

SFM: OptionTable = MappingProxyType(
    {
        "features.max-features": "Images do not match (increase), or the reconstruction takes too long (decrease).",
        "features.contrast-threshold": "Surfaces have little texture: decrease.",
        "pairs.method": "The images are not what they seem: the names of a sequence are unordered, or all pairs are"
        " wanted.",
        "pairs.overlap": "A sequence moves slowly (increase) or fast (decrease).",
        "pairs.similar": "Places that are seen again are not connected: increase.",
        "matching.ratio": "Textures repeat (decrease), or images have few matches (increase).",
        "verification.min-inliers": "Scenes that look alike are joined wrongly: increase. Images with few matches stay"
        " unconnected: decrease.",
        "mapper.triangulation.min-angle-deg": "The cameras are close together compared with the distance of the scene:"
        " decrease.",
        "inertial.use": "The IMU of a recording is unreliable (off), or a result without metres is of no use"
        " (required).",
        "threads": "The computer has more than two cores.",
    }
)
"""Options of structure from motion."""

DENSE: OptionTable = MappingProxyType(
    {
        "views.max-side-px": "Details count (increase), or time does (decrease).",
        "views.neighbours": "Surfaces are occluded in many images (increase), or time counts (decrease).",
        "depth.levels": "The images are small: fewer levels.",
        "depth.directions": "Oblique surfaces such as floors are incomplete (increase), or time counts (0).",
        "consistency.min-views": "There are few images of each surface (decrease), or many wrong points (increase).",
        "spacing-px": "The points take too much memory (increase), or should be denser (decrease).",
        "mesh.voxel": "The mesh has to have a given resolution, in the unit of the reconstruction.",
        "mesh.max-voxels": "A large scene needs finer voxels, and the memory suffices: increase.",
        "mesh.min-triangles": "Small separate objects are missing (decrease), or specks float about (increase).",
        "threads": "The computer has more than two cores.",
    }
)
"""Options of multi-view stereo."""

DENSE_MAP: OptionTable = MappingProxyType(
    {
        "cell-m": "Openings are narrower than half a metre (decrease), or the memory of a large map counts (increase).",
        "range-m": "The stereo pair has a wide baseline or the scene is large: increase. Distant surfaces are rough:"
        " decrease.",
        "rate-hz": "The flight is fast or turns quickly (increase), or time counts (decrease).",
    }
)
"""Options of the dense map."""

EXPLORE: OptionTable = MappingProxyType(
    {
        "limits.speed-m-s": "The space is narrow or its surfaces have little texture (decrease), or it is open (up to"
        " 2.5 m/s: depth is used to 4 m).",
        "lowest-m": "The drone should fly above tables or through low openings.",
        "highest-m": "Ways lead over obstacles (increase), or the drone has to stay low (decrease).",
        "body.radius-m": "The vehicle is larger or smaller than the research quadrotor, or doors are narrower than a"
        " metre (decrease, at the cost of the margin).",
        "views": "Coverage is to be compared with that of nearest frontiers.",
        "plan-latency-s": "The computer of the drone plans faster or more slowly than within 0.2 s.",
    }
)
"""Options of flights through unknown worlds."""

OPTIONS = "options"
"""Key of a table in the metadata of a command's field, for the group of settings that it holds."""


def options_from(table: OptionTable) -> Mapping[str, Any]:
    """Return the metadata of a command's field for a group of settings of which only those of a table are options."""
    return {OPTIONS: table}
