"""Export of policies to ONNX, for runtimes on other machines. It needs the package onnx."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.extras import install_command
from dronevio.models.policies.network import Network
from dronevio.models.policies.policy import Policy
from dronevio.models.policies.policy_file import METADATA_KEY, description

INPUT, OUTPUT = "observation", "action"
"""Names of input and output of the exported graph."""

_OPSET = 17
_OPERATORS = {"tanh": "Tanh", "relu": "Relu", "elu": "Elu"}


def write_onnx(path: str | Path, policy: Policy) -> None:
    """Write a policy as an ONNX model, from unscaled observations (n, N) to actions (n, 4).

    The observations are concatenated in the order of `Policy.inputs`. The metadata of the model has the description of
    the policy as JSON, with the key ``dronevio_policy``.

    Args:
        path: The file.
        policy: The policy.

    Raises:
        ConfigError: The package onnx is not installed.
    """
    try:
        import onnx
    except ImportError:
        raise ConfigError(
            f"ONNX export without the package onnx; expected it, by `{install_command('onnx')}`"
        ) from None
    model = onnx.helper.make_model(
        _graph(policy),
        opset_imports=[onnx.helper.make_opsetid("", _OPSET)],
        producer_name="dronevio",
        ir_version=8,  # of opset 17, which runtimes since 2022 read
    )
    onnx.helper.set_model_props(model, {METADATA_KEY: description(policy)})
    onnx.checker.check_model(model, full_check=True)
    Path(path).write_bytes(model.SerializeToString())


def _graph(policy: Policy) -> Any:
    """Return the ONNX graph of a policy."""
    from onnx import TensorProto, helper, numpy_helper

    network: Network = policy.network
    constants: dict[str, npt.NDArray[Any]] = {"mean": policy.scaling.mean, "scale": policy.scaling.scale}
    nodes = [
        helper.make_node("Sub", [INPUT, "mean"], ["centred"]),
        helper.make_node("Div", ["centred", "scale"], ["scaled"]),
    ]
    current = "scaled"
    if policy.scaling.limit is not None:
        constants["lowest"], constants["highest"] = (
            np.array(sign * policy.scaling.limit, np.float32) for sign in (-1.0, 1.0)
        )
        nodes.append(helper.make_node("Clip", [current, "lowest", "highest"], ["limited"]))
        current = "limited"
    if network.encoder is not None:
        current = _encoded(network, current, nodes, constants)
    for index, layer in enumerate(network.layers):
        weight, bias, result = f"weight_{index}", f"bias_{index}", f"linear_{index}"
        constants[weight], constants[bias] = layer.weight, layer.bias
        nodes.append(helper.make_node("Gemm", [current, weight, bias], [result], transB=1))
        current = result
        if index < len(network.layers) - 1:
            current = f"activated_{index}"
            nodes.append(helper.make_node(_OPERATORS[network.activation], [result], [current]))
    if network.squashing == "tanh":
        nodes.append(helper.make_node("Tanh", [current], [OUTPUT]))
    else:
        constants["minus_one"], constants["one"] = np.array(-1.0, np.float32), np.array(1.0, np.float32)
        nodes.append(helper.make_node("Clip", [current, "minus_one", "one"], [OUTPUT]))
    return helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, ["n", network.inputs])],
        [helper.make_tensor_value_info(OUTPUT, TensorProto.FLOAT, ["n", network.outputs])],
        [numpy_helper.from_array(np.ascontiguousarray(array), name) for name, array in constants.items()],
    )


def _encoded(network: Network, scaled: str, nodes: list[Any], constants: dict[str, npt.NDArray[Any]]) -> str:
    """Add the convolutions of the image, and return the name of the inputs of the linear layers."""
    from onnx import helper

    assert network.encoder is not None
    sizes = [network.encoder.inputs, network.inputs - network.encoder.inputs]
    constants["sizes"] = np.array(sizes, np.int64)
    constants["image_shape"] = np.array([-1, *network.encoder.image], np.int64)
    nodes += [
        helper.make_node("Split", [scaled, "sizes"], ["flat_image", "others"], axis=1),
        helper.make_node("Reshape", ["flat_image", "image_shape"], ["image_by_rows"]),
        helper.make_node("Transpose", ["image_by_rows"], ["image"], perm=[0, 3, 1, 2]),
    ]
    current = "image"
    for index, one in enumerate(network.encoder.convolutions):
        weight, bias, result = f"kernel_{index}", f"offset_{index}", f"convolved_{index}"
        constants[weight], constants[bias] = one.weight, one.bias
        nodes.append(helper.make_node("Conv", [current, weight, bias], [result], strides=[one.stride] * 2))
        current = f"seen_{index}"
        nodes.append(helper.make_node(_OPERATORS[network.activation], [result], [current]))
    nodes.append(helper.make_node("Flatten", [current], ["features"], axis=1))
    nodes.append(helper.make_node("Concat", ["features", "others"], ["encoded"], axis=1))
    return "encoded"
