"""``dronevio policy show``: what a policy observes and commands, and its origin."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json, print_values

if TYPE_CHECKING:
    from dronevio.models.policies.convolutions import Convolution


@dataclass(frozen=True)
class ShowCommand:
    """Print the description of a trained policy: environment, observations, actions, network and origin.

    Examples:
      dronevio policy show examples/rl/policies/hover.safetensors
      dronevio policy show examples/rl/policies/hover.safetensors --json
    """

    policy: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """File of the policy."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(ShowCommand, arguments, "policy show")

    from dronevio.models.policies.policy_file import description, load_policy

    policy = load_policy(command.policy)
    network = policy.network
    seeing = () if network.encoder is None else network.encoder.convolutions
    widths = [network.layers[0].weight.shape[1], *(len(layer.weight) for layer in network.layers)]
    parameters = sum(one.weight.size + one.bias.size for one in seeing)
    parameters += sum(layer.weight.size + layer.bias.size for layer in network.layers)
    if command.printing.json:
        document = json.loads(description(policy))
        document["network"] |= {"widths": widths, "parameters": parameters}
        print_json({"policy": str(command.policy), **document})
        return 0
    shapes = ", ".join(f"{one.name} ({' × '.join(map(str, one.shape))})" for one in policy.inputs)
    origin = policy.provenance
    rows = (
        ("environment", policy.environment, ""),
        ("vehicle", policy.vehicle, ""),
        ("observations", shapes, ""),
        ("action mode", policy.action_mode, ""),
        ("action rate", f"{policy.action_rate_hz:g}", "Hz"),
        ("rate of IMU and inner loops", f"{policy.imu_rate_hz:g}", "Hz"),
        *((("convolutions", " – ".join(map(_described, seeing)), ""),) if seeing else ()),
        ("widths of the layers", " – ".join(map(str, widths)), ""),
        ("parameters", str(parameters), ""),
        ("activation, squashing", f"{network.activation}, {network.squashing}", ""),
        ("algorithm", origin.algorithm, ""),
        ("samples", str(origin.samples), ""),
        ("seed", str(origin.seed), ""),
        *((f"version of {name}", version, "") for name, version in origin.versions.items()),
    )
    print_values(f"Policy {command.policy}", rows)
    return 0


def _described(convolution: "Convolution") -> str:
    """Return a convolution as text, such as ``16 × 8 × 8 (stride 4)``."""
    outputs, _, height, width = convolution.weight.shape
    return f"{outputs} × {height} × {width} (stride {convolution.stride})"
