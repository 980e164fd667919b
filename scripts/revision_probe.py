"""What one revision computes, as arrays: the part of `compare_revisions.py` that runs inside that revision.

The process has the revision's own code on its ``PYTHONPATH``. This module names as little of that code as possible,
and `NAMES` has all of it: where a name has moved, add its new place there. Files of the EuRoC layout are read by NumPy
and OpenCV alone, so that a change of the package's own readers cannot hide a change of what was written::

    python scripts/revision_probe.py estimate FOLDER --code EXPORT --out estimate.npz
    python scripts/revision_probe.py eqvio --code EXPORT --out eqvio.npz
    python scripts/revision_probe.py flight FOLDER --code EXPORT --out flight.npz
"""

import argparse
import hashlib
import importlib
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Arrays = dict[str, npt.NDArray[Any]]
"""Arrays by the name of a quantity, with its unit in brackets."""

VERSION = 1
"""Increase it with every change of what is computed here: results of an earlier version are then computed again."""

NAMES: dict[str, tuple[str, ...]] = {
    "open_recording": (
        "dronevio:open_recording",
        "dronevio.models.recordings:open_recording",
        "dronevio.models.recordings.open:open_recording",
    ),
    "measurements": (
        "dronevio:measurements",
        "dronevio.models:measurements",
        "dronevio.models.protocols:measurements",
    ),
    "VisualInertialOdometry": (
        "dronevio:VisualInertialOdometry",
        "dronevio.estimator:VisualInertialOdometry",
        "dronevio.estimator.vio:VisualInertialOdometry",
    ),
    "read_flight": (
        "dronevio.estimator.book.eqvio:read_feature_recording",
        "dronevio.estimator.book.eqvio:read_flight",
    ),
    "ReplayedFeatures": (
        "dronevio.estimator.book.eqvio:ReplayFrontEnd",
        "dronevio.estimator.book.eqvio:ReplayedFeatures",
    ),
    "run_eqvio": ("dronevio.estimator.book.eqvio:run_eqvio",),
}
"""Every name of the package that is used here, and where revisions have it, the newest place first."""

HEALTH_STATES = {"initialising": "initializing"}
"""Health states that were renamed, and their present names."""

_TRUTH_COLUMNS = {
    "truth position [m]": slice(1, 4),
    "truth quaternion": slice(4, 8),
    "truth velocity [m/s]": slice(8, 11),
    "truth gyro bias [rad/s]": slice(11, 14),
    "truth accel bias [m/s²]": slice(14, 17),
}
_NUMBER = re.compile(r"(?<![\w.])[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?![\w.])")


def found(name: str) -> Any:
    """Return what the revision has under one of the places of `NAMES`.

    Raises:
        ImportError: None of the places exists.
    """
    for place in NAMES[name]:
        module, _, attribute = place.partition(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except AttributeError:
            continue
        except ModuleNotFoundError as error:
            if not (error.name or "").startswith("dronevio"):
                raise
    raise ImportError(f"no {name} at {', '.join(NAMES[name])}; add its new place to NAMES in {__file__}")


def check_code(folder: Path) -> None:
    """Check that the package is imported from a folder.

    Raises:
        ImportError: It comes from elsewhere, such as from the environment's own editable installation.
    """
    import dronevio

    file = Path(str(dronevio.__file__)).resolve()
    if not file.is_relative_to(folder.resolve()):
        raise ImportError(f"dronevio is imported from {file}; expected it below {folder.resolve()}")


def estimate(folder: Path, cameras: int | None) -> Arrays:
    """Return what the odometry estimates on a recording, frame by frame, with the first so many cameras or all."""
    recording = found("open_recording")(folder, cameras)
    return estimates_of(recording, found("VisualInertialOdometry")(recording.rig))


def eqvio() -> Arrays:
    """Return what the odometry, and GTSAM's equivariant filter, estimate on the features of a real flight."""
    flight = found("read_flight")()
    arrays = estimates_of(flight, found("VisualInertialOdometry")(flight.rig, None, found("ReplayedFeatures")(flight)))
    filtered = found("run_eqvio")(flight)
    return {**arrays, "EqVIO position [m]": np.asarray(filtered.p_world_imu)}


def estimates_of(recording: Any, estimator: Any) -> Arrays:
    """Push a recording through an estimator on one thread, and return what it estimates, frame by frame."""
    cv2.setNumThreads(1)
    estimates = []
    for measurement in found("measurements")(recording):
        if hasattr(measurement, "gyro_rad_s"):
            estimator.add_imu(measurement)
        else:
            estimates.append(estimator.add_frame(measurement))
    states = [e.state for e in estimates]
    T = rows((s.T_world_imu for s in states if s is not None), states, (4, 4))
    tracks = [e.tracks for e in estimates if e.tracks is not None]
    landmarks = [e.landmarks_world for e in estimates if e.landmarks_world is not None]
    return {
        "time [ns]": np.array([e.t_ns for e in estimates], dtype=np.int64),
        "has state": np.array([s is not None for s in states], dtype=np.bool_),
        "health": np.array([HEALTH_STATES.get(str(e.health), str(e.health)) for e in estimates], dtype="U24"),
        "position [m]": T[:, :3, 3],
        "rotation [rad]": T[:, :3, :3],
        "velocity [m/s]": rows((s.velocity_m_s for s in states if s is not None), states, (3,)),
        "gyro bias [rad/s]": rows((s.gyro_bias_rad_s for s in states if s is not None), states, (3,)),
        "accel bias [m/s²]": rows((s.accel_bias_m_s2 for s in states if s is not None), states, (3,)),
        "covariance [relative]": rows((s.covariance for s in states if s is not None), states, (15, 15)),
        "track ids": np.concatenate([np.zeros(0, np.int64), *(t.ids for t in tracks)]),
        "track pixels [px]": np.concatenate([np.zeros((0, 2)), *(t.pixels for t in tracks)]),
        "landmarks [m]": np.concatenate([np.zeros((0, 3)), *landmarks]),
        "events": np.array(["; ".join(e.events) for e in estimates], dtype="U"),
    }


def rows(values: Iterable[Any], states: Sequence[Any], shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """Return one array of a shape for each state, NaN where there is no state or it lacks the value."""
    table = np.full((len(states), *shape), np.nan)
    for row, value in zip((i for i, s in enumerate(states) if s is not None), values, strict=True):
        if value is not None:
            table[row] = value
    return table


def flight(folder: Path) -> Arrays:
    """Return what a recording of the EuRoC layout holds: IMU, images, truth and calibration, but no text."""
    mav0 = folder / "mav0"
    imu, truth = table(mav0 / "imu0"), table(mav0 / "state_groundtruth_estimate0")
    arrays: Arrays = {
        "IMU time [ns]": times(mav0 / "imu0"),
        "gyroscope [rad/s]": imu[:, 1:4],
        "accelerometer [m/s²]": imu[:, 4:7],
        "truth time [ns]": times(mav0 / "state_groundtruth_estimate0"),
        **{name: truth[:, columns] for name, columns in _TRUTH_COLUMNS.items()},
        "frame truth": table(mav0 / "frame_groundtruth0"),
        "calibration": calibration(mav0),
    }
    for images in sorted(path for path in mav0.iterdir() if (path / "data").is_dir()):
        files = sorted((images / "data").glob("*.png"), key=lambda file: int(file.stem))
        arrays[f"{images.name} time [ns]"] = np.array([int(file.stem) for file in files], dtype=np.int64)
        arrays[f"{images.name} images"] = np.array([image_hash(file) for file in files], dtype="U64")
    return arrays


def trajectory(file: Path) -> Arrays:
    """Return the poses of a TUM file."""
    poses = np.loadtxt(file, ndmin=2)
    return {
        "IMU-rate time [s]": poses[:, 0],
        "IMU-rate position [m]": poses[:, 1:4],
        "IMU-rate quaternion": poses[:, 4:8],
    }


def table(folder: Path) -> npt.NDArray[np.float64]:
    """Return the numbers (N, M) of a table of the EuRoC layout."""
    return np.loadtxt(folder / "data.csv", delimiter=",", ndmin=2)


def times(folder: Path) -> npt.NDArray[np.int64]:
    """Return the time stamps (N,) [ns] of a table of the EuRoC layout."""
    return np.loadtxt(folder / "data.csv", delimiter=",", usecols=0, dtype=np.int64, ndmin=1)


def calibration(mav0: Path) -> npt.NDArray[np.float64]:
    """Return all numbers of the calibration files in the order of the files' names and lines; comments do not count."""
    files = sorted((*mav0.glob("*/sensor.yaml"), *mav0.glob("body.yaml")))
    lines = (
        line.partition("#")[0].partition("comment:")[0] for file in files for line in file.read_text().splitlines()
    )
    return np.array([float(number) for line in lines for number in _NUMBER.findall(line)])


def image_hash(file: Path) -> str:
    """Return the hash of an image's pixels, whatever their compression."""
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{file}: no image can be read")
    return hashlib.sha256(f"{image.dtype} {image.shape}".encode() + image.tobytes()).hexdigest()


def main() -> None:
    """Compute one set of arrays and write them into a file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("check", "estimate", "eqvio", "flight", "trajectory"))
    parser.add_argument("path", type=Path, nargs="?", help="Recording or TUM file to read.")
    parser.add_argument("--code", type=Path, required=True, help="Folder that dronevio must be imported from.")
    parser.add_argument("--cameras", type=int, help="How many cameras to use; all by default.")
    parser.add_argument("--out", type=Path, help="File for the arrays (.npz).")
    options = parser.parse_args()
    check_code(options.code)
    if options.what == "check":
        return
    if options.out is None or (options.path is None and options.what != "eqvio"):
        parser.error(f"{options.what} needs PATH and --out")
    computations: dict[str, Callable[[], Arrays]] = {
        "estimate": lambda: estimate(options.path, options.cameras),
        "eqvio": eqvio,
        "flight": lambda: flight(options.path),
        "trajectory": lambda: trajectory(options.path),
    }
    np.savez_compressed(options.out, **computations[options.what]())  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
