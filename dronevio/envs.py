"""Registration of the environments with Gymnasium.

After ``import dronevio.envs``, ``gymnasium.make("dronevio/Hover-v0")`` makes an environment. The call
``gymnasium.make("dronevio.envs:dronevio/Hover-v0")`` does both. The simulator is imported when an environment is made.
"""

import gymnasium

_SECONDS = 10
_STEPS_PER_S = 50

gymnasium.register(
    id="dronevio/Hover-v0",
    entry_point="dronevio.sim.envs.hover:Hover",
    max_episode_steps=_SECONDS * _STEPS_PER_S,
)
