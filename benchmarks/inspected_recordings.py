"""Inspect a recording altered in one property at a time, and sound ones, and tabulate what `dronevio inspect` says.

An alteration is named if a row that is about it is not good. Of a sound recording, all rows must be good::

    python benchmarks/inspected_recordings.py MH_01_easy --other runs/room --sound MH_01_easy runs/room
"""

import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import clock_steps
import cv2
import numpy as np
import tyro
from measuring import ChangedRecording, print_rows, section_of
from wrong_inputs import FAULTS, Change, of_images, of_order

from dronevio.inspection.inspection import inspect
from dronevio.inspection.model import Finding, Inspection, Verdict
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording

STEP_S, CAMERA_STEP_NS = -3.013, 100_000_000
DRIFTS_PPM = (500.0, 2000.0)
OUTLIERS = 12
BURST = 5


def of_samples(function: Callable[[ImuSamples], ImuSamples]) -> Change:
    """Return the alteration of the IMU by a function."""
    return lambda recording, _: replace(recording, imu=function(recording.imu))


def with_outliers(imu: ImuSamples) -> ImuSamples:
    """Return samples of which some are wrong by ±150 m/s² and ±30 rad/s."""
    rng = np.random.default_rng(3)
    gyro, accel = imu.gyro_rad_s.copy(), imu.accel_m_s2.copy()
    for k, row in enumerate(rng.choice(np.arange(20, len(imu) - 20), OUTLIERS, replace=False).tolist()):
        sign, axis = rng.choice([-1.0, 1.0]), int(rng.integers(3))
        if k % 2:
            gyro[row, axis] += 30.0 * sign
        else:
            accel[row, axis] += 150.0 * sign
    return ImuSamples(imu.t_ns, gyro, accel, imu.sampling)


def vibrating(imu: ImuSamples) -> ImuSamples:
    """Return samples with a vibration of 15 m/s² and 0.3 rad/s at 87 Hz."""
    wave = np.sin(2.0 * np.pi * 87.0 * (imu.t_ns - imu.t_ns[0]) * 1e-9)[:, None]
    return ImuSamples(
        imu.t_ns,
        imu.gyro_rad_s + 0.3 * wave * [0.5, 0.7, 0.5],
        imu.accel_m_s2 + 15.0 * wave * [0.6, 0.5, 0.62],
        imu.sampling,
    )


def drifting(ppm: float) -> Change:
    """Return the alteration that the clock of the camera runs faster by some parts per million."""

    def changed(recording: ChangedRecording, _: Recording) -> ChangedRecording:
        t_ns = recording.frame_times_ns
        return replace(recording, frame_times_ns=t_ns + np.round((t_ns - t_ns[0]) * ppm * 1e-6).astype(np.int64))

    return changed


def camera_step(recording: ChangedRecording, _: Recording) -> ChangedRecording:
    """Return a recording whose camera's clock advances by 100 ms in the middle."""
    t_ns = recording.frame_times_ns
    late = np.arange(len(t_ns)) >= len(t_ns) // 2
    return replace(recording, frame_times_ns=t_ns + np.where(late, CAMERA_STEP_NS, 0))


def late_by(milliseconds: int) -> Change:
    """Return the alteration that the stamps of the images are late."""
    return lambda recording, _: replace(recording, frame_times_ns=recording.frame_times_ns + milliseconds * 1_000_000)


MEMORY: Mapping[str, tuple[Change, tuple[str, ...]]] = {
    **{name: (change, ()) for name, (change, _) in FAULTS.items() if name != "none"},
    "imu-outliers": (of_samples(with_outliers), ("outliers",)),
    "imu-vibration": (of_samples(vibrating), ("vibration",)),
    "imu-every-second": (of_samples(lambda imu: imu[::2]), ("IMU rate",)),
    "gyroscope-accelerometer-swapped": (
        of_samples(lambda imu: ImuSamples(imu.t_ns, imu.accel_m_s2, imu.gyro_rad_s, imu.sampling)),
        ("units",),
    ),
    "images-repeated": (of_order(lambda index, count: index - index % 2), ("repeated images",)),
    "images-dark": (of_images(lambda image: (image // 12).astype(np.uint8)), ("brightness",)),
    "images-blurred": (of_images(lambda image: np.asarray(cv2.GaussianBlur(image, (0, 0), 4.0), np.uint8)), ("blur",)),
    "camera-late-50-ms": (late_by(50), ("time offset",)),
    "camera-early-20-ms": (late_by(-20), ("time offset",)),
    "camera-clock-step": (camera_step, ("steps of the offset",)),
    **{f"camera-drift-{ppm:g}-ppm": (drifting(ppm), ("drift of the offset",)) for ppm in DRIFTS_PPM},
}
"""Alterations of a recording in memory, each with the rows that name it."""
NAMES: Mapping[str, tuple[str, ...]] = {
    "crossed-flights": ("images and gyroscope",),
    "imu-late": ("time offset",),
    "reversed-images": ("images and gyroscope",),
    "mirrored-images": ("rotation of camera and IMU",),
    "frozen-images": ("repeated images",),
    "wrong-lens-model": ("lens of cam0",),
    "extrinsics-20-degrees": ("rotation of camera and IMU",),
    "extrinsics-90-degrees": ("rotation of camera and IMU",),
    "swapped-cameras": ("pose of cam1 and cam0",),
    "focal-length-20-percent": ("lens of cam0",),
    "accelerometer-in-g": ("gravity",),
    "swapped-sensors": ("units",),
    "gyroscope-in-degrees": ("unit of the gyroscope",),
    "gyroscope-axes": ("handedness of the gyroscope",),
    "accelerometer-axes": ("axes of the accelerometer",),
}
"""The rows that name each of the wrong inputs."""


def copied(source: Path, folder: Path) -> Path:
    """Return a copy of an EuRoC folder with links to its images."""
    target = folder / source.name
    shutil.copytree(source, target, ignore=lambda _, names: [name for name in names if name.endswith(".png")])
    for image in source.rglob("*.png"):
        (target / image.relative_to(source)).symlink_to(image.resolve())
    return target


def unpaired(name: str, t_ns: Times) -> tuple[Times, clock_steps.Order]:
    """Leave out every third image of the second camera."""
    rows = clock_steps.kept(t_ns)
    return t_ns, rows[rows % 3 != 0] if name == "cam1" else rows


def with_twelve_bits(source: Path, folder: Path) -> Path:
    """Return a copy of an EuRoC folder whose images are stored with 12 bits in files of 16."""
    copy = copied(source, folder)
    for link in sorted(copy.rglob("*.png")):
        image = cv2.imread(str(link), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        link.unlink()
        cv2.imwrite(str(link), image.astype(np.uint16) * 16 + 7)
    return copy


def with_clock_step(source: Path, folder: Path) -> Path:
    """Return a copy of a recording whose time stamps fall by 3 s in the middle."""
    t_ns = open_recording(source).frame_times_ns
    change = clock_steps.step(STEP_S, ("imu0", "cam0", "cam1"), int(t_ns[len(t_ns) // 2]))
    return clock_steps.folder_copy(source, folder, change)


FILES: Mapping[str, tuple[Callable[[Path, Path], Path], tuple[str, ...]]] = {
    "clock-step": (with_clock_step, ("clock step",)),
    "imu-bursts": (
        lambda source, folder: clock_steps.folder_copy(source, folder, clock_steps.bursts(BURST)),
        ("burst of IMU samples", "IMU jitter"),
    ),
    "images-unpaired": (
        lambda source, folder: clock_steps.folder_copy(source, folder, unpaired),
        ("unpaired image",),
    ),
    "images-12-bit": (with_twelve_bits, ("bit depth",)),
    "unset-stamps": (
        lambda source, folder: clock_steps.bag_copy(open_recording(source), folder / "bag", clock_steps.unset("/")),
        ("unset time stamp",),
    ),
}
"""Functions that write an altered copy of a recording into a folder, each with the rows that name the alteration."""


def label(finding: Finding) -> str:
    """Return the name of a row, with its topic where names occur twice."""
    return f"{finding.topic} {finding.name}" if finding.name in ("rate", "jitter", "gaps") else finding.name


def raised_in(found: Inspection) -> list[Finding]:
    """Return the rows that are not good."""
    return [finding for finding in found.findings if finding.verdict in (Verdict.SUSPECT, Verdict.WRONG)]


def row_of(name: str, expected: Sequence[str], found: Inspection) -> dict[str, str]:
    """Return the row of an alteration: whether it is named, and by which rows."""
    raised = raised_in(found)
    # A bit depth is named, and is no defect, since the reader scales the images.
    naming = [f for f in found.findings if label(f) in expected and (f in raised or f.name == "bit depth")]
    print(f"{name}: {'named' if naming else 'not named'}", file=sys.stderr, flush=True)
    rest = ", ".join(f"{label(f)} ({f.verdict})" for f in raised if f not in naming)
    said = f"{label(naming[0])} ({naming[0].verdict}): {naming[0].found}" if naming else "–"
    return {"alteration": name, "named": "yes" if naming else "no", "further rows": rest or "–", "said": said}


@dataclass(frozen=True)
class InspectedCommand:
    """Inspect a recording with each alteration, and sound recordings, and print tables."""

    recording: tyro.conf.Positional[Path]
    """EuRoC folder with two cameras."""
    other: Path
    """Recording whose IMU is crossed with the images of the first."""
    sound: tuple[Path, ...] = ()
    """Recordings of which nothing wrong may be said."""
    only: tuple[str, ...] = ()
    """Names of the alterations; all by default."""


def main(command: InspectedCommand) -> int:
    """Print the tables; return 1 if less than 90 % are named, or something wrong is said of a sound recording."""
    recording, other = open_recording(command.recording, 2), open_recording(command.other, 2)
    section = section_of(recording, len(recording.frame_times_ns))
    rows = []
    for name, (change, expected) in MEMORY.items():
        if not command.only or name in command.only:
            rows.append(row_of(name, expected or NAMES[name], inspect(change(section, other))))
    for name, (alter, expected) in FILES.items():
        if command.only and name not in command.only:
            continue
        with tempfile.TemporaryDirectory() as folder:
            rows.append(row_of(name, expected, inspect(alter(command.recording, Path(folder)))))
    named = sum(row["named"] == "yes" for row in rows)
    print_rows(f"{recording.name}: {named} of {len(rows)} named", rows, left=("named", "further rows", "said"))
    sound = []
    for path in command.sound:
        found = inspect(path)
        raised = [f"{f.topic} {f.name}: {f.found}" for f in raised_in(found)]
        unknown = sum(f.verdict is Verdict.UNKNOWN for f in found.findings)
        sound.append(
            {
                "recording": found.name,
                "rows": str(len(found.findings)),
                "not checked": str(unknown),
                "raised": str(len(raised)),
                "which": "; ".join(raised) or "–",
            }
        )
    print_rows("Sound recordings", sound, left=("which",))
    return int(named < 0.9 * len(rows) or any(row["raised"] != "0" for row in sound))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(InspectedCommand, description=__doc__)))
