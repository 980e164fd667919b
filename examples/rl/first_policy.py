"""Train a policy that hovers, by Stable-Baselines3 with its default settings, and keep it."""

import gymnasium
from stable_baselines3 import PPO

import dronevio as dv
from dronevio.envs import policy_from_sb3
from dronevio.sim.envs.stable_baselines import StableBaselinesVecEnv

envs = gymnasium.make_vec("dronevio.envs:dronevio/Hover-v0", num_envs=16, autoreset_mode="SAME_STEP", flat=True)
model = PPO("MlpPolicy", StableBaselinesVecEnv(envs), device="cpu", seed=0)
model.learn(500_000)
dv.save_policy("hover.safetensors", policy_from_sb3(model, envs))
print(dv.evaluate_policy(dv.load_policy("hover.safetensors"), episodes=200).figures()["success_rate"])
