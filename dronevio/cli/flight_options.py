"""What the commands that fly have in common: a scenario, and every part of it open to change.

The parts are given on the command line, with the scenario's own values as defaults: ``--help`` shows them, and
``dronevio fly --scenario forest-medium --help`` those of the forest.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Self, TypeVar

import tyro

from dronevio.cli.terminal import parse
from dronevio.sim.faults import Faults
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.physics.wind import Wind

if TYPE_CHECKING:
    from dronevio.sim.cameras.imaging import Imaging
    from dronevio.sim.scenario import Scenario

DEFAULT_SCENARIO = "room"
"""What is flown where nothing else is said."""


@dataclass(frozen=True)
class ImagingOptions:
    """How the cameras expose, and how noisy they are."""

    exposure_s: float = 0.002
    """Exposure time [s]; the longest one with auto-exposure. Images blur while it lasts."""
    auto_exposure: bool = False
    """Choose exposure time and gain of each frame from the frames before."""
    read_sigma: float = 1.2
    """Noise of a black image [grey levels]."""
    shot_sigma: float = 2.2
    """Photon noise of a white image [grey levels]."""
    vignetting: float = 0.18
    """How much less light falls on the furthest corner, relative."""

    @classmethod
    def of(cls, imaging: "Imaging") -> Self:
        """Return the options that describe a scenario's imaging."""
        from dronevio.sim.cameras.imaging import AutoExposure

        automatic = isinstance(imaging.control, AutoExposure)
        return cls(imaging.control.longest_s, automatic, imaging.read_sigma, imaging.shot_sigma, imaging.vignetting)

    def imaging(self, scenarios_own: "Imaging") -> "Imaging":
        """Return a scenario's imaging with these options."""
        from dronevio.sim.cameras.imaging import AutoExposure, FixedExposure

        control = scenarios_own.control
        if self != ImagingOptions.of(scenarios_own):
            control = AutoExposure(longest_s=self.exposure_s) if self.auto_exposure else FixedExposure(self.exposure_s)
        return replace(
            scenarios_own,
            control=control,
            read_sigma=self.read_sigma,
            shot_sigma=self.shot_sigma,
            vignetting=self.vignetting,
        )


@dataclass(frozen=True)
class FlightOptions:
    """What to fly."""

    scenario: str = DEFAULT_SCENARIO
    """What to fly; `dronevio scenarios` lists them."""
    seed: int = 0
    """Draws the world, the way through it and the sensors' errors."""
    world: str | None = None
    """Another world than the scenario's; `dronevio worlds` lists them."""
    vehicle: str | None = None
    """Another vehicle: research (1.5 kg) or nano (30 g)."""
    rig: str | None = None
    """Other sensors: a name such as euroc-stereo, fisheye or rolling, a Kalibr camchain.yaml, or a recording."""
    imu: str | None = None
    """Another IMU on the rig: euroc, ADIS16448, BMI088, MPU-6050 or tactical."""
    plan: FlightPlan = field(default_factory=FlightPlan)
    """The path."""
    imaging: ImagingOptions = field(default_factory=ImagingOptions)
    """The cameras' sensors."""
    wind: Wind = field(default_factory=Wind)
    """The air."""
    faults: Faults = field(default_factory=Faults)
    """What goes wrong."""

    @classmethod
    def of(cls, scenario: "Scenario") -> Self:
        """Return the options that change nothing of a scenario."""
        return cls(
            scenario=scenario.name,
            seed=scenario.seed,
            plan=scenario.plan,
            imaging=ImagingOptions.of(scenario.imaging),
            wind=scenario.wind,
            faults=scenario.faults,
        )

    def chosen(self) -> "Scenario":
        """Return the scenario with all changes.

        Raises:
            ConfigError: There is nothing of such a name, or it does not fit together.
            InputError: The rig's file cannot be read.
        """
        from dronevio.models.imu_presets import imu_named
        from dronevio.models.quadrotor import vehicle_named
        from dronevio.recorder import rig_of
        from dronevio.sim.scenarios import scenario

        base = scenario(self.scenario, self.seed)
        rig = base.rig if self.rig is None else rig_of(self.rig)
        return replace(
            base,
            world=self.world or base.world,
            quadrotor=base.quadrotor if self.vehicle is None else vehicle_named(self.vehicle),
            rig=rig if self.imu is None else replace(rig, imu=imu_named(self.imu)),
            plan=self.plan,
            imaging=self.imaging.imaging(base.imaging),
            wind=self.wind,
            faults=self.faults,
        )


Flown = Annotated[FlightOptions, tyro.conf.arg(name="")]
"""The type of a command's field that holds the options, which then have no prefix."""
Command = TypeVar("Command")


def parse_flight(command: type[Command], arguments: Sequence[str], name: str) -> Command:
    """Return a command with a field ``flight`` of `FlightOptions`, filled from the command line.

    The scenario is looked up first, since it says what the defaults of all the others are.

    Raises:
        ConfigError: There is no such scenario.
    """
    from dronevio.sim.scenarios import scenario

    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--scenario", default=DEFAULT_SCENARIO)
    named = first.parse_known_args(list(arguments))[0].scenario
    return parse(command, arguments, name, default=command(flight=FlightOptions.of(scenario(named))))  # type: ignore[call-arg]
