"""``dronevio policy export-onnx``: write a policy as an ONNX model."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from dronevio.cli.options import Output, OutputOptions
from dronevio.cli.terminal import parse, print_json


@dataclass(frozen=True)
class ExportCommand:
    """Write a trained policy as an ONNX model, for runtimes on other computers.

    The input is an array (n, N) of unscaled observations, concatenated in the order that `dronevio policy show` prints.
    The output is an array (n, 4) of actions. The extra onnx is needed.

    Examples:
      dronevio policy export-onnx examples/rl/policies/hover.safetensors
      dronevio policy export-onnx examples/rl/policies/hover.safetensors --out models/hover.onnx
    """

    policy: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """File of the policy."""
    out: Path | None = None
    """File to write; by default that of the policy with the ending .onnx."""
    output: Output = field(default_factory=OutputOptions)
    """How the result is written and printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(ExportCommand, arguments, "policy export-onnx")

    from dronevio.cli.output_files import atomic_file, require_free
    from dronevio.models.policies.onnx_file import write_onnx
    from dronevio.models.policies.policy_file import load_policy

    target = command.out or command.policy.with_suffix(".onnx")
    require_free(target, command.output.overwrite)
    policy = load_policy(command.policy)
    with atomic_file(target) as partial:
        write_onnx(partial, policy)
    if command.output.json:
        print_json({"policy": str(command.policy), "onnx": str(target)})
        return 0
    print(f"wrote {target}")
    return 0
