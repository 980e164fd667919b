"""``dronevio fly``: from a scenario to a recording."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from dronevio.cli.flight_options import COLLIDED, FlightOptions, ScenarioInput, parse_flight
from dronevio.cli.options import Output, OutputOptions
from dronevio.cli.settings.changes import SettingsInput, SettingsOptions
from dronevio.cli.terminal import command_line, print_json, print_values, progress_bars, with_scenario

if TYPE_CHECKING:
    from dronevio.sim.flight import Flight


@dataclass(frozen=True)
class FlyCommand:
    """Simulate a scenario and record the data of its cameras and IMU, with ground truth.

    The recording is a folder in the EuRoC (ASL) layout: mav0/cam0, cam1 and so on with the images, mav0/imu0, the
    calibration, the ground truth in mav0/state_groundtruth_estimate0, and all settings in scenario.json. Every setting
    of a scenario can be replaced. The same settings and seed give the same bytes.

    Examples:
      dronevio fly
      dronevio fly forest-medium --seed 3 --rig euroc-stereo
      dronevio fly --scenario hall-race --rig fisheye-stereo --imu BMI088 --wind.mean-m-s 4 0 0 --wind.gusts 1
      dronevio fly --plan.shape figure-8 --plan.limits.speed-m-s 3 --imaging.exposure-s 0.008 --truth-images depth flow
      dronevio fly --faults.dark-from-s 10 --faults.dark-for-s 2 --out recordings/dark
    """

    flight: ScenarioInput = field(default_factory=FlightOptions)
    """The scenario to simulate."""
    truth_images: tuple[Literal["depth", "segmentation", "flow"], ...] = ()
    """Ground-truth images to write beside those of the first camera: depth, segmentation, optical flow."""
    out: Path | None = None
    """Folder to make; recordings/SCENARIO-SEED by default."""
    output: Output = field(default_factory=OutputOptions)
    """How the result is written and printed."""
    changes: SettingsInput = field(default_factory=SettingsOptions)
    """Changes of settings."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    arguments = with_scenario(arguments)
    command = parse_flight(FlyCommand, arguments, "fly")

    from dronevio.cli.output_files import atomic_folder, size_mb
    from dronevio.recording.recorder import record_flight
    from dronevio.sim.cameras.gl import require_gl

    scenario, quiet = command.flight.chosen(), command.output.json
    target = command.out or Path("recordings") / f"{scenario.name}-{scenario.seed}"
    require_gl()
    with atomic_folder(target, command.output.overwrite) as folder, progress_bars(quiet) as bars:
        flight = record_flight(
            scenario, folder, bars.bar("simulating"), bars.bar("rendering"), truth_images=command.truth_images
        )
    figures, code = flight_figures(flight), 0 if flight.collision is None else COLLIDED
    if command.output.json:
        named = {"recording": str(target), "scenario": scenario.name, "seed": scenario.seed}
        print_json({**named, **figures, "collision": None if flight.collision is None else str(flight.collision)})
        return code
    print_values(
        f"Flight {scenario.name}, seed {scenario.seed}: {scenario.description}",
        (
            ("duration", f"{figures['duration_s']:.1f}", "s"),
            ("length of the path", f"{figures['path_m']:.1f}", "m"),
            ("peak speed", f"{figures['peak_speed_m_s']:.2f}", "m/s"),
            ("peak rotation rate", f"{figures['peak_rate_deg_s']:.0f}", "°/s"),
            ("frames", f"{figures['frames']:.0f}", ""),
            ("IMU samples", f"{figures['imu_samples']:.0f}", ""),
            ("size", f"{size_mb(target):.0f}", "MB"),
        ),
    )
    if flight.collision is not None:
        print(f"the flight ended early: the drone {flight.collision}")
    print(f"wrote {target}")
    print(f"estimate it:  {command_line('estimate', target)}")
    return code


def flight_figures(flight: "Flight") -> dict[str, float]:
    """Return duration, length, peaks and numbers of samples of a flight, with the units in their names."""
    import numpy as np

    truth = flight.truth
    assert truth.velocity_m_s is not None
    return {
        "duration_s": float(truth.t_s[-1]),
        "path_m": truth.length_m,
        "peak_speed_m_s": float(np.linalg.norm(truth.velocity_m_s, axis=1).max()),
        "peak_rate_deg_s": float(np.rad2deg(np.linalg.norm(flight.perfect_imu.gyro_rad_s, axis=1).max())),
        "frames": len(flight.frame_times_ns),
        "imu_samples": len(flight.imu),
    }
