"""Estimate copies of a recording whose clock steps, whose IMU samples come in bursts, or whose stamps are unset.

The measurements of the copies are those of the recording; only time stamps and the order of rows differ. Each segment
is compared with the same part of the recording, cut out by hand: its error may be 1.5 times as large, and no state may
be faster than 20 m/s. The bags have log times that are later than the stamps by 1 ms (IMU) and 3 ms (cameras)::

    python benchmarks/clock_steps.py MH_01_real
    python benchmarks/clock_steps.py MH_01_real --cameras 1 --cases "all -3.013 s" "bursts of 8"
"""

import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import tyro
from measuring import ChangedRecording, first_pose_s, odometry, opened, print_rows
from rosbags.rosbag2 import Reader, StoragePlugin, Writer

from dronevio import ate
from dronevio.eval.run import EstimatorRun
from dronevio.models.defects import defects_text
from dronevio.models.errors import DronevioError
from dronevio.models.imu import Times
from dronevio.models.protocols import Recording
from dronevio.models.recordings.bag.file import typestore
from dronevio.models.recordings.bag.writer import write_bag
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.segments import segments_of
from dronevio.models.state import Trajectory

LARGEST_RATIO, LARGEST_SPEED_M_S = 1.5, 20.0
TITLES = ("copy", "frames", "first pose", "error", "cut by hand", "largest speed", "health", "defects", "wrong")
MIDDLE = 100
"""Frame from which on the clock has stepped."""

Order = npt.NDArray[np.int64]
Part = tuple[int | None, int | None]
"""First frame of a part, and the one behind its last."""
Change = Callable[[str, Times], tuple[Times, Order]]
"""Function of the name of a list and its stamps that returns new stamps and the order in which rows are written."""


@dataclass(frozen=True)
class ClockStepsCommand:
    """The command line."""

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """EuRoC folder with ground truth."""
    cameras: int = 2
    """Number of cameras."""
    cases: tuple[str, ...] = ()
    """Names of cases; all by default."""


def cut(whole: Recording, frames: slice) -> ChangedRecording:
    """Return a part of a recording, cut out by hand, with the IMU samples of its time.

    A part that begins or ends with the recording has all samples up to there.
    """
    all_ns, imu = whole.frame_times_ns, whole.imu
    rows = np.arange(len(all_ns))[frames]
    if rows[0] > 0:
        imu = imu.after(int(all_ns[rows[0]]) - 1)
    if rows[-1] + 1 < len(all_ns):
        imu = imu.up_to(int(all_ns[rows[-1] + 1]) - 1)
    return replace(ChangedRecording.of(whole).chosen(rows), imu=imu)


def kept(t_ns: Times) -> Order:
    """The order in which rows are."""
    return np.arange(len(t_ns))


def step(change_s: float, lists: Sequence[str], at_ns: int) -> Change:
    """The clock of some lists steps at a time."""

    def change(name: str, t_ns: Times) -> tuple[Times, Order]:
        steps = (t_ns >= at_ns) & (name in lists)
        return t_ns + np.where(steps, round(change_s * 1e9), 0), kept(t_ns)

    return change


def late_rows(name: str, t_ns: Times) -> tuple[Times, Order]:
    """Every twentieth image and every fiftieth sample is written 0.3 s late."""
    every = 50 if name == "imu0" else 20
    written = t_ns.astype(np.float64)
    written[every // 2 :: every] += 0.31e9
    return t_ns, np.argsort(written, kind="stable")


def bursts(size: int) -> Change:
    """IMU samples arrive in bursts, with the stamp of the last one of each."""

    def change(name: str, t_ns: Times) -> tuple[Times, Order]:
        last = np.minimum(kept(t_ns) // size * size + size - 1, len(t_ns) - 1)
        return t_ns[last] if name == "imu0" else t_ns, kept(t_ns)

    return change


def shifted(shift_ns: int) -> Change:
    """All stamps are shifted."""
    return lambda _, t_ns: (t_ns + shift_ns, kept(t_ns))


def folder_copy(source: Path, folder: Path, change: Change) -> Path:
    """Copy an EuRoC folder without its ground truth, with changed lists and links to its images."""
    for sensor in sorted((source / "mav0").iterdir()):
        if not (sensor / "sensor.yaml").exists() or sensor.name[:-1] not in ("cam", "imu"):
            continue
        copy = folder / "mav0" / sensor.name
        copy.mkdir(parents=True)
        (copy / "sensor.yaml").write_text((sensor / "sensor.yaml").read_text())
        if (sensor / "data").is_dir():
            (copy / "data").symlink_to((sensor / "data").resolve())
        rows = [row.split(",", 1) for row in (sensor / "data.csv").read_text().splitlines() if row and row[0] != "#"]
        t_ns, order = change(sensor.name, np.array([int(stamp) for stamp, _ in rows]))
        text = "".join(f"{t_ns[row]},{rows[row][1]}\n" for row in order.tolist())
        (copy / "data.csv").write_text(text)
    return folder


def bag_copy(recording: Recording, path: Path, change: Callable[[str, int], tuple[int, int]]) -> Path:
    """Write a recording as a bag, with stamps and log times [ns] that are a function of topic and stamp."""
    whole = path.with_name("whole.mcap")
    if not whole.exists():
        write_bag(whole, recording, images="png")
    with Reader(whole) as reader, Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}
        for connection, t_ns, raw in reader.messages():
            topic, kind = connection.topic, connection.msgtype
            if topic == "/tf" or topic.startswith("/groundtruth"):
                continue
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=typestore())
            if kind not in ("sensor_msgs/msg/Imu", "sensor_msgs/msg/CompressedImage"):
                writer.write(connections[topic], t_ns, raw)
                continue
            stamp_ns, logged_ns = change(topic, t_ns)
            message: Any = typestore().deserialize_cdr(raw, kind)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            writer.write(connections[topic], logged_ns, typestore().serialize_cdr(message, kind))
    return path


def unset(*topics: str) -> Callable[[str, int], tuple[int, int]]:
    """Topics whose names begin with some texts have no time stamps."""

    def change(topic: str, t_ns: int) -> tuple[int, int]:
        return 0 if topic.startswith(topics) else t_ns, t_ns + (1_000_000 if topic.startswith("/imu") else 3_000_000)

    return change


def stepped_bag(change_ns: int, at_ns: int) -> Callable[[str, int], tuple[int, int]]:
    """The clock of the recording computer steps, and with it stamps and log times."""

    def change(topic: str, t_ns: int) -> tuple[int, int]:
        stepped_ns = t_ns + (change_ns if t_ns >= at_ns else 0)
        return stepped_ns, stepped_ns + (1_000_000 if topic.startswith("/imu") else 3_000_000)

    return change


@dataclass(frozen=True)
class Case:
    """A copy of the recording."""

    make: Callable[[Path], Path]
    """Makes the copy in an empty folder and returns its path."""
    parts: tuple[tuple[slice, float], ...] = ((slice(None), 0.0),)
    """Frames of the segments, and what has been added to their stamps [s]."""


def cases_of(path: Path, recording: Recording) -> dict[str, Case]:
    """Return the copies of a recording by name."""
    at_ns = int(recording.frame_times_ns[MIDDLE])
    everything = ("imu0", "cam0", "cam1")
    shift_ns = -int(recording.imu.t_ns[0]) - 5 * 10**9

    def folder(change: Change) -> Callable[[Path], Path]:
        return lambda scratch: folder_copy(path, scratch, change)

    def bag(change: Callable[[str, int], tuple[int, int]]) -> Callable[[Path], Path]:
        return lambda scratch: bag_copy(recording, scratch / "bag", change)

    def halves(change_s: float) -> tuple[tuple[slice, float], ...]:
        return (slice(0, MIDDLE), 0.0), (slice(MIDDLE, None), change_s)

    return {
        "unchanged": Case(lambda _: path),
        **{
            f"all {change_s:+.3f} s": Case(folder(step(change_s, everything, at_ns)), halves(change_s))
            for change_s in (-3.013, -3.0, -1.0, -0.3, 5.0)
        },
        "IMU alone -3.013 s": Case(folder(step(-3.013, ("imu0",), at_ns))),
        "cameras alone -3.013 s": Case(folder(step(-3.013, ("cam0", "cam1"), at_ns))),
        "single late rows": Case(folder(late_rows)),
        **{f"bursts of {size}": Case(folder(bursts(size))) for size in (2, 4, 8, 16)},
        "stamps from -5 s on": Case(folder(shifted(shift_ns)), ((slice(None), shift_ns * 1e-9),)),
        "bag, IMU unset": Case(bag(unset("/imu"))),
        "bag, cameras unset": Case(bag(unset("/cam"))),
        "bag, all unset": Case(bag(unset("/"))),
        "bag, computer -3.013 s": Case(bag(stepped_bag(-3_013_000_000, at_ns)), halves(-3.013)),
    }


def error_mm(run: EstimatorRun, truth: Trajectory, shift_s: float) -> float:
    """Return the absolute trajectory error of a run, whose clock is ahead of the truth [mm]; infinite without poses."""
    if len(run.trajectory) < 3:
        return float("inf")
    return 1e3 * ate(replace(truth, t_ns=truth.t_ns + round(shift_s * 1e9)), run).rmse


def speed_m_s(run: EstimatorRun) -> float:
    """Return the largest speed of the states that were published, valid or not [m/s]."""
    states = [estimate.state for estimate in run.estimates if estimate.state is not None]
    return max((float(np.linalg.norm(state.velocity_m_s)) for state in states), default=0.0)


def rows_of(
    name: str, case: Case, recording: Recording, cameras: int, folder: Path, references: dict[Part, float]
) -> list[dict[str, str]]:
    """Return the rows of a case, one for each segment; the last column is what is wrong.

    Args:
        name: Name of the case.
        case: The copy to estimate.
        recording: The original.
        cameras: Number of cameras.
        folder: Empty folder for the copy.
        references: Errors of parts of the original that are known already, to which others are added [mm].
    """
    truth = recording.ground_truth
    assert truth is not None
    try:
        segments = segments_of(open_recording(case.make(folder), cameras, repair=True))
    except DronevioError as error:
        return [{**dict.fromkeys(TITLES, ""), "copy": name, "wrong": str(error)}]
    rows: list[dict[str, str]] = []
    wrong = [] if len(segments) == len(case.parts) else [f"{len(segments)} segments instead of {len(case.parts)}"]
    for number, segment in enumerate(segments):
        part, shift_s = case.parts[min(number, len(case.parts) - 1)]
        run = odometry(segment)
        if (part.start, part.stop) not in references:
            reference = odometry(cut(recording, part))
            references[part.start, part.stop] = error_mm(reference, truth, 0.0)
        by_hand_mm = references[part.start, part.stop]
        ate_mm, speed = error_mm(run, truth, shift_s), speed_m_s(run)
        if not ate_mm <= LARGEST_RATIO * by_hand_mm:
            wrong.append(f"error {ate_mm / by_hand_mm:.2f} ×")
        if speed > LARGEST_SPEED_M_S:
            wrong.append(f"{speed:.0f} m/s")
        rows.append(
            {
                "copy": name if number == 0 else f"  segment {number + 1}",
                "frames": f"{len(segment.frame_times_ns)}",
                "first pose": f"{first_pose_s(run):.2f} s",
                "error": f"{ate_mm:.1f} mm",
                "cut by hand": f"{by_hand_mm:.1f} mm",
                "largest speed": f"{speed:.2f} m/s",
                "health": ", ".join(f"{n} {health}" for health, n in Counter(e.health for e in run.estimates).items()),
                "defects": defects_text(run.defects),
                "wrong": "; ".join(wrong),
            }
        )
        wrong = []
    return rows


def main(command: ClockStepsCommand) -> int:
    """Estimate all copies and print the table; return 1 if a bound does not hold."""
    recording, _ = opened(command.recording, command.cameras)
    cases, rows = cases_of(command.recording, recording), []
    references: dict[Part, float] = {}
    for name in command.cases or cases:
        with tempfile.TemporaryDirectory(prefix="dronevio-") as scratch:
            rows += rows_of(name, cases[name], recording, command.cameras, Path(scratch), references)
    print_rows(f"{recording.name}, {command.cameras} cameras", rows, left=("health", "defects", "wrong"))
    return int(any(row["wrong"] for row in rows))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(ClockStepsCommand, description=__doc__)))
