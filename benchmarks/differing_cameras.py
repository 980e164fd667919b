"""Estimate stereo recordings whose cameras are exposed at different times, or have images of different sizes.

The trajectory and the IMU are those of a real flight; the images are rendered along the trajectory, those of the second
camera at times of its own. Each recording is written as an EuRoC folder and read like one of another program. The table
has the error, relative to that of the recording with simultaneous exposures, and the share of poses that are tracking.
A camera that tracks features at half of the size is less accurate in any case: that error is relative to the error with
both cameras at half size::

    python benchmarks/differing_cameras.py V1_02/groundtruth.csv --imu V1_02/imu0.csv --start-s 4 --duration-s 12
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import tyro
from measuring import ChangedRecording, frames_of, odometry, print_rows, with_truth

from dronevio.eval.run import EstimatorRun
from dronevio.evaluation import ate
from dronevio.models.arrays import Image
from dronevio.models.imu import Times
from dronevio.models.protocols import Recording
from dronevio.models.recordings.calibration.kalibr import camchain_yaml, imu_yaml
from dronevio.models.recordings.calibration.reading import read_calibrated_rig
from dronevio.models.recordings.euroc import EurocRecording, read_imu, write_euroc
from dronevio.models.recordings.trajectory_file import read_trajectory_file
from dronevio.models.rig import RigCamera
from dronevio.models.state import CameraFrame, Health
from dronevio.recording.recorder import rig_of
from dronevio.sim.cameras.schedule import FrameSchedule
from dronevio.sim.refly import FlownPath, cut, refly
from dronevio.sim.rendering.render import render_frames
from dronevio.sim.rendering.render_job import RenderJob

MAX_RATIO, MIN_TRACKING = 1.2, 0.98
BOTH_HALVED, FIRST_HALVED = "both cameras at half size", "first camera at half size"


@dataclass(frozen=True)
class DifferingCamerasCommand:
    """Which flight is rendered, and where the recordings are written."""

    trajectory: tyro.conf.Positional[Path]
    """Recorded trajectory: a TUM file, an EuRoC ground truth file, or a recording with ground truth."""
    imu: Path | None = None
    """IMU samples that belong to the trajectory, an EuRoC imu0/data.csv; synthesized by default."""
    rig: str = "euroc-stereo"
    """Sensors: the name of a rig with two cameras, or a file with its calibration."""
    start_s: float = 0.0
    """Time after the beginning of the trajectory at which the recordings begin [s]."""
    duration_s: float | None = None
    """Duration of the recordings [s]; up to the end of the trajectory by default."""
    world: str = "room"
    """World that is placed around the trajectory."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the world, the noise of the images and the jitter."""
    shift_s: float = 0.00216
    """How much later the second camera is exposed [s]."""
    jitter_s: float = 0.003
    """Largest random difference between the exposures of the cameras [s]."""
    out: Path = Path("runs/differing-cameras")
    """Folder of the rendered recordings, which are used again."""


def rendered(flown: FlownPath, camera: int, delay_ns: Times, folder: Path, seed: int) -> Times:
    """Render the images of one camera, each later than its frame (M,) [ns], and return their stamps [ns]."""
    schedule = flown.schedule
    exposed_ns = schedule.exposed_ns + delay_ns
    own = FrameSchedule(exposed_ns, exposed_ns, schedule.lit).within(*flown.truth.t_ns[[0, -1]].tolist())
    if not (folder / "mav0" / "cam0" / "data").exists():
        rig = replace(flown.rig, cameras=(flown.rig.cameras[camera],))
        job = RenderJob(
            flown.world,
            seed + 1000 * camera,
            rig,
            flown.truth,
            own,
            T_simworld_world=flown.T_simworld_world,
            world_seed=seed,
        )
        render_frames(job, folder / "mav0")
    return own.stamps_ns


def joined(folder: Path, flown: FlownPath, cameras: tuple[Path, Path], stamps: tuple[Times, Times]) -> Path:
    """Write a recording whose cameras are those of two folders."""
    write_euroc(folder, flown.rig, flown.imu, flown.truth, flown.schedule.stamps_ns)
    for number, (of, t_ns) in enumerate(zip(cameras, stamps, strict=True)):
        own = folder / "mav0" / f"cam{number}"
        (own / "data").rmdir()
        (own / "data").symlink_to((of / "mav0/cam0/data").absolute())
        rows = "".join(f"{t},{t}.png\n" for t in t_ns.tolist())
        (own / "data.csv").write_text(f"#timestamp [ns],filename\n{rows}", encoding="utf-8")
    return folder


def halved(source: Recording, number: int) -> ChangedRecording:
    """Return a recording in which the images of a camera have half of the width and height."""

    def change(camera: RigCamera) -> RigCamera:
        return replace(camera, model=camera.model.resized(camera.model.width // 2, camera.model.height // 2))

    def image(image: Image) -> Image:
        size = image.shape[1] // 2, image.shape[0] // 2
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)

    return with_camera(source, number, change, image)


def cropped(source: Recording, number: int) -> ChangedRecording:
    """Return a recording in which the images of a camera lack an eighth at the left, right, top and bottom."""
    model = source.rig.cameras[number].model
    x, y = model.width // 8, model.height // 8
    width, height = model.width - 2 * x, model.height - 2 * y
    inner = replace(model, width=width, height=height, cx=model.cx - x, cy=model.cy - y)
    return with_camera(
        source,
        number,
        lambda camera: replace(camera, model=inner),
        lambda image: np.ascontiguousarray(image[y : y + height, x : x + width]),
    )


def with_camera(
    source: Recording, number: int, change: Callable[[RigCamera], RigCamera], image: Callable[[Image], Image]
) -> ChangedRecording:
    """Return a recording in which calibration and images of one camera are changed."""
    cameras = tuple(change(each) if i == number else each for i, each in enumerate(source.rig.cameras))

    def frame(frame: CameraFrame) -> CameraFrame:
        images = tuple(image(each) if i == number and each.size else each for i, each in enumerate(frame.images))
        return replace(frame, images=images)

    return replace(
        ChangedRecording.of(source),
        rig=replace(source.rig, cameras=cameras),
        image_of=lambda index: frame(source.frame(index)),
    )


def same_stamps(source: Recording, shift_s: float, folder: Path) -> ChangedRecording:
    """Return a recording in which both cameras have the stamps of the first, and Kalibr's files state the shift."""
    first, second = source.rig.cameras
    rig = replace(source.rig, cameras=(first, replace(second, time_offset_s=shift_s)))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camchain.yaml").write_text(camchain_yaml(rig), encoding="utf-8")
    (folder / "imu.yaml").write_text(imu_yaml(rig), encoding="utf-8")
    return replace(
        ChangedRecording.of(source),
        rig=read_calibrated_rig(folder),
        image_of=lambda index: replace(source.frame(index), image_delays_ns=()),
    )


def row_of(name: str, run: EstimatorRun, error_m: float, paired_m: float | None) -> dict[str, str]:
    """Return the row of a recording: frames, poses, share that is tracking, error, and its ratio to the paired one."""
    poses = len(run.trajectory)
    share = frames_of(run, Health.TRACKING) / max(poses, 1)
    ratio = error_m / paired_m if paired_m else 1.0
    met = "" if not paired_m or name == BOTH_HALVED else "yes" if ratio <= MAX_RATIO and share >= MIN_TRACKING else "no"
    return {
        "recording": name,
        "frames": str(len(run.estimates)),
        "poses": str(poses),
        "tracking": f"{share:.3f}",
        "ATE [mm]": f"{1e3 * error_m:.2f}",
        "ratio": f"{ratio:.2f}",
        "met": met,
    }


def recordings(command: DifferingCamerasCommand, seed: int) -> dict[str, Recording]:
    """Return the recordings of a seed by name, the one with simultaneous exposures first."""
    path = cut(read_trajectory_file(command.trajectory), command.start_s, command.duration_s)
    imu = None if command.imu is None else read_imu(command.imu)
    flown = refly(path, imu, rig_of(command.rig), command.world, seed)
    out, count = command.out / f"{command.world}-{seed}", len(flown.schedule)
    rng = np.random.default_rng([seed, 7])
    delays_ns = {
        "simultaneous": np.zeros(count, np.int64),
        "later": np.full(count, round(command.shift_s * 1e9)),
        "jitter": np.rint(1e9 * command.jitter_s * rng.uniform(-1.0, 1.0, count)).astype(np.int64),
    }
    first = out / "first"
    first_ns = rendered(flown, 0, delays_ns["simultaneous"], first, seed)
    folders = {}
    for name, delay_ns in delays_ns.items():
        second = out / f"second-{name}"
        stamps = first_ns, rendered(flown, 1, delay_ns, second, seed)
        folders[name] = out / name
        if not folders[name].exists():
            joined(folders[name], flown, (first, second), stamps)
    opened = {name: EurocRecording.open(folder, repair=True) for name, folder in folders.items()}
    return {
        "simultaneous": opened["simultaneous"],
        f"second camera {1e3 * command.shift_s:g} ms later": opened["later"],
        f"random, up to {1e3 * command.jitter_s:g} ms": opened["jitter"],
        "timeshift_cam_imu that differ": same_stamps(opened["later"], command.shift_s, out / "kalibr"),
        "second camera at half size": halved(opened["simultaneous"], 1),
        "first camera cropped": cropped(opened["simultaneous"], 0),
        "second camera cropped": cropped(opened["simultaneous"], 1),
        BOTH_HALVED: halved(halved(opened["simultaneous"], 0), 1),
        FIRST_HALVED: halved(opened["simultaneous"], 0),
    }


def main(command: DifferingCamerasCommand) -> int:
    """Estimate all recordings and print the tables; return 1 if a bound is not met."""
    missed = False
    for seed in command.seeds:
        rows: list[dict[str, str]] = []
        error_m: dict[str, float] = {}
        for name, recording in recordings(command, seed).items():
            run = odometry(recording)
            error_m[name] = ate(with_truth(recording)[1], run).rmse
            reference = BOTH_HALVED if name == FIRST_HALVED else next(iter(error_m))
            rows.append(row_of(name, run, error_m[name], error_m[reference] if reference != name else None))
        print_rows(f"{command.trajectory} in {command.world}, seed {seed}", rows)
        missed |= any(row["met"] == "no" for row in rows)
    return int(missed)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(DifferingCamerasCommand, description=__doc__)))
