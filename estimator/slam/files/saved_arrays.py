"""The arrays of a saved map: their types and shapes, and the checks that they agree with each other."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError

MIN_KEYFRAMES = 5
"""Smallest number of keyframes of a saved map."""
LAYOUT: Mapping[str, tuple[str, tuple[str | int, ...]]] = MappingProxyType(
    {
        "t_ns": ("<i8", ("keyframes",)),
        "Ts_map_imu": ("<f8", ("keyframes", 4, 4)),
        "corner_counts": ("<i4", ("keyframes",)),
        "pixels": ("<f4", ("corners", 2)),
        "xy": ("<f4", ("corners", 2)),
        "corner_camera": ("|u1", ("corners",)),
        "descriptors": ("|u1", ("corners", 32)),
        "corner_landmark": ("<i4", ("corners",)),
        "landmark_counts": ("<i4", ("keyframes",)),
        "landmark_ids": ("<i4", ("landmarks",)),
        "landmarks_imu": ("<f4", ("landmarks", 3)),
        "patch_counts": ("<i4", ("keyframes",)),
        "patch_points_imu": ("<f4", ("patches", 3)),
        "patch_pixels": ("<f4", ("patches", 2)),
        "patch_camera": ("|u1", ("patches",)),
        "tiles": ("|u1", ("patches", "side", "side")),
        "first_covariance": ("<f8", (6, 6)),
        "odometry": ("<i4", ("relative poses", 2)),
        "odometry_covariances": ("<f8", ("relative poses", 6, 6)),
        "gravity": ("<i4", ("directions",)),
        "gravity_sigmas_rad": ("<f8", ("directions",)),
        "loops": ("<i4", ("loops", 2)),
        "loop_covariances": ("<f8", ("loops", 6, 6)),
        "joined": ("<i4", ("tracks",)),
    }
)
"""Type and shape of each array; a word stands for the same length in all arrays."""
MAX_COORDINATE = 1e6
"""Largest coordinate of a position [m]."""
MAX_PIXEL = 65_536.0
"""Largest image coordinate [px]."""
MAX_SPAN_NS = 2**60
"""Largest time between the first and the last keyframe [ns]."""
VARIANCES = 1e-24, 1e12
"""Smallest and largest eigenvalue of a covariance [rad², m²]."""
_ORTHONORMAL = 1e-6

Arrays = Mapping[str, npt.NDArray[np.generic]]


def check_arrays(arrays: Arrays, first: int, cameras: int) -> None:
    """Check that the arrays of a saved map agree with each other, and that their values are those of a map.

    Args:
        arrays: The arrays, by the names in `LAYOUT`.
        first: Row of the first keyframe.
        cameras: Number of cameras.

    Raises:
        ConfigError: They do not; the message names the array, what was found and what was expected.
    """
    lengths = _checked_lengths(arrays)
    keyframes = lengths["keyframes"]
    _require(keyframes >= MIN_KEYFRAMES, "t_ns", f"{keyframes} keyframes", f"{MIN_KEYFRAMES} or more")
    _require(0 <= first < keyframes, "first", f"row {first}", f"one of the {keyframes} keyframes")
    _require(0 < cameras < 256, "cameras", f"{cameras} cameras", "1 to 255")
    _check_times(arrays["t_ns"].astype(np.int64))
    _check_poses(arrays["Ts_map_imu"].astype(np.float64))
    for name, length in (
        ("corner_counts", "corners"),
        ("landmark_counts", "landmarks"),
        ("patch_counts", "patches"),
    ):
        counts = arrays[name].astype(np.int64)
        total = f"counts whose sum is {counts.sum()} and whose smallest is {counts.min()}"
        is_sum = counts.min() >= 0 and counts.sum() == lengths[length]
        _require(is_sum, name, total, f"no negative one, and the sum {lengths[length]}")
    for name, largest in (
        ("pixels", MAX_PIXEL),
        ("xy", MAX_COORDINATE),
        ("landmarks_imu", MAX_COORDINATE),
        ("patch_points_imu", MAX_COORDINATE),
        ("patch_pixels", MAX_PIXEL),
    ):
        is_number = np.all(np.abs(arrays[name]) <= largest)  # not of NaN
        _require(is_number, name, "values that are not finite, or too large", f"numbers up to {largest:g}")
    for name in ("corner_camera", "patch_camera"):
        _check_rows(arrays, name, 0, cameras)
    for name in ("odometry", "gravity", "loops", "joined"):
        _check_rows(arrays, name, 0, keyframes)
    _check_rows(arrays, "corner_landmark", -1, 2**31 - 1)
    _check_identities(arrays)
    for name in ("first_covariance", "odometry_covariances", "loop_covariances"):
        _check_covariances(name, arrays[name].astype(np.float64).reshape(-1, 6, 6))
    sigmas = arrays["gravity_sigmas_rad"].astype(np.float64)
    is_sigma = np.all((sigmas**2 >= VARIANCES[0]) & (sigmas**2 <= VARIANCES[1]))
    _require(is_sigma, "gravity_sigmas_rad", "values that are no standard deviations", "positive numbers")
    _check_connections(arrays, keyframes)


def _checked_lengths(arrays: Arrays) -> dict[str, int]:
    """Return the lengths of the layout, or raise ConfigError if types or shapes contradict it or each other."""
    lengths: dict[str, int] = {}
    for name, (dtype, layout) in LAYOUT.items():
        array = arrays[name]
        _require(array.dtype == np.dtype(dtype), name, f"type {array.dtype.str}", f"type {dtype}")
        expected = tuple(lengths.get(n, n) if isinstance(n, str) else n for n in layout)
        fits = array.ndim == len(layout)
        for word, n in zip(layout, array.shape, strict=False):
            wanted = lengths.setdefault(word, n) if isinstance(word, str) else word
            fits = fits and n == wanted
        shape = f"({', '.join(map(str, expected))})"
        _require(fits, name, f"shape {array.shape}", f"shape {shape}")
    return lengths


def _require(condition: object, name: str, found: str, expected: str) -> None:
    """Raise ConfigError unless a condition of an array holds."""
    if not condition:
        raise ConfigError(f"map whose {name} has {found}; expected {expected}")


def _check_times(t_ns: npt.NDArray[np.int64]) -> None:
    """Raise ConfigError unless times (K,) increase and are those of flights."""
    is_small = np.all((t_ns > -MAX_SPAN_NS) & (t_ns < 2 * MAX_SPAN_NS))
    expected = "strictly increasing times of flights"
    _require(is_small and np.all(np.diff(t_ns) > 0), "t_ns", "times that do not increase, or too large ones", expected)
    _require(t_ns[-1] - t_ns[0] < MAX_SPAN_NS, "t_ns", "keyframes decades apart", expected)


def _check_poses(T: npt.NDArray[np.float64]) -> None:
    """Raise ConfigError unless matrices (K, 4, 4) are poses."""
    name, expected = "Ts_map_imu", "rigid transformations"
    _require(np.all(np.abs(T) <= MAX_COORDINATE), name, "values that are not finite, or too large", expected)
    R = T[:, :3, :3]
    error = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max()
    _require(error <= _ORTHONORMAL, name, f"a rotation with R Rᵀ off the identity by {error:.2g}", expected)
    _require(np.all(np.linalg.det(R) > 0.0), name, "a reflection", expected)
    _require(np.all(T[:, 3] == [0.0, 0.0, 0.0, 1.0]), name, "a last row other than (0, 0, 0, 1)", expected)


def _check_rows(arrays: Arrays, name: str, smallest: int, count: int) -> None:
    """Raise ConfigError unless the values of an array are at least the smallest one and less than the count."""
    values = arrays[name].astype(np.int64)
    unknown = values[(values < smallest) | (values >= count)]
    if len(unknown):
        _require(False, name, f"the value {unknown[0]}", f"{smallest} to {count - 1}")


def _check_identities(arrays: Arrays) -> None:
    """Raise ConfigError unless the identities of the landmarks increase within each keyframe."""
    ids, counts = arrays["landmark_ids"].astype(np.int64), arrays["landmark_counts"].astype(np.int64)
    begins = np.cumsum(counts)[:-1]
    increases = np.diff(ids, prepend=-1) > 0
    increases[begins[begins < len(ids)]] = True
    is_valid = np.all(increases) and np.all(ids >= 0)
    _require(is_valid, "landmark_ids", "identities that do not increase within a keyframe", "increasing ones from 0 on")


def _check_covariances(name: str, covariances: npt.NDArray[np.float64]) -> None:
    """Raise ConfigError unless matrices (N, 6, 6) are covariances."""
    expected = f"symmetric matrices with eigenvalues from {VARIANCES[0]:g} to {VARIANCES[1]:g}"
    if not len(covariances):
        return
    _require(np.all(np.abs(covariances) <= VARIANCES[1]), name, "values that are not finite, or too large", expected)
    scale = np.abs(covariances).max(axis=(1, 2), keepdims=True)
    is_symmetric = np.all(np.abs(covariances - np.swapaxes(covariances, 1, 2)) <= 1e-6 * scale)
    _require(is_symmetric, name, "a matrix that is not symmetric", expected)
    smallest = np.linalg.eigvalsh(covariances).min()
    _require(smallest >= VARIANCES[0], name, f"the eigenvalue {smallest:.2g}", expected)


def _check_connections(arrays: Arrays, keyframes: int) -> None:
    """Raise ConfigError unless the factors connect different keyframes, and all of them with each other."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = np.concatenate([arrays["odometry"], arrays["loops"]]).astype(np.int64)
    _require(np.all(pairs[:, 0] != pairs[:, 1]), "odometry", "a keyframe connected with itself", "different keyframes")
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(keyframes, keyframes))
    parts = int(connected_components(links, directed=False)[0])
    _require(parts == 1, "odometry", f"keyframes in {parts} parts without connection", "one connected map")
