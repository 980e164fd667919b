"""Policies from trained networks of PyTorch, and from models of Stable-Baselines3.

Neither is a dependency of dronevio, and this module imports neither: it reads the layers of given objects.

```python
model = PPO("MlpPolicy", StableBaselinesVecEnv(envs), …).learn(500_000)
dv.save_policy("hover.safetensors", policy_from_sb3(model, envs))
```
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from dronevio.models.errors import ConfigError
from dronevio.models.policies.arrays32 import Array32
from dronevio.models.policies.convolutions import Convolution, Encoder
from dronevio.models.policies.network import ACTIVATIONS, Layer, Network, Scaling
from dronevio.models.policies.policy import OWN_VEHICLE, NamedShape, Policy, Provenance
from dronevio.models.quadrotor import VEHICLES, Quadrotor

_PROGRAMS = ("dronevio", "numpy", "torch", "stable_baselines3")
_EXPECTED = f"Linear layers with one of the activations {', '.join(ACTIVATIONS)} between them"


def policy_from_torch(
    network: Any,
    envs: Any,
    provenance: Provenance,
    *,
    convolutions: Any = None,
    scaling: Scaling | None = None,
    squashing: str = "clip",
    environment: str = "",
) -> Policy:
    """Return the policy of a network of PyTorch.

    Args:
        network: A ``torch.nn.Sequential``, which may be nested, or a sequence of modules: linear layers with ``Tanh``,
            ``ReLU`` or ``ELU`` between them, from the flat observation to the action. A ``Tanh`` after the last layer
            is the squashing.
        convolutions: For a policy that sees, a ``torch.nn.Sequential`` of ``Conv2d`` without padding, each followed by
            the activation of the network, and of a ``Flatten`` at the end. It receives the first observation, an image;
            its results and the other observations are the inputs of the network.
        envs: Environment or vector of environments of dronevio in which the policy was trained.
        provenance: Origin of the policy; `provenance_of` makes it.
        scaling: Scaling of the observations before the network, see `Scaling.of_statistics`; none by default.
        squashing: Function after the last layer, ``clip`` or ``tanh``.
        environment: Id of the environment; by default that with which ``envs`` was made.

    Raises:
        ConfigError: The network or the environment cannot be represented by a policy.
    """
    settings, spec = envs.unwrapped.settings, envs.unwrapped.spec
    shapes = envs.unwrapped.observation_shapes
    if not environment and spec is None:
        raise ConfigError("environments that were made without an id; expected the argument 'environment'")
    inputs = tuple(NamedShape(name, shapes[name]) for name in settings.policy_names)
    layers = _network(list(_leaves(network)), squashing)
    if convolutions is not None:
        layers = _seeing(layers, list(_leaves(convolutions)), inputs[0].shape)
    return Policy(
        environment=environment or spec.id,
        vehicle=_vehicle_name(settings.vehicle),
        inputs=inputs,
        scaling=scaling or Scaling.identity(sum(one.size for one in inputs)),
        network=layers,
        action_mode=settings.action,
        action_limits=settings.action_limits,
        action_rate_hz=settings.action_rate_hz,
        imu_rate_hz=settings.imu_rate_hz,
        provenance=provenance,
    )


def policy_from_sb3(model: Any, envs: Any, *, environment: str = "") -> Policy:
    """Return the deterministic policy of a model of Stable-Baselines3, with the scaling of its ``VecNormalize``.

    Args:
        model: Model of PPO, A2C, SAC or TD3 with ``MlpPolicy``, trained on flat observations.
        envs: Vector of environments of dronevio in which the model was trained.
        environment: Id of the environment; by default that with which ``envs`` was made.

    Raises:
        ConfigError: The model or the environment cannot be represented by a policy.
    """
    if not envs.unwrapped.settings.flat:
        raise ConfigError("a model of environments with flat=False; expected flat observations")
    parts, squashing = _parts_of_sb3(model.policy)
    normalize = model.get_vec_normalize_env()
    scaling = None
    if normalize is not None and normalize.norm_obs:
        statistics = normalize.obs_rms
        scaling = Scaling.of_statistics(statistics.mean, statistics.var, normalize.epsilon, float(normalize.clip_obs))
    provenance = provenance_of(type(model).__name__, model.num_timesteps, model.seed or 0)
    return policy_from_torch(parts, envs, provenance, scaling=scaling, squashing=squashing, environment=environment)


def provenance_of(algorithm: str, samples: int, seed: int) -> Provenance:
    """Return the origin of a policy, with the versions of the installed programs.

    Args:
        algorithm: Name of the learning algorithm.
        samples: Number of steps of environments from which the policy was learned.
        seed: Seed of the training.
    """
    found = {}
    for name in _PROGRAMS:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return Provenance(algorithm, samples, seed, found)


def _parts_of_sb3(policy: Any) -> tuple[list[Any], str]:
    """Return the modules from the observation to the action, and the squashing.

    Raises:
        ConfigError: The policy has another structure.
    """
    if hasattr(policy, "mlp_extractor") and hasattr(policy, "action_net"):
        return [policy.mlp_extractor.policy_net, policy.action_net], "tanh" if policy.squash_output else "clip"
    actor: Any = getattr(policy, "actor", object())
    if hasattr(actor, "latent_pi"):
        return [actor.latent_pi, actor.mu], "tanh"
    if hasattr(actor, "mu"):
        return [actor.mu], "clip"
    raise ConfigError(f"a policy of type {type(policy).__name__}; expected MlpPolicy of PPO, A2C, SAC or TD3")


def _leaves(network: Any) -> Iterator[Any]:
    """Yield the modules without parts of a network or a sequence of networks, in order."""
    parts: Sequence[Any] = network if isinstance(network, Sequence) else list(network.children())
    if not parts and not isinstance(network, Sequence):
        yield network
    for part in parts:
        yield from _leaves(part)


def _network(modules: list[Any], squashing: str) -> Network:
    """Return the network of modules without parts.

    Raises:
        ConfigError: They are not linear layers with one activation between them.
    """
    kinds = [type(module).__name__.lower() for module in modules]
    if kinds and kinds[-1] == "tanh":
        modules, kinds, squashing = modules[:-1], kinds[:-1], "tanh"
    between = set(kinds[1::2]) or {"tanh"}
    if len(kinds) % 2 == 0 or set(kinds[::2]) != {"linear"} or len(between) > 1 or not between <= set(ACTIVATIONS):
        raise ConfigError(f"a network of {', '.join(kinds) or 'no modules'}; expected {_EXPECTED}")
    _require_plain(modules[1::2])
    layers = [Layer(_array(module.weight), _bias(module)) for module in modules[::2]]
    return Network(tuple(layers), between.pop(), squashing)


def _seeing(network: Network, modules: list[Any], image: tuple[int, ...]) -> Network:
    """Return a network with the convolutions of modules without parts, of an image with a shape.

    Raises:
        ConfigError: They are not plain convolutions with the activation after each.
    """
    kinds = [type(module).__name__.lower() for module in modules]
    if kinds and kinds[-1] == "flatten":
        modules, kinds = modules[:-1], kinds[:-1]
    # a single linear layer has no activation of its own
    between = {network.activation} if len(network.layers) > 1 else set(kinds[1::2])
    is_plain = set(kinds[::2]) == {"conv2d"} and set(kinds[1::2]) == between and len(between) == 1
    if len(kinds) % 2 or not is_plain or not between <= set(ACTIVATIONS) or len(image) != 3:
        expected = "an image, and Conv2d with the activation of the linear layers after each"
        raise ConfigError(f"convolutions {', '.join(kinds)} of shape {image}; expected {expected}")
    _require_plain(modules[1::2])
    for module in modules[::2]:
        plain = all(size == 0 for size in module.padding) and module.dilation == (1, 1) and module.groups == 1
        if not plain or module.stride[0] != module.stride[1]:
            raise ConfigError(
                f"a convolution {module}; expected one without padding, dilation and groups, of one stride"
            )
    seeing = [Convolution(_array(module.weight), _bias(module), int(module.stride[0])) for module in modules[::2]]
    encoder = Encoder((image[0], image[1], image[2]), tuple(seeing))
    return replace(network, activation=between.pop(), encoder=encoder)


def _require_plain(activations: list[Any]) -> None:
    """Raise ConfigError if an activation has a parameter that a policy cannot represent."""
    if any(getattr(module, "alpha", 1.0) != 1.0 for module in activations):
        raise ConfigError("an activation ELU with another alpha than 1; expected alpha = 1")


def _bias(module: Any) -> Array32:
    """Return the bias of a layer, zero if it has none."""
    return np.zeros(len(_array(module.weight)), np.float32) if module.bias is None else _array(module.bias)


def _array(tensor: Any) -> Array32:
    """Return a tensor as an array of its own."""
    return np.array(tensor.detach().cpu().numpy(), dtype=np.float32)


def _vehicle_name(vehicle: Quadrotor) -> str:
    """Return the name of a vehicle; `OWN_VEHICLE` if it has none."""
    return next((name for name, known in VEHICLES.items() if known == vehicle), OWN_VEHICLE)
