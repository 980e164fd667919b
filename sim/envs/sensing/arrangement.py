"""Arrangement of named observations: a dict or one vector, for a policy, and apart for a critic."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from dronevio.sim.envs.sensing.camera_observation import Images
from dronevio.sim.envs.sensing.observations import Observation, ObservedState

POLICY, CRITIC = "policy", "critic"
"""Names of the two entries of an observation with privileged observations."""


class Arrangement:
    """Space of the observations of an environment, and the composition of observations of many environments."""

    def __init__(
        self,
        named: Mapping[str, Observation],
        images: Mapping[str, spaces.Box],
        policy: tuple[str, ...],
        privileged: tuple[str, ...],
        flat: bool,
    ) -> None:
        """Define names and form.

        Args:
            named: Observations other than images by name.
            images: Spaces of the images of one environment by name.
            policy: Names of the observations of the policy.
            privileged: Names of the observations of the critic; without any, there is no entry for a critic.
            flat: Whether the observations are concatenated to one vector, in the order of the names.
        """
        self._named, self._policy, self._privileged, self._flat = named, policy, privileged, flat
        boxes = {**{name: one.space for name, one in named.items()}, **images}
        self.shapes: dict[str, tuple[int, ...]] = {name: boxes[name].shape for name in policy}
        """Shapes of the observations of the policy by name, in order."""
        self.space: spaces.Space[Any] = self._space(boxes, policy)
        """Space of the observations of one environment."""
        if privileged:
            self.space = spaces.Dict({POLICY: self.space, CRITIC: self._space(boxes, privileged)})

    def observe(self, seen: ObservedState, true: ObservedState, images: Images) -> Any:
        """Return the observations of n environments.

        Args:
            seen: What the policy perceives.
            true: What the critic knows.
            images: Arrays (n, H, W, C) by name.
        """
        policy = self._composed(seen, images, self._policy)
        return {POLICY: policy, CRITIC: self._composed(true, images, self._privileged)} if self._privileged else policy

    def _space(self, boxes: Mapping[str, spaces.Box], names: tuple[str, ...]) -> spaces.Space[Any]:
        """Return the space of some observations."""
        if not self._flat:
            return spaces.Dict({name: boxes[name] for name in names})
        low = np.concatenate([boxes[name].low.ravel() for name in names])
        high = np.concatenate([boxes[name].high.ravel() for name in names])
        return spaces.Box(low, high, low.shape, np.float32)

    def _composed(self, situation: ObservedState, images: Images, names: tuple[str, ...]) -> Any:
        """Return the values of some observations."""
        values = {
            name: self._named[name].observe(situation) if name in self._named else images[name].copy() for name in names
        }
        if not self._flat:
            return values
        return np.concatenate([value.reshape(len(value), -1) for value in values.values()], axis=1)


def rows_of(observations: Any, rows: npt.NDArray[np.intp] | int) -> Any:
    """Return the observations of some environments, or of one."""
    if isinstance(observations, dict):
        return {name: rows_of(value, rows) for name, value in observations.items()}
    value = observations[rows]
    return value.copy() if isinstance(rows, int) else value
