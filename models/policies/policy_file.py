"""Policies as files: one file of the format safetensors, with the description as JSON in its metadata.

The file contains no code. Its arrays are of type float32:

| name | shape | content |
|---|---|---|
| ``observation.mean``, ``observation.scale`` | (N,) | scaling of the concatenated observations |
| ``convolutions.K.weight`` | (M, C, H, W) | weights of convolution K = 0, 1, …, of a policy that sees |
| ``convolutions.K.bias`` | (M,) | biases of convolution K |
| ``layers.K.weight`` | (M, N) | weights of layer K = 0, 1, … |
| ``layers.K.bias`` | (M,) | biases of layer K |

The metadata has the key ``dronevio_policy``, whose value is the text of a JSON object with these fields:

| field | content |
|---|---|
| ``version`` | version of the format: 1, or 2 with convolutions |
| ``environment``, ``vehicle`` | id of the environment, and name of the vehicle |
| ``observations`` | list of objects with ``name`` and ``shape``, in the order of the inputs |
| ``observation_limit`` | largest magnitude of a scaled observation, or null |
| ``action`` | object with ``mode``, ``rate_hz`` and ``limits``, the fields of `ActionLimits` |
| ``imu_rate_hz`` | rate of the IMU and of the inner control loops [Hz] |
| ``network`` | object with ``activation`` and ``squashing``; with convolutions also ``image``, height, width and \
channels of the first observation, and ``strides``, a list of integers |
| ``provenance`` | object with ``algorithm``, ``samples``, ``seed`` and ``versions``, an object of texts |
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from dronevio.models.actions import ActionLimits
from dronevio.models.errors import InputError
from dronevio.models.policies.arrays32 import Array32, PolicyError
from dronevio.models.policies.convolutions import MOST_CONVOLUTIONS, Convolution, Encoder
from dronevio.models.policies.document import Fields, shortened
from dronevio.models.policies.network import MOST_LAYERS, Layer, Network, Scaling
from dronevio.models.policies.policy import NamedShape, Policy, Provenance

VERSION = 2
"""Newest version of the format."""
METADATA_KEY = "dronevio_policy"
"""Key of the description in the metadata."""
LARGEST_FILE_BYTES = 64 * 2**20
"""Upper limit of the size of a file."""
LARGEST_HEADER_BYTES = 2**20
"""Upper limit of the size of the header of a file."""

_FORMAT = "a policy, as dronevio writes it in the format safetensors"
_MEAN, _SCALE = "observation.mean", "observation.scale"
_LAYERS, _SEEING = "layers", "convolutions"


def save_policy(path: str | Path, policy: Policy) -> None:
    """Write a policy into a file, by convention ``*.safetensors``.

    Args:
        path: The file.
        policy: The policy.
    """
    arrays = {_MEAN: policy.scaling.mean, _SCALE: policy.scaling.scale}
    encoder = policy.network.encoder
    groups: dict[str, Sequence[Layer | Convolution]] = {_LAYERS: policy.network.layers}
    groups[_SEEING] = () if encoder is None else encoder.convolutions
    for group, parts in groups.items():
        for index, part in enumerate(parts):
            arrays[_weight(group, index)], arrays[_bias(group, index)] = part.weight, part.bias
    contiguous = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    Path(path).write_bytes(save(contiguous, {METADATA_KEY: description(policy)}))


def load_policy(path: str | Path) -> Policy:
    """Read a policy from a file, whose contents are checked.

    Args:
        path: The file.

    Raises:
        InputError: The file is missing, damaged or no policy; the message names the field.
    """
    path = Path(path)
    _check_sizes(path)
    try:
        with safe_open(path, framework="numpy") as file:
            document = (file.metadata() or {}).get(METADATA_KEY)
            if document is None:
                raise InputError(path, f"no {METADATA_KEY} in the metadata", _FORMAT)
            arrays = {name: _array(path, file, name) for name in _names(path, list(file.keys()))}
    except SafetensorError as error:
        raise InputError(path, shortened(error), _FORMAT) from None
    try:
        return _policy(Fields.parse(path, document), arrays)
    except PolicyError as error:
        raise InputError(path, error.found, error.expected) from None


def description(policy: Policy) -> str:
    """Return the description of a policy without its arrays, as JSON."""
    provenance, encoder = policy.provenance, policy.network.encoder
    seeing = {}
    if encoder is not None:
        seeing = {"image": list(encoder.image), "strides": [one.stride for one in encoder.convolutions]}
    document = {
        "version": 1 if encoder is None else VERSION,
        "environment": policy.environment,
        "vehicle": policy.vehicle,
        "observations": [{"name": one.name, "shape": list(one.shape)} for one in policy.inputs],
        "observation_limit": policy.scaling.limit,
        "action": {
            "mode": policy.action_mode,
            "rate_hz": policy.action_rate_hz,
            "limits": asdict(policy.action_limits),
        },
        "imu_rate_hz": policy.imu_rate_hz,
        "network": {"activation": policy.network.activation, "squashing": policy.network.squashing, **seeing},
        "provenance": {
            "algorithm": provenance.algorithm,
            "samples": provenance.samples,
            "seed": provenance.seed,
            "versions": dict(provenance.versions),
        },
    }
    return json.dumps(document, allow_nan=False)


def _policy(document: Fields, arrays: dict[str, Array32]) -> Policy:
    """Return the policy of a description and arrays.

    Raises:
        InputError: A field is missing or has a wrong type.
        PolicyError: The parts do not fit together.
    """
    version = document.integer("version")
    if not 1 <= version <= VERSION:
        raise document.error("version", f"up to {VERSION}; a newer version of dronevio may read this file")
    action, network = document.child("action"), document.child("network")
    origin = document.child("provenance")
    document.only(
        *("version", "environment", "vehicle", "observations", "observation_limit"),
        *("action", "imu_rate_hz", "network", "provenance"),
    )
    action.only("mode", "rate_hz", "limits")
    network.only("activation", "squashing", *(("image", "strides") if version == VERSION else ()))
    origin.only("algorithm", "samples", "seed", "versions")
    versions = origin.child("versions")
    limit = None if document.values.get("observation_limit", 0) is None else document.number("observation_limit")
    layers = tuple(Layer(*pair) for pair in _pairs(arrays, _LAYERS))
    encoder = _encoder(network, arrays) if version == VERSION else None
    if encoder is None and _weight(_SEEING, 0) in arrays:
        raise document.error("version", f"{VERSION}, with convolutions")
    return Policy(
        environment=document.text("environment"),
        vehicle=document.text("vehicle"),
        inputs=tuple(_shape(one) for one in document.children("observations")),
        scaling=Scaling(arrays[_MEAN], arrays[_SCALE], limit),
        network=Network(layers, network.text("activation"), network.text("squashing"), encoder),
        action_mode=action.text("mode"),
        action_limits=_limits(action.child("limits")),
        action_rate_hz=action.number("rate_hz"),
        imu_rate_hz=document.number("imu_rate_hz"),
        provenance=Provenance(
            origin.text("algorithm"),
            origin.integer("samples"),
            origin.integer("seed"),
            {name: versions.text(name) for name in versions.values},
        ),
    )


def _encoder(network: Fields, arrays: dict[str, Array32]) -> Encoder:
    """Return the convolutions of a policy that sees.

    Raises:
        InputError: A field is missing or has a wrong type.
        PolicyError: The parts do not fit together.
    """
    pairs, strides, image = _pairs(arrays, _SEEING), network.integers("strides"), network.integers("image")
    if len(strides) != len(pairs):
        raise network.error("strides", f"{len(pairs)} numbers, one for each convolution")
    if len(image) != 3:
        raise network.error("image", "height, width and channels")
    seeing = tuple(Convolution(*pair, stride) for pair, stride in zip(pairs, strides, strict=True))
    return Encoder((image[0], image[1], image[2]), seeing)


def _pairs(arrays: dict[str, Array32], group: str) -> list[tuple[Array32, Array32]]:
    """Return weights and biases of all layers or convolutions."""
    count = sum(name.startswith(f"{group}.") for name in arrays) // 2
    return [(arrays[_weight(group, index)], arrays[_bias(group, index)]) for index in range(count)]


def _shape(document: Fields) -> NamedShape:
    """Return name and shape of an observation."""
    document.only("name", "shape")
    return NamedShape(document.text("name"), document.integers("shape"))


def _limits(document: Fields) -> ActionLimits:
    """Return the limits of actions.

    Raises:
        InputError: A limit is missing, unknown, or not positive.
    """
    names = [field.name for field in fields(ActionLimits)]
    document.only(*names)
    present = [name for name in names if name != "position_m" or name in document.values]  # older files lack it
    values = {name: document.number(name) for name in present}
    for name, value in values.items():
        if not value > 0.0:
            raise document.error(name, "a positive number")
    return ActionLimits(**values)


def _check_sizes(path: Path) -> None:
    """Raise InputError unless file and header are within their limits of size."""
    if not path.is_file():
        raise InputError(path, "it is no file" if path.exists() else "no such file", _FORMAT)
    size = path.stat().st_size
    if not 8 < size <= LARGEST_FILE_BYTES:
        raise InputError(path, f"{size} bytes", f"{_FORMAT}, up to {LARGEST_FILE_BYTES} bytes")
    with path.open("rb") as file:
        header = int.from_bytes(file.read(8), "little")
    if header > min(LARGEST_HEADER_BYTES, size - 8):
        raise InputError(path, f"a header of {header} bytes", f"{_FORMAT}, with a header in the file")


def _names(path: Path, names: list[str]) -> list[str]:
    """Return the names of the arrays of a policy after a check that the file has these and no others.

    Raises:
        InputError: An array is missing or unknown, or there are too many.
    """
    expected = [_MEAN, _SCALE]
    for group, least, most in ((_SEEING, 0, MOST_CONVOLUTIONS), (_LAYERS, 1, MOST_LAYERS)):
        count = -(-sum(name.startswith(f"{group}.") for name in names) // 2)  # rounded up, so that a lack is noticed
        if not least <= count <= most:
            raise InputError(path, f"{count} {group}", f"{least} to {most} {group} of 2 arrays each")
        expected += [name(group, index) for index in range(count) for name in (_weight, _bias)]
    for name in names:
        if name not in expected:
            raise InputError(path, f"an array {shortened(name)}", f"arrays {', '.join(expected)}")
    return expected


def _array(path: Path, file: safe_open, name: str) -> Array32:
    """Return an array of type float32 and at most four dimensions.

    Raises:
        InputError: It is missing, or has another type or more dimensions.
    """
    if name not in file.keys():  # noqa: SIM118 it is no dict
        raise InputError(path, f"no array {name}", _FORMAT)
    part = file.get_slice(name)
    if part.get_dtype() != "F32" or len(part.get_shape()) > 4:
        found = f"{name}: type {part.get_dtype()}, shape {shortened(part.get_shape())}"
        raise InputError(path, found, "type F32 and at most 4 dimensions")
    array = np.array(file.get_tensor(name), dtype=np.float32)
    array.flags.writeable = False
    return array


def _weight(group: str, index: int) -> str:
    """Return the name of the weights of a layer or a convolution."""
    return f"{group}.{index}.weight"


def _bias(group: str, index: int) -> str:
    """Return the name of the biases of a layer or a convolution."""
    return f"{group}.{index}.bias"
