"""Findings about the calibration: lenses, the rotation between camera and IMU, and the poses of the cameras."""

from collections.abc import Iterator

import numpy as np

from dronevio.inspection.measured import Measured, angle_deg
from dronevio.inspection.model import Finding, Topic, Verdict, graded, more_severe
from dronevio.inspection.stereo import StereoCheck
from dronevio.models.arrays import Array
from dronevio.models.rotation import log_so3

SUSPECT_ROTATION_DEG, WRONG_ROTATION_DEG = 3.0, 8.0
"""Mounting error beyond that of a bad mount, and one that online calibration does not correct [°]."""
SIGMAS = 4.0
"""Number of standard deviations by which a rotation must differ."""
MAX_SIGMA_DEG = 10.0
"""Largest standard deviation of a rotation that is stated [°]; more is a flight that turns about one axis."""
MIRROR_DEG = 12.0
"""Largest deviation from half a turn that is taken for mirrored images [°]."""
SUSPECT_LENS_PX, WRONG_LENS_PX = 6.0, 20.0
"""Displacement of features by the lens that agrees better: calibrated lenses err by less than the first near the
border, and the second is 5 % of a focal length of 400 px."""
MIN_COST_RATIO = 1.3
"""How much worse a lens must agree with the motion than a changed one; noise and gyroscope explain a few percent."""
SUSPECT_EPIPOLAR_PX, WRONG_EPIPOLAR_PX = 1.5, 5.0
"""Distance from the epipolar line beyond which the odometry refuses matches, and one that nothing corrects."""
MAX_BEHIND = 0.3
"""Share of points behind a camera that wrong matches explain."""


def calibration_findings(measured: Measured) -> Iterator[Finding]:
    """Yield the findings about the calibration."""
    if not measured.recording.rig.cameras:
        return
    yield _lens(measured)
    yield from _rotation(measured)
    for index, check in enumerate(measured.stereo, start=1):
        yield from _stereo(index, check)


def _lens(measured: Measured) -> Finding:
    """Return whether the first lens agrees with the motion."""
    lens, camera = measured.lens, measured.recording.rig.cameras[0].model
    expected = f"a lens that moves features by less than {SUSPECT_LENS_PX:g} px agrees best with motion and gyroscope"
    name = "lens of cam0"
    if lens is None:
        why = "images and gyroscope do not agree, or too few turn"
        return Finding(Topic.CALIBRATION, name, None, Verdict.UNKNOWN, why, expected)
    wrong = lens.cost_ratio > MIN_COST_RATIO
    verdict = graded(lens.change_px, SUSPECT_LENS_PX, WRONG_LENS_PX) if wrong else Verdict.GOOD
    if verdict is Verdict.GOOD:
        found = f"{camera.lens}, f = {camera.fx:.0f} px: no lens that differs clearly agrees better with the motion"
        return Finding(Topic.CALIBRATION, name, lens.change_px, verdict, found, expected)
    # Angles that are s times as large are those of a focal length of f / s.
    found = (
        f"the motion agrees {lens.cost_ratio:.1f} times better with f = {camera.fx / lens.scale:.0f} px instead of"
        f" {camera.fx:.0f} and a distortion that differs by {lens.cubic:+.2f} θ²; features move by"
        f" {lens.change_px:.0f} px"
    )
    off_scale = abs(lens.scale - 1.0) > 0.05
    what = "the focal length is wrong" if off_scale else "the distortion is wrong"
    advice = f"{what}: use the calibration of this lens at this size of the image, or calibrate it anew"
    return Finding(Topic.CALIBRATION, name, lens.change_px, verdict, found, expected, advice)


def _rotation(measured: Measured) -> Iterator[Finding]:
    """Yield whether axes are reflected, and whether the rotation between camera and IMU is the calibrated one."""
    relation, name = measured.relation, "rotation of camera and IMU"
    expected = f"within {SUSPECT_ROTATION_DEG:g}° of the rotation that the motion shows, the error of a bad mount"
    course = measured.course
    stepped = course is not None and course.step_is_significant
    if relation is None or not (measured.belongs or stepped):
        why = "images and gyroscope do not agree"
        yield Finding(Topic.CALIBRATION, name, None, Verdict.UNKNOWN, why, expected)
        return
    certain = relation.proper_ratio < 0.5 or relation.proper_ratio > 2.0
    yield Finding(
        Topic.CALIBRATION,
        "handedness of the gyroscope",
        relation.proper_ratio,
        Verdict.WRONG if certain and relation.is_reflected else Verdict.GOOD if certain else Verdict.UNKNOWN,
        "the gyroscope turns as if seen in a mirror: two of its axes are exchanged, or one or all are reversed"
        if certain and relation.is_reflected
        else "right-handed"
        if certain
        else "the flight turns about too few axes to tell",
        "right-handed axes",
        "check order and signs of the axes of the gyroscope" if certain and relation.is_reflected else "",
    )
    if certain and relation.is_reflected:
        yield Finding(Topic.CALIBRATION, name, None, Verdict.UNKNOWN, "the gyroscope's axes are reflected", expected)
        return
    sigma_deg = float(np.degrees(relation.rotation_sigma_rad))
    R_cam_imu = relation.Q if not relation.is_reflected else -relation.Q
    error = R_cam_imu @ measured.recording.rig.cameras[0].T_imu_cam[:3, :3]
    if sigma_deg > MAX_SIGMA_DEG or not certain:
        yield Finding(
            Topic.CALIBRATION, name, None, Verdict.UNKNOWN, "the flight turns about too few axes to tell", expected
        )
        return
    difference = angle_deg(error)
    lens_is_wrong = measured.lens is not None and measured.lens.cost_ratio > MIN_COST_RATIO
    limit = max(SUSPECT_ROTATION_DEG * (2.0 if lens_is_wrong else 1.0), SIGMAS * sigma_deg)
    verdict = graded(difference, limit, max(WRONG_ROTATION_DEG, limit))
    x, y, z = np.degrees(log_so3(R_cam_imu.T)).tolist()
    found = (
        f"{difference:.1f} ± {sigma_deg:.1f}° from the calibration; the motion shows R_imu_cam = exp({x:.1f}, {y:.1f},"
    )
    found += f" {z:.1f})°"
    advice = "" if verdict is Verdict.GOOD else "correct the rotation of T_imu_cam (T_BS, T_cam_imu) as stated"
    mirror = _mirror(error, difference)
    if mirror:
        found += f"; {mirror} look the same"
        advice = f"{mirror}: undo that, or correct the rotation of T_imu_cam if the camera does look backwards"
    yield Finding(Topic.CALIBRATION, name, difference, verdict, found, expected, advice)


def _mirror(error: Array, difference_deg: float) -> str:
    """Return how the images are mirrored if an error of the rotation (3, 3) has this effect; empty otherwise.

    In a mirror, the rotation about the axis that is reversed keeps its sign, and the two others change theirs: half a
    turn about the image's x axis for images that are reversed from left to right.
    """
    if difference_deg < 180.0 - MIRROR_DEG:
        return ""
    axis = np.argmax(np.abs(np.linalg.eigh(error + error.T)[1][:, -1]))
    return {0: "images mirrored left to right", 1: "images mirrored top to bottom"}.get(int(axis), "")


def _stereo(index: int, check: StereoCheck | None) -> Iterator[Finding]:
    """Yield whether a further camera agrees with the first one."""
    name, expected = (
        f"pose of cam{index} and cam0",
        f"matches within {SUSPECT_EPIPOLAR_PX:g} px of their epipolar lines",
    )
    if check is None:
        why = "no view in common, or too few features"
        yield Finding(Topic.CALIBRATION, name, None, Verdict.UNKNOWN, why, expected)
        return
    swapped = check.behind > MAX_BEHIND
    verdict = graded(check.error_px, SUSPECT_EPIPOLAR_PX, WRONG_EPIPOLAR_PX)
    verdict = more_severe(verdict, Verdict.WRONG if swapped else Verdict.GOOD)
    found = f"{check.error_px:.2f} px (median of {check.matches} matches)"
    if verdict is not Verdict.GOOD:
        found += f"; {check.best_px:.2f} px with the cameras turned by {check.rotation_deg:.1f}°"
    if swapped:
        found += f"; {100 * check.behind:.0f} % of the points lie behind a camera"
    advice = ""
    if swapped:
        advice = "the cameras are swapped, or their images are mirrored: exchange their folders or topics"
    elif verdict is not Verdict.GOOD:
        advice = "correct the poses of the cameras, or their lenses, or calibrate the pair anew"
    yield Finding(Topic.CALIBRATION, name, check.error_px, verdict, found, expected + ", in front of both", advice)
