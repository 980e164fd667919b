"""Trained policies as files of arrays and text, which numpy alone evaluates."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.models.policies.convolutions import Convolution, Encoder
    from dronevio.models.policies.network import Layer, Network, Scaling
    from dronevio.models.policies.onnx_file import write_onnx
    from dronevio.models.policies.policy import NamedShape, Policy, Provenance
    from dronevio.models.policies.policy_file import load_policy, save_policy

__all__ = [
    "Convolution",
    "Encoder",
    "Layer",
    "NamedShape",
    "Network",
    "Policy",
    "Provenance",
    "Scaling",
    "load_policy",
    "save_policy",
    "write_onnx",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.models.policies.convolutions": ("Convolution", "Encoder"),
        "dronevio.models.policies.network": ("Layer", "Network", "Scaling"),
        "dronevio.models.policies.onnx_file": ("write_onnx",),
        "dronevio.models.policies.policy": ("NamedShape", "Policy", "Provenance"),
        "dronevio.models.policies.policy_file": ("load_policy", "save_policy"),
    },
)
