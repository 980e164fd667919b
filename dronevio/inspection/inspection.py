"""The inspection of a recording: all findings and the page."""

from pathlib import Path

import cv2
import numpy as np

from dronevio.eval.run import EstimatorRun
from dronevio.inspection.calibration import calibration_findings
from dronevio.inspection.cameras import camera_findings
from dronevio.inspection.clocks import clock_findings
from dronevio.inspection.defects import defect_findings
from dronevio.inspection.details import Details
from dronevio.inspection.imu import imu_findings
from dronevio.inspection.inertial import allan_deviation, resting, spectrum_of
from dronevio.inspection.measured import Measured, measure
from dronevio.inspection.model import Finding, Inspection, Topic
from dronevio.inspection.motion import motion_findings
from dronevio.inspection.odometry import odometry_findings, run_odometry
from dronevio.inspection.truth import truth_findings
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.progress import Stages, silent_stages
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording


def inspect(recording: Recording | str | Path, *, run: bool = False, progress: Stages = silent_stages) -> Inspection:
    """Inspect a recording: whether the odometry will work on it, and what is wrong.

    The time stamps and all IMU samples are read, and about 240 frames, in runs spread over the recording.

    Args:
        recording: A recording, or the path of one, which is read in spite of defects. Where the clock steps, the
            longest segment is inspected.
        run: Whether the odometry is run over the first 30 s as well.
        progress: Returns the callback for the progress of a stage by its name.

    Returns:
        The findings with their verdicts, a summary and the page.

    Raises:
        InputError: The recording cannot be read at all.
        ConfigError: The argument is of another type.
    """
    source: Recording = open_recording(Path(recording), repair=True) if isinstance(recording, str | Path) else recording
    if not hasattr(source, "rig"):
        raise ConfigError(f"inspect() of {type(source).__name__}; expected a recording or its path")
    segments = [source, *getattr(source, "later", ())]
    chosen: Recording = max(segments, key=lambda segment: len(segment.frame_times_ns))
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # for the same bytes in each run
    try:
        measured = measure(chosen, progress("looking"))
        odometry_run = run_odometry(chosen, progress("estimating")) if run else None
    finally:
        cv2.setNumThreads(threads)
    return _inspection(measured, odometry_run, source)


def _inspection(measured: Measured, run: EstimatorRun | None, source: Recording) -> Inspection:
    """Return the findings about a recording that has been measured."""
    imu = measured.recording.imu
    bias = measured.relation.bias_rad_s if measured.relation is not None and measured.belongs else None
    rest_ns = tuple(resting(imu, bias))
    rest = [_between(imu, *each) for each in rest_ns]
    longest = max(rest, key=len, default=None)
    details = Details(
        measured, rest_ns, spectrum_of(measured.sound_imu), None if longest is None else allan_deviation(longest), run
    )
    findings = [
        *camera_findings(measured),
        *imu_findings(measured, rest, details.spectrum, details.allan),
        *clock_findings(measured),
        *calibration_findings(measured),
        *motion_findings(measured, rest_ns),
        *truth_findings(measured),
        *(() if run is None else odometry_findings(measured.recording, run)),
        *defect_findings(measured, source),
    ]
    order = list(Topic)
    ordered: tuple[Finding, ...] = tuple(sorted(findings, key=lambda finding: order.index(finding.topic)))
    facts = _facts(measured.recording)
    return Inspection(measured.recording.name, facts, ordered, details)


def _facts(recording: Recording) -> dict[str, object]:
    """Return what a recording holds."""
    t_ns, imu, truth = recording.frame_times_ns, recording.imu, recording.ground_truth
    return {
        "duration_s": float(t_ns[-1] - t_ns[0]) * 1e-9 if len(t_ns) else 0.0,
        "frames": len(t_ns),
        "cameras": [[camera.model.width, camera.model.height] for camera in recording.rig.cameras],
        "imu_samples": len(imu),
        "true_poses": 0 if truth is None else len(truth),
    }


def _between(imu: ImuSamples, first_ns: int, last_ns: int) -> ImuSamples:
    """Return the samples from a first to a last time stamp [ns]."""
    a, b = np.searchsorted(imu.t_ns, [first_ns, last_ns + 1]).tolist()
    return imu[a:b]
