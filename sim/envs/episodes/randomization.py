"""Domain randomization: distributions of physical parameters, and the values that are drawn for each episode."""

from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import Quadrotor
from dronevio.sim.envs.episodes.distributions import Constant, Distribution, LogUniform, Normal, Uniform
from dronevio.sim.physics.vehicle_states import Table, VehicleParameters

_ZERO, _ONE = Constant(0.0), Constant(1.0)


@dataclass(frozen=True)
class Randomization:
    """Distributions of the parameters that are drawn at the start of each episode; nothing varies by default."""

    mass: Distribution = _ONE
    """Factor of the mass of the vehicle."""
    inertia: Distribution = _ONE
    """Factor of each principal moment of inertia."""
    rotor_time_constant: Distribution = _ONE
    """Factor of the time constant of the rotors."""
    thrust: Distribution = _ONE
    """Factor of thrust and torque of the rotors."""
    drag: Distribution = _ONE
    """Factor of all drag coefficients."""
    wind_m_s: Distribution = _ZERO
    """Speed of the mean wind, whose direction is horizontal and uniformly distributed [m/s]."""
    gusts: Distribution = _ZERO
    """Strength of the gusts relative to the standard at the speed of the mean wind; see `Wind`."""
    latency_s: Distribution = _ZERO
    """Time from an observation to the effect of its action, rounded to IMU intervals [s]."""
    imu_errors: Distribution = _ONE
    """Factor of noise densities and of all other errors of the IMU."""
    camera_rotation_rad: Distribution = _ZERO
    """Each component of the rotation vector by which the cameras are rotated about the IMU from their calibration
    [rad]."""
    camera_translation_m: Distribution = _ZERO
    """Each component of the displacement of the cameras from their calibration, in the IMU frame [m]."""
    light: Distribution = _ONE
    """Illumination relative to that of the world."""
    world_seeds: tuple[int, ...] = ()
    """Seeds of the worlds, one of which is drawn; only that of the environment by default."""
    texture_seeds: tuple[int, ...] = ()
    """Seeds of the worlds whose textures and light appear in images, one of which is drawn; only that of the world of
    the episode by default."""

    def __post_init__(self) -> None:
        """Check the types of the values.

        Raises:
            ConfigError: A value is a number instead of a distribution.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name not in ("world_seeds", "texture_seeds") and not callable(getattr(value, "sample", None)):
                raise ConfigError(
                    f"randomization.{field.name} = {value!r}; expected a distribution, such as Constant(…) or "
                    "Uniform(…, …)"
                )

    def draw(self, rng: np.random.Generator, count: int, world_seed: int) -> "RandomizedParameters":
        """Return independent values for ``count`` episodes.

        Args:
            rng: Generator of the values.
            count: Number of episodes.
            world_seed: Seed of the world without ``world_seeds``.
        """
        worlds = _drawn(rng, self.world_seeds, np.full(count, world_seed, dtype=np.int64))
        one, three = (count,), (count, 3)
        angle = rng.uniform(-np.pi, np.pi, count)
        speed = self.wind_m_s.sample(rng, one)
        return RandomizedParameters(
            mass=self.mass.sample(rng, one),
            inertia=self.inertia.sample(rng, three),
            rotor_time_constant=self.rotor_time_constant.sample(rng, one),
            thrust=self.thrust.sample(rng, one),
            drag=self.drag.sample(rng, one),
            wind_m_s=np.stack([speed * np.cos(angle), speed * np.sin(angle), np.zeros(count)], axis=1),
            gusts=self.gusts.sample(rng, one),
            latency_s=self.latency_s.sample(rng, one),
            imu_errors=self.imu_errors.sample(rng, one),
            camera_rotation_rad=self.camera_rotation_rad.sample(rng, three),
            camera_translation_m=self.camera_translation_m.sample(rng, three),
            light=self.light.sample(rng, one),
            world_seed=worlds,
            texture_seed=_drawn(rng, self.texture_seeds, worlds),
        )


@dataclass(frozen=True, eq=False)
class RandomizedParameters(Table):
    """Randomized parameters of n episodes."""

    mass: Array
    """(n,) Factors of the mass."""
    inertia: Array
    """(n, 3) Factors of the principal moments of inertia."""
    rotor_time_constant: Array
    """(n,) Factors of the time constant of the rotors."""
    thrust: Array
    """(n,) Factors of thrust and torque of the rotors."""
    drag: Array
    """(n,) Factors of all drag coefficients."""
    wind_m_s: Array
    """(n, 3) Mean velocities of the air in the world frame [m/s]."""
    gusts: Array
    """(n,) Strengths of the gusts."""
    latency_s: Array
    """(n,) Times from observations to the effects of their actions [s]."""
    imu_errors: Array
    """(n,) Factors of the errors of the IMU."""
    camera_rotation_rad: Array
    """(n, 3) Rotation vectors of the mounting errors of the cameras, in the IMU frame [rad]."""
    camera_translation_m: Array
    """(n, 3) Displacements of the cameras from their calibration, in the IMU frame [m]."""
    light: Array
    """(n,) Illuminations relative to that of the world."""
    world_seed: npt.NDArray[np.int64]
    """(n,) Seeds of the worlds."""
    texture_seed: npt.NDArray[np.int64]
    """(n,) Seeds of the worlds whose textures appear in images."""

    @classmethod
    def nominal(cls, count: int, world_seed: int) -> Self:
        """Return the values of ``count`` episodes without randomization."""
        ones, zeros, vectors = np.ones(count), np.zeros(count), np.zeros((count, 3))
        return cls(
            mass=ones,
            inertia=np.ones((count, 3)),
            rotor_time_constant=ones,
            thrust=ones,
            drag=ones,
            wind_m_s=vectors,
            gusts=zeros,
            latency_s=zeros,
            imu_errors=ones,
            camera_rotation_rad=vectors,
            camera_translation_m=vectors,
            light=ones,
            world_seed=np.full(count, world_seed, dtype=np.int64),
            texture_seed=np.full(count, world_seed, dtype=np.int64),
        )

    def parameters(self, quadrotor: Quadrotor) -> VehicleParameters:
        """Return the physical parameters of vehicles of a type.

        Raises:
            ConfigError: A factor of mass, inertia, time constant or thrust is not positive.
        """
        return VehicleParameters(
            mass_kg=quadrotor.mass_kg * self.mass,
            inertia_kg_m2=np.array(quadrotor.inertia_kg_m2) * self.inertia,
            rotor_time_constant_s=quadrotor.rotor_time_constant_s * self.rotor_time_constant,
            thrust_scale=self.thrust.copy(),
            drag_scale=self.drag.copy(),
        )

    def values(self) -> dict[str, npt.NDArray[np.generic]]:
        """Return the values by name, as arrays of n rows."""
        return {field.name: getattr(self, field.name).copy() for field in fields(self)}


def _drawn(rng: np.random.Generator, seeds: tuple[int, ...], default: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return one of some seeds for each episode (k,), or the default without any."""
    return rng.choice(np.array(seeds, dtype=np.int64), len(default)) if seeds else default


NOTHING_RANDOM = Randomization()
"""No randomization: every episode has the nominal vehicle in still air."""
MODERATE = Randomization(
    mass=Uniform(0.9, 1.1),
    inertia=Uniform(0.8, 1.2),
    rotor_time_constant=LogUniform(0.7, 1.4),
    thrust=Uniform(0.93, 1.07),
    drag=LogUniform(0.5, 2.0),
    wind_m_s=Uniform(0.0, 2.0),
    gusts=Uniform(0.0, 1.0),
    latency_s=Uniform(0.0, 0.02),
    imu_errors=LogUniform(0.5, 2.0),
    camera_rotation_rad=Normal(0.0, 0.01),
    camera_translation_m=Normal(0.0, 0.003),
    light=LogUniform(0.7, 1.4),
)
"""Moderate randomization, about the uncertainty of a vehicle whose parameters have been measured."""
