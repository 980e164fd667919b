"""The options of the commands that simulate: a scenario, and settings that replace parts of it.

The defaults are the values of the scenario: ``dronevio fly --help-all`` shows those of the default scenario,
and ``dronevio fly --scenario forest-medium --help-all`` those of another.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Self, TypeVar

import tyro

from dronevio.cli.terminal import parse
from dronevio.models.errors import ConfigError
from dronevio.models.python_names import PREFIX
from dronevio.models.ranges import Range, Settings
from dronevio.sim.faults import Faults
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.physics.wind import Wind

if TYPE_CHECKING:
    from dronevio.sim.cameras.imaging import Imaging
    from dronevio.sim.scenario import Scenario

DEFAULT_SCENARIO = "room"
"""Name of the scenario that is simulated by default."""


@dataclass(frozen=True)
class ImagingOptions(Settings):
    """Exposure and noise of the cameras."""

    exposure_s: Annotated[float, Range(above=0.0, high=1.0)] = 0.002
    """Exposure time, during which moving images blur; the longest one with automatic exposure [s]."""
    auto_exposure: bool = False
    """Set exposure time and gain of each frame from the brightness of earlier frames."""
    read_sigma: Annotated[float, Range(0.0, 255.0)] = 1.2
    """Standard deviation of the noise of a black image [grey levels]."""
    shot_sigma: Annotated[float, Range(0.0, 255.0)] = 2.2
    """Standard deviation of the photon noise of a white image [grey levels]."""
    vignetting: Annotated[float, Range(0.0, 1.0)] = 0.18
    """Relative loss of light at the corner farthest from the centre."""
    blur_sigma_px: Annotated[float, Range(0.0, 10.0)] = 0.0
    """Standard deviation of the Gaussian point spread of lens and pixels, beyond the area of a pixel [px]."""
    response_sigma: Annotated[float, Range(0.0, 0.2)] = 0.0
    """Relative standard deviation of the response of pixels, a pattern that is fixed for each camera."""
    contrast: Annotated[float, Range(0.1, 10.0)] = 1.0
    """Exponent of the light of the world relative to grey level 128; above 1, shadows are darker and bright surfaces
    saturate."""

    @classmethod
    def of(cls, imaging: "Imaging") -> Self:
        """Return the options that equal the imaging of a scenario."""
        from dronevio.sim.cameras.exposure import AutoExposure

        automatic = isinstance(imaging.control, AutoExposure)
        return cls(
            imaging.control.longest_s,
            automatic,
            imaging.read_sigma,
            imaging.shot_sigma,
            imaging.vignetting,
            imaging.blur_sigma_px,
            imaging.response_sigma,
            imaging.contrast,
        )

    def imaging(self, base: "Imaging") -> "Imaging":
        """Return the imaging of a scenario with these options.

        Args:
            base: The imaging of the scenario, whose exposure control is kept if no option of it differs.
        """
        from dronevio.sim.cameras.exposure import AutoExposure, FixedExposure

        control, of_base = base.control, ImagingOptions.of(base)
        if (self.exposure_s, self.auto_exposure) != (of_base.exposure_s, of_base.auto_exposure):
            control = AutoExposure(longest_s=self.exposure_s) if self.auto_exposure else FixedExposure(self.exposure_s)
        return replace(
            base,
            control=control,
            read_sigma=self.read_sigma,
            shot_sigma=self.shot_sigma,
            vignetting=self.vignetting,
            blur_sigma_px=self.blur_sigma_px,
            response_sigma=self.response_sigma,
            contrast=self.contrast,
        )


@dataclass(frozen=True)
class FlightOptions(Settings):
    """The scenario to simulate."""

    scenario: str = DEFAULT_SCENARIO
    """Name of the scenario, which `dronevio scenarios` lists, or python:package.module:NAME."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the world, the route and the errors of the sensors."""
    world_seed: Annotated[int | None, Range(0, 2**32 - 1)] = None
    """Seed of layout, textures and moving objects of the world, instead of --seed. Flights with the same world seed are
    in the same world."""
    light_seed: Annotated[int | None, Range(0, 2**32 - 1)] = None
    """Seed of other light in the same world: the power of lamps and windows, or sun and weather. By default, the light
    belongs to the world."""
    reverse: bool = False
    """Fly the tour in the opposite direction."""
    world: str | None = None
    """World that replaces the one of the scenario; `dronevio worlds` lists them. A world of your own is a file,
    such as yard.yaml or yard.xml (MJCF), or python:package.module:NAME."""
    vehicle: str | None = None
    """Vehicle that replaces the one of the scenario: research (1.5 kg), nano (30 g), a YAML file with a vehicle of your
    own, or python:package.module:NAME; `dronevio vehicles` describes them."""
    rig: str | None = None
    """Sensors that replace those of the scenario: a name such as euroc-stereo, fisheye or rolling, a Kalibr
    camchain.yaml, a recording with its calibration, or python:package.module:NAME."""
    imu: str | None = None
    """IMU that replaces the one of the rig: euroc, ADIS16448, BMI088, MPU-6050 or tactical."""
    image_sensor: str | None = None
    """Image sensor whose values are the defaults of the options of imaging, instead of those of the scenario: standard,
    with short exposures, or vi-sensor, with the exposures, noise and contrast of EuRoC's images."""
    plan: FlightPlan = field(default_factory=FlightPlan)
    """Settings of the planned trajectory."""
    imaging: ImagingOptions = field(default_factory=ImagingOptions)
    """Settings of exposure and image noise."""
    wind: Wind = field(default_factory=Wind)
    """Settings of the wind."""
    faults: Faults = field(default_factory=Faults)
    """Settings of faults of vehicle and sensors."""

    @classmethod
    def of(cls, scenario: "Scenario", image_sensor: str | None = None) -> Self:
        """Return the options that leave a scenario unchanged, but for its image sensor if one is given.

        Raises:
            ConfigError: There is no such image sensor.
        """
        from dronevio.sim.cameras.imaging import image_sensor_named

        imaging = scenario.imaging if image_sensor is None else image_sensor_named(image_sensor)
        return cls(
            scenario=scenario.name,
            seed=scenario.seed,
            world_seed=scenario.world_seed,
            light_seed=scenario.light_seed,
            reverse=scenario.reverse,
            image_sensor=image_sensor,
            plan=scenario.plan,
            imaging=ImagingOptions.of(imaging),
            wind=scenario.wind,
            faults=scenario.faults,
        )

    def chosen(self) -> "Scenario":
        """Return the scenario with all replaced settings.

        Raises:
            ConfigError: A name is unknown, or the settings contradict each other.
            InputError: The file of the rig or of the vehicle cannot be read, or is wrong.
        """
        from dronevio.models.imu_presets import imu_named
        from dronevio.models.vehicles import vehicle_of
        from dronevio.recording.recorder import rig_of
        from dronevio.sim.cameras.imaging import image_sensor_named
        from dronevio.sim.scenarios import scenario_named
        from dronevio.sim.world import resolved_world

        base = scenario_named(self.scenario, self.seed)
        rig = base.rig if self.rig is None else rig_of(self.rig)
        return replace(
            base,
            world=base.world if self.world is None else resolved_world(self.world),
            world_seed=self.world_seed,
            light_seed=self.light_seed,
            reverse=self.reverse,
            quadrotor=base.quadrotor if self.vehicle is None else vehicle_of(self.vehicle),
            rig=rig if self.imu is None else replace(rig, imu=imu_named(self.imu)),
            plan=self.plan,
            imaging=self.imaging.imaging(
                base.imaging if self.image_sensor is None else image_sensor_named(self.image_sensor)
            ),
            wind=self.wind,
            faults=self.faults,
        )


ScenarioInput = Annotated[FlightOptions, tyro.conf.arg(name="")]
"""Type of a command's field with these options, which carry no prefix on the command line."""
Command = TypeVar("Command")


COLLIDED = 3
"""Exit code of a command whose flight has ended by a collision."""


def parse_flight(command: type[Command], arguments: Sequence[str], name: str) -> Command:
    """Return a command with a field ``flight`` of `FlightOptions`, filled from the command line.

    The scenario and the image sensor are looked up first because their values are the defaults of other options.

    Args:
        command: The dataclass of the command.
        arguments: The words after the command's name.
        name: The command's name without ``dronevio``.

    Raises:
        ConfigError: There is no such scenario or image sensor.
    """
    from dronevio.sim.scenarios import scenario_named

    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    first.add_argument("--scenario", default=DEFAULT_SCENARIO)
    first.add_argument("--image-sensor", default=None)
    try:
        named = first.parse_known_args(list(arguments))[0]
    except argparse.ArgumentError as error:
        raise ConfigError(f"{error.argument_name}: {error.message}") from None
    options = FlightOptions.of(scenario_named(named.scenario), named.image_sensor)
    if named.scenario.startswith(PREFIX):  # its own name would not find it again
        options = replace(options, scenario=named.scenario)
    return parse(command, arguments, name, {"flight": options})
