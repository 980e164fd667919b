"""``dronevio refly``: a real drone's path, seen by a camera of ours."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dronevio.cli.terminal import parse, print_json, print_table, progress_bars


@dataclass(frozen=True)
class ReflyCommand:
    """Render along a path that a real drone has flown, and keep its real IMU or synthesize one.

    The path is the truth of the result: a TUM file or an EuRoC ground truth, z up, poses of the IMU. Time stamps and
    body frame stay those of the recording; the world is laid around the path wherever it fits. With --imu the real IMU
    samples are kept as they are; without, an IMU is carried along a smooth spline through the path. The recording is a
    folder of EuRoC's layout, like that of `dronevio fly`.

    Examples:
      dronevio refly --trajectory gt.csv --imu imu0.csv --world room
      dronevio refly --trajectory gt.tum --world forest --rig fisheye-stereo --duration-s 20
      dronevio refly --trajectory V1_02/mav0 --out recordings/V1_02 && dronevio estimate recordings/V1_02
    """

    trajectory: Path
    """The path: a TUM file, an EuRoC ground truth, or a recording that has one."""
    imu: Path | None = None
    """The IMU that was recorded with it, an EuRoC imu0/data.csv."""
    world: str = "room"
    """Where to lay it; `dronevio worlds` lists them."""
    rig: str = "euroc"
    """The sensors: a name, a Kalibr camchain.yaml, or an EuRoC folder with sensor.yaml files."""
    seed: int = 0
    """Draws the world, the images' noise and a synthesized IMU's errors."""
    start_s: float = 0.0
    """Where in the path to begin [s]."""
    duration_s: float | None = None
    """How much of it to fly [s]; all by default."""
    margin_m: float = 0.3
    """How far the path keeps from every surface [m]."""
    out: Path | None = None
    """Folder to make; recordings/NAME-WORLD-SEED by default."""
    overwrite: bool = False
    """Replace an earlier recording, once the new one is complete."""
    json: bool = False
    """Print one JSON document instead of a table."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(ReflyCommand, arguments, "refly")

    import numpy as np

    from dronevio.cli.folders import atomic_folder, size_mb
    from dronevio.models.recordings.euroc import read_imu
    from dronevio.models.recordings.tum import read_trajectory
    from dronevio.recorder import record_refly, rig_of
    from dronevio.sim.cameras.gl import require_gl
    from dronevio.sim.refly import cut, refly

    path = cut(read_trajectory(command.trajectory), command.start_s, command.duration_s)
    imu = None if command.imu is None else read_imu(command.imu)
    flown = refly(path, imu, rig_of(command.rig), command.world, command.seed, command.margin_m)
    target = command.out or Path("recordings") / f"{_name(command.trajectory)}-{command.world}-{command.seed}"
    require_gl()
    with atomic_folder(target, command.overwrite) as folder, progress_bars(quiet=command.json) as bars:
        record_refly(flown, command.seed, folder, bars.bar("rendering"))
    speed = np.linalg.norm(np.diff(path.p_world_imu, axis=0), axis=1) / (np.diff(path.t_ns) * 1e-9)
    figures = {
        "duration_s": float(path.t_s[-1]),
        "path_m": path.length_m,
        "peak_speed_m_s": float(np.percentile(speed, 99.9)),  # a tracking system's jumps are none of the drone's
        "frames": len(flown.schedule),
        "imu_samples": len(flown.imu),
        "imu": "real" if flown.real_imu else "synthesized",
    }
    if command.json:
        print_json({"recording": str(target), "world": command.world, "seed": command.seed, **figures})
        return 0
    print_table(
        f"{_name(command.trajectory)} flown again in {command.world}, seed {command.seed}",
        ("", "value", "unit"),
        (
            ("duration", f"{figures['duration_s']:.1f}", "s"),
            ("path", f"{figures['path_m']:.1f}", "m"),
            ("peak speed", f"{figures['peak_speed_m_s']:.2f}", "m/s"),
            ("frames", f"{figures['frames']}", ""),
            (f"IMU samples, {figures['imu']}", f"{figures['imu_samples']}", ""),
            ("size", f"{size_mb(target):.0f}", "MB"),
        ),
    )
    print(f"wrote {target}")
    print(f"estimate it:  dronevio estimate {target}")
    return 0


def _name(trajectory: Path) -> str:
    """Return what to call the flight of a file: the folder that holds it, or its own name without the ending."""
    path = trajectory.absolute()
    generic = ("mav0", "data", "groundtruth", "state_groundtruth_estimate0")
    while path.stem in generic and path.parent != path:
        path = path.parent
    return path.stem or "flight"
