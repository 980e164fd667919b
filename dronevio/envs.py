"""Registers the environments with Gymnasium.

``import dronevio.envs`` and then ``gymnasium.make("dronevio/Hover-v0")``, or both in one:
``gymnasium.make("dronevio.envs:dronevio/Hover-v0")``. The simulator is imported when an environment is made.
"""

import gymnasium

_SECONDS = 10
_STEPS_PER_S = 50

gymnasium.register(
    id="dronevio/Hover-v0",
    entry_point="dronevio.sim.envs.hover:Hover",
    max_episode_steps=_SECONDS * _STEPS_PER_S,
)
