"""Render the first frames of one flight with several exposure times, and with a rolling shutter.

Motion blur and a rolling shutter cannot be applied to finished images, so that each condition is a recording of its
own. Path, IMU samples, brightness and noise are the same in all of them; ``benchmarks/image_conditions.py`` compares
them::

    python benchmarks/rendered_conditions.py flights --scenario room-medium
    python benchmarks/image_conditions.py flights/* --conditions none
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from dronevio.models.recordings.euroc import write_euroc
from dronevio.models.rig_presets import rig_named
from dronevio.sim.cameras.exposure import FixedExposure
from dronevio.sim.flight import fly
from dronevio.sim.rendering.render import render_frames
from dronevio.sim.rendering.render_job import RenderJob
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import scenario_named

Condition = Callable[[Scenario], Scenario]
"""Returns a scenario under a condition."""


def exposed(time_s: float) -> Condition:
    """Return the condition of an exposure time [s] whose images have the brightness of the scenario.

    A smaller aperture accounts for a longer exposure: the same number of electrons is collected, so that the noise is
    the same, too.
    """

    def condition(scenario: Scenario) -> Scenario:
        imaging = replace(scenario.imaging, control=FixedExposure(time_s), nominal_exposure_s=time_s)
        return replace(scenario, imaging=imaging)

    return condition


def rolling(readout_s: float) -> Condition:
    """Return the condition that all cameras have a rolling shutter, whose readout time [s] the calibration states."""

    def condition(scenario: Scenario) -> Scenario:
        cameras = tuple(replace(camera, readout_s=readout_s) for camera in scenario.rig.cameras)
        return replace(scenario, rig=replace(scenario.rig, cameras=cameras))

    return condition


CONDITIONS: Mapping[str, Condition] = {
    "exposure-1ms": exposed(0.001),
    "exposure-2ms": exposed(0.002),
    "exposure-5ms": exposed(0.005),
    "exposure-10ms": exposed(0.010),
    "exposure-15ms": exposed(0.015),
    "rolling-20ms": rolling(0.020),
}
"""Conditions by name. With the rolling shutter, the exposure time is that of the scenario."""


@dataclass(frozen=True)
class RenderingCommand:
    """Render one recording for each condition, named SCENARIO-SEED-CONDITION."""

    folder: tyro.conf.Positional[Path]
    """Folder of the recordings, which is made if it does not exist."""
    scenario: str = "room-medium"
    """Name of the scenario."""
    seed: int = 0
    """Seed of the flight."""
    rig: str = "euroc-stereo"
    """Name of the rig."""
    frames: int = 200
    """Number of frames, from the first on."""
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    """Names of the conditions."""


def render(scenario: Scenario, folder: Path, frames: int) -> None:
    """Simulate a scenario, and write a recording of its first frames."""
    flight = fly(scenario)
    schedule = flight.schedule[:frames]
    end = int(flight.truth.t_ns.searchsorted(schedule.exposed_ns[-1] + 1_000_000_000))  # the last rows need motion, too
    imu, truth = flight.imu[:end], flight.truth[:end]
    write_euroc(folder, scenario.rig, imu, truth, schedule.stamps_ns)
    job = RenderJob(scenario.world, scenario.seed, flight.true_rig, truth, schedule, scenario.imaging)
    render_frames(job, folder / "mav0", workers=1)


def main(command: RenderingCommand) -> int:
    """Render all conditions."""
    scenario = replace(scenario_named(command.scenario, command.seed), rig=rig_named(command.rig))
    for name in command.conditions:
        print(name, file=sys.stderr, flush=True)
        folder = command.folder / f"{scenario.name}-{command.seed}-{name}"
        render(CONDITIONS[name](scenario), folder, command.frames)
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(RenderingCommand, description=__doc__)))
