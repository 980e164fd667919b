"""``dronevio refly``: the trajectory of a real drone with rendered images."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from dronevio.cli.options import Output, OutputOptions
from dronevio.cli.terminal import command_line, parse, print_json, print_values, progress_bars
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class ReflyCommand(Settings):
    """Render images along the recorded trajectory of a real drone, with its real IMU or a synthesized one.

    The trajectory is the ground truth of the result: a TUM file or an EuRoC ground truth, poses of the IMU in a world
    whose z axis points up. Time stamps and body frame stay those of the recording, and the world is placed around the
    trajectory without a collision. With --imu, the real IMU samples are copied; without it, samples are synthesized
    along a smooth spline through the trajectory. The recording is a folder in the EuRoC layout, as `dronevio fly`
    writes it.

    Examples:
      dronevio refly --trajectory gt.csv --imu imu0.csv --world room
      dronevio refly --trajectory gt.tum --world forest --rig fisheye-stereo --duration-s 20
      dronevio refly --trajectory MH_01/mav0 --rig MH_01/mav0 --image-sensor vi-sensor
      dronevio refly --trajectory V1_02/mav0 --out recordings/V1_02 && dronevio estimate recordings/V1_02
    """

    trajectory: Path
    """Recorded trajectory: a TUM file, an EuRoC ground truth file, or a recording with ground truth."""
    imu: Path | None = None
    """Recorded IMU samples that belong to the trajectory, an EuRoC imu0/data.csv. Without it, samples are
    synthesized."""
    world: str = "room"
    """World that is placed around the trajectory; `dronevio worlds` lists them. A world of your own is a file,
    such as yard.yaml or yard.xml (MJCF), or python:package.module:NAME."""
    rig: str = "euroc"
    """Sensors: a name such as euroc-stereo, a Kalibr camchain.yaml, or an EuRoC folder with sensor.yaml files."""
    image_sensor: str = "standard"
    """Image sensor: standard, with short exposures, or vi-sensor, with the exposures, noise and contrast of EuRoC's
    images."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the world, of the image noise and of the errors of a synthesized IMU."""
    start_s: Annotated[float, Range(low=0.0)] = 0.0
    """Time after the beginning of the trajectory at which the recording begins [s]."""
    duration_s: Annotated[float | None, Range(above=0.0)] = None
    """Duration of the recording [s]; up to the end of the trajectory by default."""
    margin_m: Annotated[float, Range(0.0, 100.0)] = 0.3
    """Smallest distance of the trajectory from all surfaces of the world [m]."""
    out: Path | None = None
    """Folder to make; recordings/NAME-WORLD-SEED by default."""
    output: Output = field(default_factory=OutputOptions)
    """How the result is written and printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(ReflyCommand, arguments, "refly")

    import numpy as np

    from dronevio.cli.output_files import atomic_folder, size_mb
    from dronevio.models.recordings.euroc import read_imu
    from dronevio.models.recordings.trajectory_file import read_trajectory_file
    from dronevio.recording.recorder import record_refly, rig_of
    from dronevio.sim.cameras.gl import require_gl
    from dronevio.sim.cameras.imaging import image_sensor_named
    from dronevio.sim.refly import cut, refly
    from dronevio.sim.worlds.own.names import file_stem, recorded_world, shown_world

    imaging = image_sensor_named(command.image_sensor)
    path = cut(read_trajectory_file(command.trajectory), command.start_s, command.duration_s)
    imu = None if command.imu is None else read_imu(command.imu)
    flown = refly(path, imu, rig_of(command.rig), command.world, command.seed, command.margin_m)
    name = flight_name(command.trajectory)
    target = command.out or Path("recordings") / f"{name}-{file_stem(command.world)}-{command.seed}"
    require_gl()
    with atomic_folder(target, command.output.overwrite) as folder, progress_bars(quiet=command.output.json) as bars:
        record_refly(flown, command.seed, folder, bars.bar("rendering"), imaging=imaging)
    speed = np.linalg.norm(np.diff(path.p_world_imu, axis=0), axis=1) / (np.diff(path.t_ns) * 1e-9)
    figures = {
        "duration_s": float(path.t_s[-1]),
        "path_m": path.length_m,
        "peak_speed_m_s": float(np.percentile(speed, 99.9)),  # without the jumps of the tracking system
        "frames": len(flown.schedule),
        "imu_samples": len(flown.imu),
        "imu": "real" if flown.real_imu else "synthesized",
    }
    if command.output.json:
        print_json({"recording": str(target), "world": recorded_world(flown.world), "seed": command.seed, **figures})
        return 0
    print_values(
        f"{name} in {shown_world(command.world)}, seed {command.seed}",
        (
            ("duration", f"{figures['duration_s']:.1f}", "s"),
            ("length of the path", f"{figures['path_m']:.1f}", "m"),
            ("peak speed", f"{figures['peak_speed_m_s']:.2f}", "m/s"),
            ("frames", f"{figures['frames']}", ""),
            (f"IMU samples, {figures['imu']}", f"{figures['imu_samples']}", ""),
            ("size", f"{size_mb(target):.0f}", "MB"),
        ),
    )
    print(f"wrote {target}")
    print(f"estimate it:  {command_line('estimate', target)}")
    return 0


def flight_name(trajectory: Path) -> str:
    """Return a name for the flight of a file: the file's, or that of the innermost folder with a specific name."""
    path = trajectory.absolute()
    generic = ("mav0", "data", "groundtruth", "state_groundtruth_estimate0")
    while path.stem in generic and path.parent != path:
        path = path.parent
    return path.stem or "flight"
