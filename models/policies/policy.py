"""A trained policy: a network, and everything that is needed to use it in an environment or on a drone."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import prod

import numpy as np
import numpy.typing as npt

from dronevio.models.actions import ACTION_MODES, ActionLimits
from dronevio.models.errors import ConfigError
from dronevio.models.policies.arrays32 import Array32, PolicyError
from dronevio.models.policies.convolutions import LARGEST_IMAGE
from dronevio.models.policies.document import LONGEST_LIST, LONGEST_TEXT
from dronevio.models.policies.network import Network, Scaling
from dronevio.models.rotors import MOST_ROTORS

ACTIONS = 4
"""Number of values of an action, but for one a rotor in the mode ``rotors``."""
OWN_VEHICLE = "own"
"""Name of a vehicle of one's own in a policy, which has to be given again to use the policy."""
FASTEST_HZ = 10_000.0
"""Upper limit of rates [Hz]."""

_NAME = re.compile(r"[a-z][a-z0-9_]{0,63}", re.ASCII)
# Gymnasium imports a module that an id names before a colon, so no other ids than those of dronevio are accepted.
_ENVIRONMENT = re.compile(r"dronevio/[A-Za-z0-9]{1,64}-v[0-9]{1,4}", re.ASCII)


@dataclass(frozen=True)
class NamedShape:
    """Name and shape of an observation."""

    name: str
    """Name of the observation; see `dronevio.sim.envs.sensing.observations`."""
    shape: tuple[int, ...]
    """Shape of the observation of one drone."""

    def __post_init__(self) -> None:
        """Check name and shape.

        Raises:
            PolicyError: One of them is not possible.
        """
        if not _NAME.fullmatch(self.name):
            raise PolicyError(f"name of an observation: {self.name[:80]!r}", "a lower-case name of up to 64 characters")
        if not (1 <= len(self.shape) <= 4 and min(self.shape) >= 1 and self.size <= LARGEST_IMAGE):
            raise PolicyError(
                f"{self.name}: shape {self.shape}", f"1 to 4 positive sizes, with a product up to {LARGEST_IMAGE}"
            )

    @property
    def size(self) -> int:
        """Number of values."""
        return prod(self.shape)


@dataclass(frozen=True)
class Provenance:
    """Origin of a policy."""

    algorithm: str
    """Name of the learning algorithm."""
    samples: int
    """Number of steps of environments from which the policy was learned."""
    seed: int
    """Seed of the training."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Versions of the programs by name."""

    def __post_init__(self) -> None:
        """Check numbers and texts.

        Raises:
            PolicyError: A number is negative or has more than 64 bits, or a text is too long or not printable.
        """
        for name, value in (("samples", self.samples), ("seed", self.seed)):
            if not 0 <= value < 2**63:
                raise PolicyError(f"provenance.{name}: {value}", "an integer from 0 to 2⁶³ − 1")
        for text in (self.algorithm, *self.versions, *self.versions.values()):
            if len(text) > LONGEST_TEXT or not text.isprintable():
                raise PolicyError(f"provenance: {text[:80]!r}", f"up to {LONGEST_TEXT} printable characters")
        if len(self.versions) > LONGEST_LIST:
            raise PolicyError(f"provenance.versions: {len(self.versions)} entries", f"up to {LONGEST_LIST}")


@dataclass(frozen=True, eq=False)
class Policy:
    """A trained policy, which numpy alone evaluates.

    The observations, in the order of `inputs`, are concatenated, scaled, and mapped to an action by the network.
    """

    environment: str
    """Id of the environment in which the policy was trained, such as ``dronevio/Hover-v0``."""
    vehicle: str
    """Name of the vehicle, or `OWN_VEHICLE`."""
    inputs: tuple[NamedShape, ...]
    """Observations in the order of the inputs of the network."""
    scaling: Scaling
    """Scaling of the concatenated observations."""
    network: Network
    """Network from scaled observations to actions."""
    action_mode: str
    """Meaning of the actions: ``rotors``, ``rates``, ``attitude`` or ``velocity``."""
    action_limits: ActionLimits
    """Values that actions of ±1 command."""
    action_rate_hz: float
    """Rate of the actions [Hz]."""
    imu_rate_hz: float
    """Rate of IMU samples and of the inner control loops [Hz]."""
    provenance: Provenance
    """Origin of the policy."""

    def __post_init__(self) -> None:
        """Check that all parts fit together.

        Raises:
            PolicyError: A name is unknown, a rate is not possible, or the numbers of inputs and outputs do not fit.
        """
        if not _ENVIRONMENT.fullmatch(self.environment):
            raise PolicyError(f"environment: {self.environment[:160]!r}", "an id such as 'dronevio/Hover-v0'")
        if not _NAME.fullmatch(self.vehicle):
            raise PolicyError(f"vehicle: {self.vehicle[:80]!r}", "the name of a vehicle, such as 'research'")
        if self.action_mode not in ACTION_MODES:
            raise PolicyError(f"action.mode: {self.action_mode!r}", f"one of {', '.join(ACTION_MODES)}")
        if not 0.0 < self.action_rate_hz <= self.imu_rate_hz <= FASTEST_HZ:
            raise PolicyError(
                f"action.rate_hz: {self.action_rate_hz:g} with imu_rate_hz: {self.imu_rate_hz:g}",
                f"positive rates up to {FASTEST_HZ:g} Hz, that of the actions not above that of the IMU",
            )
        if len({one.name for one in self.inputs}) < len(self.inputs):
            raise PolicyError(f"observations: {', '.join(self.names)}", "each name once")
        size, encoder = sum(one.size for one in self.inputs), self.network.encoder
        if encoder is not None and (not self.inputs or self.inputs[0].shape != encoder.image):
            raise PolicyError(f"network.image: {encoder.image}", "the shape of the first observation")
        if self.scaling.mean.size != size:
            raise PolicyError(f"observation.mean: shape {self.scaling.mean.shape}", f"shape ({size},)")
        columns = self.network.layers[0].weight.shape[1]
        if self.network.inputs != size:
            wanted = columns + size - self.network.inputs
            raise PolicyError(f"layers.0.weight: {columns} columns", f"{wanted}, the size of the observations")
        most = MOST_ROTORS if self.action_mode == "rotors" else ACTIONS
        if not ACTIONS <= self.network.outputs <= most:
            last, sizes = len(self.network.layers) - 1, f"{ACTIONS}" if most == ACTIONS else f"{ACTIONS} to {most}"
            raise PolicyError(f"layers.{last}.weight: {self.network.outputs} rows", f"{sizes}, the size of an action")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the observations."""
        return tuple(one.name for one in self.inputs)

    def action(self, observation: Mapping[str, npt.ArrayLike] | npt.NDArray[np.floating]) -> Array32:
        """Return the actions (n, A) for observations of n drones.

        Args:
            observation: Arrays (n, …) by the names of the observations, or one array (n, N) with all of them in order.

        Raises:
            ConfigError: An observation is missing or has a wrong shape.
        """
        return self.network(self.scaling.apply(self._flat(observation)))

    def _flat(self, observation: Mapping[str, npt.ArrayLike] | npt.NDArray[np.floating]) -> Array32:
        """Return all observations of n drones in one array (n, N).

        Raises:
            ConfigError: An observation is missing or has a wrong shape.
        """
        if not isinstance(observation, Mapping):
            flat = np.asarray(observation, dtype=np.float32)
            if flat.ndim != 2 or flat.shape[1] != self.network.inputs:
                raise ConfigError(f"observations of shape {flat.shape}; expected (n, {self.network.inputs})")
            return flat
        parts = []
        for one in self.inputs:
            if one.name not in observation:
                raise ConfigError(f"observations {', '.join(observation)}; expected also {one.name!r}")
            value = np.asarray(observation[one.name], dtype=np.float32)
            if value.shape[1:] != one.shape:
                shape = ", ".join(map(str, one.shape))
                raise ConfigError(f"observation {one.name!r} of shape {value.shape}; expected (n, {shape})")
            parts.append(value.reshape(len(value), -1))
        return np.concatenate(parts, axis=1)
