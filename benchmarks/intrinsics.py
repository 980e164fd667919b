"""Estimate recordings with wrong intrinsics, and show what the online calibration makes of them.

Focal lengths, principal points and the first radial coefficient of all cameras are changed in the calibration that the
odometry is given. Each recording is estimated from several starts. A row has the RMS position error after the first
seconds, in which the calibration is estimated (aligned in position and yaw over these frames; geometric mean over the
starts), its ratio to that by the right calibration, the frames beyond five standard deviations while the health is
"tracking", the least share of frames that are tracking, and corrections and warning of the first start. The errors of a
measured truth are fitted to the runs with all calibrations, printed, and removed (`truth_errors.py`)::

    python benchmarks/intrinsics.py V1_02 V2_01 --cameras 1 2
    python benchmarks/intrinsics.py V1_02 --faults right focal+2% --given
"""

import math
import os
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from measuring import ChangedRecording, Row, anchored, opened, print_rows, text
from scipy.stats import gmean
from truth_errors import fitted, is_exact

from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.config import VioConfig
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimators.driver import estimate_recording
from dronevio.eval.metrics.alignment import align
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.consistency import errors_and_sigmas_m
from dronevio.eval.provenance import machine_here, versions_here
from dronevio.eval.run import EstimatorRun
from dronevio.eval.tracking import is_tracking
from dronevio.models.protocols import Recording
from dronevio.models.rig import RigCamera
from dronevio.models.state import Trajectory
from dronevio.recording.excerpts import excerpt_of

WRONG_SIGMAS, MAX_RATIO = 5.0, 1.5
"""Errors beyond which an estimate must not be "tracking" [σ], and the largest ratio to the right calibration."""


@dataclass(frozen=True)
class Fault:
    """An error of the intrinsics of all cameras."""

    focal: float = 0.0
    """Relative error of the focal lengths."""
    centre_px: float = 0.0
    """Error of both coordinates of the principal point [px]."""
    k1: float = 0.0
    """Error of the first radial coefficient."""

    def changed(self, camera: RigCamera) -> RigCamera:
        """Return a camera with the error."""
        m, ratio = camera.model, 1.0 + self.focal
        model = replace(m, fx=ratio * m.fx, fy=ratio * m.fy, cx=m.cx + self.centre_px, cy=m.cy + self.centre_px)
        return replace(camera, model=replace(model, distortion=(m.distortion[0] + self.k1, *m.distortion[1:])))


FAULTS: Mapping[str, Fault] = {
    "right": Fault(),
    **{f"focal{percent:+d}%": Fault(focal=0.01 * percent) for percent in (-5, -2, 2, 5)},
    **{f"centre{px:+d}px": Fault(centre_px=px) for px in (-5, 5)},
    **{f"k1{k1:+.2f}": Fault(k1=k1) for k1 in (-0.02, 0.02)},
}
"""Faults by name."""


@dataclass(frozen=True)
class IntrinsicsCommand:
    """Estimate recordings with each of the faults and print a table."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Recordings with ground truth, or names of those in the folder `euroc` of that of DRONEVIO_DATA."""
    cameras: tuple[int, ...] = (1,)
    """Numbers of cameras."""
    faults: tuple[str, ...] = tuple(FAULTS)
    """Names of the faults; the first is what the others are compared with."""
    starts_s: tuple[float, ...] = (0.0, 3.0, 6.0)
    """Times of the starts after the first frame [s]."""
    begin_s: float = 20.0
    """Time after a start from which errors count [s]."""
    given: bool = False
    """Whether the intrinsics are kept as they are given."""


def config_of(command: IntrinsicsCommand) -> VioConfig:
    """Return the settings of the odometry."""
    if not command.given:
        return VioConfig()
    c = CalibrationConfig()
    parts = {name: replace(getattr(c, name), online=False) for name in ("focal", "principal", "radial")}
    return VioConfig(calibration=replace(c, **parts))


@dataclass(frozen=True)
class Scores:
    """Figures of a run."""

    error_m: float
    """RMS position error [m]; infinite without poses."""
    wrong: int
    """Number of frames beyond `WRONG_SIGMAS` while tracking."""
    tracking_percent: float
    """Share of the frames that are tracking [%]."""

    @classmethod
    def of(cls, run: EstimatorRun, truth: Trajectory, begin_s: float) -> "Scores":
        """Return the figures of a run after some time [s]."""
        begin_ns = int(run.t_ns[0]) + round(1e9 * begin_s)
        estimate = run.trajectory
        frames = int(np.sum(run.t_ns >= begin_ns))
        true, rows = interpolate(truth, estimate.t_ns)
        estimate = estimate[rows]
        late = estimate.t_ns >= begin_ns
        if late.sum() < 3:
            return cls(math.inf, 0, 0.0)
        p, p_true = estimate.p_world_imu[late], true.p_world_imu[late]
        errors = align(p_true, p).positions(p) - p_true
        tracking = is_tracking(run, estimate)
        error_m, sigma_m = errors_and_sigmas_m(true, anchored(true, estimate))
        wrong = int(np.sum(tracking & (error_m > WRONG_SIGMAS * sigma_m)))
        rms_m = float(np.sqrt((errors**2).sum(axis=1).mean()))
        return cls(rms_m, wrong, 100.0 * float(np.sum(tracking & late)) / max(frames, 1))


def runs(recording: Recording, fault: Fault, command: IntrinsicsCommand) -> Iterator[EstimatorRun]:
    """Yield the runs of a recording with a fault, one from each start."""
    rig = replace(recording.rig, cameras=tuple(map(fault.changed, recording.rig.cameras)))
    given = replace(ChangedRecording.of(recording), rig=rig)
    for start_s in command.starts_s:
        yield estimate_recording(excerpt_of(given, start_s), VisualInertialOdometry(rig, config_of(command)))
        print(".", end="", file=sys.stderr, flush=True)


def rows_of(path: Path, cameras: int, command: IntrinsicsCommand) -> Iterator[Row]:
    """Yield the rows of a recording."""
    recording, truth = opened(path, cameras)
    runs_of = {name: list(runs(recording, FAULTS[name], command)) for name in command.faults}
    if not is_exact(path):
        errors = fitted(truth, [run.trajectory for each in runs_of.values() for run in each if len(run.trajectory) > 2])
        truth = errors.corrected(truth)
        print(f"{path.name}: truth corrected by {errors}")
    reference = math.nan
    for name, runs_by in runs_of.items():
        scores = [Scores.of(run, truth, command.begin_s) for run in runs_by]
        error_m, tracking = float(gmean([s.error_m for s in scores])), min(s.tracking_percent for s in scores)
        reference = error_m if math.isnan(reference) else reference
        warnings = [warning for _, warning in runs_by[0].warnings]
        corrections = [
            e for estimate in runs_by[0].estimates for e in estimate.events if e.startswith("calibration cor")
        ]
        is_right = error_m <= MAX_RATIO * reference or tracking < 50.0 or all(run.warnings for run in runs_by)
        yield {
            "flight": path.name,
            "cameras": str(cameras),
            "intrinsics": name,
            "RMSE [mm]": text(1e3 * error_m, ".1f"),
            "ratio": text(error_m / reference, ".2f"),
            "tracking": f"{tracking:.0f} %",
            "> 5 σ": str(sum(s.wrong for s in scores)),
            "corrected or said": "yes" if is_right else "no",
            "corrections": corrections[-1].partition(": ")[2] if corrections else "",
            "first warning": warnings[0] if warnings else "",
        }
        print(f"{path.name}, {cameras}, {name}: {scores}", file=sys.stderr, flush=True)


def main(command: IntrinsicsCommand) -> int:
    """Print the table; return 1 if a fault is neither corrected nor said."""
    print(", ".join(f"{k} {v}" for k, v in (versions_here() | machine_here()).items()))
    folder = Path(os.environ.get("DRONEVIO_DATA", ".")) / "euroc"
    paths = [path if path.exists() else folder / path for path in command.recordings]
    rows = [row for path in paths for cameras in command.cameras for row in rows_of(path, cameras, command)]
    print_rows("intrinsics", rows, ("cameras", "intrinsics", "corrections", "first warning"))
    return int(any(row["corrected or said"] == "no" for row in rows))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(IntrinsicsCommand, description=__doc__)))
