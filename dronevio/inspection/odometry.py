"""Findings of a short run of the odometry."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimators.driver import estimate_recording
from dronevio.eval.metrics.alignment import align
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.run import EstimatorRun
from dronevio.inspection.model import Finding, Topic, Verdict, graded
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Recording
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Health, Trajectory

RUN_S = 30.0
"""Duration of the run [s], from the first frame on."""
SUSPECT_START_S, WRONG_START_S = 6.0, 20.0
"""Time to the first pose that a start in motion with little parallax takes, and one that is no start."""
MIN_TRACKING = 0.95
"""Share of the frames after the first pose that are tracked in a sound recording."""
MAX_NIS = 3.0
"""Normalized innovation squared of a sound calibration, 1 expected; noise that is stated too small explains this."""


@dataclass(frozen=True, eq=False)
class Section:
    """The beginning of a recording; is a `Recording`."""

    whole: Recording
    """The recording that begins with it."""
    frames: int
    """Number of frames."""

    @property
    def name(self) -> str:
        """Name in reports."""
        return self.whole.name

    @property
    def rig(self) -> Rig:
        """Sensors and their calibration."""
        return self.whole.rig

    @property
    def imu(self) -> ImuSamples:
        """IMU samples up to the last frame."""
        return self.whole.imu.up_to(int(self.frame_times_ns[-1]) + 1_000_000_000)

    @property
    def frame_times_ns(self) -> Times:
        """(M,) Time stamps of the frames [ns]."""
        return self.whole.frame_times_ns[: self.frames]

    @property
    def ground_truth(self) -> Trajectory | None:
        """The ground truth of the recording."""
        return self.whole.ground_truth

    def frame(self, index: int) -> CameraFrame:
        """Return a frame."""
        return self.whole.frame(index)


def run_odometry(recording: Recording, progress: Progress = silent) -> EstimatorRun | None:
    """Return a run over the first `RUN_S` of a recording; None without frames or IMU."""
    t_ns = recording.frame_times_ns
    if not len(t_ns) or not len(recording.imu) or not recording.rig.cameras:
        return None
    section = Section(recording, int(np.searchsorted(t_ns, t_ns[0] + round(RUN_S * 1e9), side="right")))
    return estimate_recording(section, VisualInertialOdometry(section.rig), progress)


def odometry_findings(recording: Recording, run: EstimatorRun) -> Iterator[Finding]:
    """Yield the findings of a run of the odometry."""
    trajectory, duration_s = run.trajectory, float(run.t_ns[-1] - run.t_ns[0]) * 1e-9
    if not len(trajectory):
        report = run.estimates[-1].health_report
        why = "" if report is None else f": {report.reason}"
        yield Finding(
            Topic.ODOMETRY,
            "start",
            None,
            Verdict.WRONG,
            f"no pose in {duration_s:.1f} s{why}",
            f"a first pose within {SUSPECT_START_S:g} s",
            "see the rows above that are not good",
        )
        return
    first_s = float(trajectory.t_ns[0] - run.t_ns[0]) * 1e-9
    verdict = graded(first_s, SUSPECT_START_S, WRONG_START_S)
    yield Finding(
        Topic.ODOMETRY,
        "start",
        first_s,
        verdict,
        f"first pose after {first_s:.2f} s",
        f"within {SUSPECT_START_S:g} s, of rest or of motion with parallax",
        "" if verdict is Verdict.GOOD else "begin with a second at rest, or move sideways in front of texture",
    )
    after = [estimate for estimate in run.estimates if estimate.t_ns >= trajectory.t_ns[0]]
    counts = Counter(estimate.health for estimate in after)
    share = counts[Health.TRACKING] / len(after)
    verdict = Verdict.GOOD if share >= MIN_TRACKING else Verdict.SUSPECT if share > 0.5 else Verdict.WRONG
    warning = f"; {run.warnings[0][1]}" if run.warnings else ""
    yield Finding(
        Topic.ODOMETRY,
        "tracking",
        share,
        verdict,
        ", ".join(f"{count} {health}" for health, count in counts.items()) + f" of {len(after)} frames{warning}",
        f"{100 * MIN_TRACKING:.0f} % of the frames or more",
        "" if verdict is Verdict.GOOD else "see the rows above that are not good",
    )
    if run.innovations is not None:
        nis = run.innovations.median_nis
        yield Finding(
            Topic.ODOMETRY,
            "innovations",
            nis,
            graded(nis, MAX_NIS, 10.0),
            f"{run.innovations.median_px:.2f} px (median), {nis:.2f} times their expected square",
            f"1, and less than {MAX_NIS:g} if calibration and noise are right",
            "" if nis < MAX_NIS else "state larger noise densities, or check the calibration",
        )
    if recording.ground_truth is not None:
        yield from _accuracy(recording.ground_truth, trajectory)


def _accuracy(truth: Trajectory, estimate: Trajectory) -> Iterator[Finding]:
    """Yield the error against the ground truth, none if they do not overlap."""
    true, rows = interpolate(truth, estimate.t_ns)
    if len(true) < 10:
        return
    estimated = estimate[rows]
    errors_m = np.linalg.norm(
        align(true.p_world_imu, estimated.p_world_imu, "yaw").positions(estimated.p_world_imu) - true.p_world_imu,
        axis=1,
    )
    ate_m, path_m = float(np.sqrt(np.mean(errors_m**2))), true.length_m
    limit_m = max(0.02 * path_m, 0.05)
    yield Finding(
        Topic.ODOMETRY,
        "accuracy",
        ate_m,
        graded(ate_m, limit_m, 5.0 * limit_m),
        f"{ate_m:.3f} m (r.m.s., yaw and position aligned) on {path_m:.1f} m",
        f"less than {limit_m:.2f} m, 2 % of the path",
        "" if ate_m < limit_m else "see the rows above that are not good",
    )
