"""Policies from networks of PyTorch and models of Stable-Baselines3, which stand-ins of their interfaces represent."""

from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

import dronevio.envs  # noqa: F401 registers
from dronevio.models.errors import ConfigError
from dronevio.models.policies import Provenance, Scaling
from dronevio.sim.envs import ActionLimits, DroneVectorEnv, policy_from_sb3, policy_from_torch, provenance_of


class Tensor:
    """A tensor of PyTorch, as far as the conversion uses it."""

    def __init__(self, values: Any) -> None:
        self._values = values

    def detach(self) -> "Tensor":
        return self

    def cpu(self) -> "Tensor":
        return self

    def numpy(self) -> Any:
        return self._values


class Module:
    """A module of PyTorch with parts."""

    def __init__(self, *parts: Any) -> None:
        self._parts = parts

    def children(self) -> Any:
        return iter(self._parts)


class Linear(Module):
    """A linear layer, whose weights are those of a generator."""

    def __init__(self, inputs: int, outputs: int, seed: int = 0, bias: bool = True) -> None:
        super().__init__()
        rng = np.random.default_rng([inputs, outputs, seed])
        self.weight = Tensor(rng.normal(0.0, 0.3, (outputs, inputs)))
        self.bias = Tensor(rng.normal(size=outputs)) if bias else None


class Conv2d(Module):
    """A convolution, whose weights are those of a generator."""

    padding, dilation, groups = (0, 0), (1, 1), 1

    def __init__(self, inputs: int, outputs: int, size: int, step: int = 1, **changes: Any) -> None:
        super().__init__()
        rng = np.random.default_rng([inputs, outputs, size])
        self.weight = Tensor(rng.normal(0.0, 0.3, (outputs, inputs, size, size)))
        self.bias = Tensor(rng.normal(size=outputs))
        self.stride = step, step
        self.__dict__ |= changes


class Flatten(Module):
    """Images as vectors."""


class Tanh(Module):
    """An activation."""


class ELU(Module):
    """An activation with a parameter."""

    def __init__(self, alpha: float = 1.0) -> None:
        super().__init__()
        self.alpha = alpha


class Dropout(Module):
    """A module that a policy cannot represent."""


@pytest.fixture(scope="module")
def envs() -> DroneVectorEnv:
    made = gymnasium.make_vec(
        "dronevio/Hover-v0",
        num_envs=3,
        flat=True,
        observations=("velocity", "imu"),
        action="rates",
        action_rate_hz=100.0,
        action_limits=ActionLimits(rate_rad_s=3.0),
        vehicle="nano",
    )
    assert isinstance(made, DroneVectorEnv)
    return made


ORIGIN = Provenance("PPO", 1000, 4)


def test_a_policy_describes_its_environment(envs: DroneVectorEnv) -> None:
    scaling = Scaling.of_statistics(np.ones(15), np.full(15, 4.0), 0.0, 5.0)
    first, last = Linear(15, 8), Linear(8, 4, bias=False)
    policy = policy_from_torch(Module(Module(first, Tanh()), last), envs, ORIGIN, scaling=scaling)
    assert (policy.environment, policy.vehicle, policy.action_mode) == ("dronevio/Hover-v0", "nano", "rates")
    assert (policy.action_rate_hz, policy.imu_rate_hz, policy.action_limits.rate_rad_s) == (100.0, 200.0, 3.0)
    assert [(one.name, one.shape) for one in policy.inputs] == [("velocity", (3,)), ("imu", (2, 6))]
    observation, _ = envs.reset(seed=0)
    assert first.bias is not None
    hidden = np.tanh(np.clip((observation - 1.0) / 2.0, -5.0, 5.0) @ first.weight.numpy().T + first.bias.numpy())
    expected = np.clip(hidden @ last.weight.numpy().T, -1.0, 1.0)
    np.testing.assert_allclose(policy.action(observation), expected, atol=1e-5)


def model_of(policy: Any, normalize: Any = None) -> Any:
    """A model of Stable-Baselines3."""
    return SimpleNamespace(policy=policy, num_timesteps=640, seed=None, get_vec_normalize_env=lambda: normalize)


def test_models_have_an_actor_and_a_squashing(envs: DroneVectorEnv) -> None:
    body, head = Module(Linear(15, 8), Tanh()), Linear(8, 4)
    on_policy = SimpleNamespace(
        mlp_extractor=SimpleNamespace(policy_net=body), action_net=head, squash_output=False, value_net=None
    )
    statistics = SimpleNamespace(mean=np.zeros(15), var=np.full(15, 9.0))
    normalize = SimpleNamespace(norm_obs=True, obs_rms=statistics, epsilon=0.0, clip_obs=10.0)
    ppo = policy_from_sb3(model_of(on_policy, normalize), envs)
    assert (ppo.network.squashing, ppo.scaling.limit, ppo.provenance.samples) == ("clip", 10.0, 640)
    np.testing.assert_array_equal(ppo.scaling.scale, np.full(15, 3.0, np.float32))
    sac = policy_from_sb3(model_of(SimpleNamespace(actor=SimpleNamespace(latent_pi=body, mu=head))), envs)
    td3 = policy_from_sb3(model_of(SimpleNamespace(actor=SimpleNamespace(mu=Module(body, head, Tanh())))), envs)
    values = np.random.default_rng(1).normal(size=(5, 15))
    assert sac.network.squashing == "tanh"
    np.testing.assert_array_equal(sac.action(values), td3.action(values))
    with pytest.raises(ConfigError, match="expected MlpPolicy"):
        policy_from_sb3(model_of(SimpleNamespace()), envs)


def test_a_policy_sees_the_first_observation() -> None:
    eyes = DroneVectorEnv(2, "navigate", observations=("depth", "velocity"), image_size=(12, 10), world="low-texture")
    first, second, linear = Conv2d(1, 3, 4, 2), Conv2d(3, 5, 2), Linear(5 * 3 * 4 + 3, 4)
    made: dict[str, Any] = {"environment": "dronevio/Navigate-v0"}
    convolutions = Module(first, Tanh(), second, Tanh(), Flatten())
    policy = policy_from_torch([linear], eyes, ORIGIN, convolutions=convolutions, **made)
    assert policy.network.encoder is not None and policy.network.encoder.image == (10, 12, 1)
    assert [one.stride for one in policy.network.encoder.convolutions] == [2, 1]
    # worked out at one pixel of the second convolution
    depth = np.random.default_rng(0).uniform(0.0, 2.0, (10, 12))
    seen = [
        np.tanh(np.einsum("mckl,kl->m", first.weight.numpy(), depth[i : i + 4, j : j + 4]) + first.bias.numpy())
        for i in (0, 2)
        for j in (0, 2)
    ]
    corner = np.moveaxis(np.array(seen).reshape(2, 2, 3), 2, 0)
    expected = np.tanh(np.einsum("mckl,ckl->m", second.weight.numpy(), corner) + second.bias.numpy())
    features = policy.network.encoder(depth.astype(np.float32).reshape(1, -1), np.tanh).reshape(5, 3, 4)
    np.testing.assert_allclose(features[:, 0, 0], expected, atol=1e-6)
    alone = policy_from_torch([Linear(60 + 3, 4)], eyes, ORIGIN, convolutions=Module(first, ELU()), **made)
    assert alone.network.activation == "elu"  # a single linear layer has none
    with pytest.raises(ConfigError, match="expected alpha = 1"):
        policy_from_torch([Linear(60 + 3, 4)], eyes, ORIGIN, convolutions=Module(first, ELU(0.5)), **made)
    for wrong in (
        Module(first, second),
        Module(first, ELU()),
        Module(Conv2d(1, 3, 4, padding=(1, 1)), Tanh()),
        Module(Conv2d(1, 3, 4, stride=(1, 2)), Tanh()),
        Module(),
    ):
        with pytest.raises(ConfigError, match=r"convolution"):
            policy_from_torch([linear, Tanh(), Linear(4, 4)], eyes, ORIGIN, convolutions=wrong, **made)


@pytest.mark.parametrize(
    "network",
    [
        Module(Linear(15, 8), Linear(8, 4)),
        Module(Linear(15, 8), Dropout(), Linear(8, 4)),
        Module(Linear(15, 8), Tanh(), Linear(8, 8), ELU(), Linear(8, 4)),
        Module(Linear(15, 8), ELU(0.5), Linear(8, 4)),
        [],
    ],
)
def test_other_networks_are_errors(envs: DroneVectorEnv, network: Any) -> None:
    with pytest.raises(ConfigError, match=r"expected (Linear layers|alpha = 1)"):
        policy_from_torch(network, envs, ORIGIN)


def test_the_sizes_of_inputs_and_outputs_are_checked(envs: DroneVectorEnv) -> None:
    with pytest.raises(ConfigError, match="14 columns; expected 15"):
        policy_from_torch([Linear(14, 4)], envs, ORIGIN)
    with pytest.raises(ConfigError, match="3 rows; expected 4"):
        policy_from_torch([Linear(15, 3)], envs, ORIGIN)
    with pytest.raises(ConfigError, match="argument 'environment'"):
        policy_from_torch([Linear(25, 4)], DroneVectorEnv(1, "hover"), ORIGIN)


def test_the_origin_has_versions() -> None:
    origin = provenance_of("PPO", 10, 2)
    assert (origin.algorithm, origin.samples, origin.seed) == ("PPO", 10, 2)
    assert origin.versions["numpy"] == np.__version__ and "dronevio" in origin.versions
