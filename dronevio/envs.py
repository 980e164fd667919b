"""Registration of the environments with Gymnasium.

After ``import dronevio.envs``, ``gymnasium.make("dronevio/Hover-v0")`` makes an environment, and `gymnasium.make_vec` a
vector of environments. The call ``gymnasium.make("dronevio.envs:dronevio/Hover-v0")`` does both. The simulator is
imported when an environment is made.
"""

import gymnasium

_ACTIONS_PER_S = 50
_EPISODES_S = {"Hover": 10, "Waypoints": 15, "Track": 15, "Race": 90, "Navigate": 30}

for _name, _seconds in _EPISODES_S.items():
    gymnasium.register(
        id=f"dronevio/{_name}-v0",
        entry_point="dronevio.sim.envs.single:DroneEnv",
        vector_entry_point="dronevio.sim.envs.vector:DroneVectorEnv",
        kwargs={"task": _name.lower()},
        max_episode_steps=_seconds * _ACTIONS_PER_S,
    )
