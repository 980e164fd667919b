"""The file of a map: what is written is read back to the bit, and no damaged file passes or fails otherwise."""

import io
import json
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dronevio.estimator.slam.files.map_file import DOCUMENT, MEMBERS, read_map, write_map
from dronevio.estimator.slam.files.saved_arrays import LAYOUT
from dronevio.estimator.slam.files.saved_map import SavedMap
from dronevio.models.errors import ConfigError, DronevioError, InputError
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import exp_so3, pose_matrix

Array = npt.NDArray[np.generic]

KEYFRAMES, CORNERS, LANDMARKS, PATCHES, SIDE = 6, 4, 3, 2, 5  # of the latter, for each keyframe


def small_map(seed: int = 0, patches: int = PATCHES) -> SavedMap:
    """Return a map of a few keyframes with random values."""
    rng = np.random.default_rng(seed)
    corners, landmarks, patch_count = KEYFRAMES * CORNERS, KEYFRAMES * LANDMARKS, KEYFRAMES * patches

    def counts(each: int) -> npt.NDArray[np.int32]:
        return np.full(KEYFRAMES, each, np.int32)

    def floats(*shape: int) -> npt.NDArray[np.float32]:
        return rng.uniform(0.0, 100.0, shape).astype(np.float32)

    def covariances(count: int) -> npt.NDArray[np.float64]:
        roots = rng.normal(size=(count, 6, 6))
        product = roots @ np.swapaxes(roots, 1, 2) + np.eye(6)
        return np.asarray(product + np.swapaxes(product, 1, 2))

    pairs = np.column_stack([np.arange(KEYFRAMES - 1), np.arange(1, KEYFRAMES)]).astype(np.int32)
    return SavedMap(
        cameras=euroc_rig().cameras,
        first=0,
        t_ns=np.cumsum(rng.integers(1, 10**9, KEYFRAMES)),
        Ts_map_imu=pose_matrix(exp_so3(rng.normal(size=(KEYFRAMES, 3))), rng.normal(size=(KEYFRAMES, 3))),
        corner_counts=counts(CORNERS),
        pixels=floats(corners, 2),
        xy=floats(corners, 2),
        corner_camera=np.zeros(corners, np.uint8),
        descriptors=rng.integers(0, 256, (corners, 32), dtype=np.uint8),
        corner_landmark=rng.integers(-1, 9, corners, dtype=np.int32),
        landmark_counts=counts(LANDMARKS),
        landmark_ids=np.tile(np.arange(LANDMARKS, dtype=np.int32), KEYFRAMES),
        landmarks_imu=floats(landmarks, 3),
        patch_counts=counts(patches),
        patch_points_imu=floats(patch_count, 3),
        patch_pixels=floats(patch_count, 2),
        patch_camera=np.zeros(patch_count, np.uint8),
        tiles=rng.integers(0, 256, (patch_count, SIDE, SIDE), dtype=np.uint8),
        first_covariance=covariances(1)[0],
        odometry=pairs,
        odometry_covariances=covariances(KEYFRAMES - 1),
        gravity=np.array([1, 4], np.int32),
        gravity_sigmas_rad=np.array([1e-3, 2e-3]),
        loops=np.array([[0, 4]], np.int32),
        loop_covariances=covariances(1),
        joined=np.zeros(0, np.int32),
    )


def written(path: Path, saved: SavedMap | None = None) -> Path:
    """Return the file of a map."""
    write_map(path, saved or small_map())
    return path


@cache
def content_of_members() -> dict[str, bytes]:
    """Return the members of the file of a map."""
    with zipfile.ZipFile(io.BytesIO(file_content())) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@cache
def file_content() -> bytes:
    """Return the bytes of the file of a map."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        return written(Path(folder) / "room.map").read_bytes()


def rewritten(path: Path, **changed: bytes | None) -> Path:
    """Write a file in which members are replaced, added, or left out if None; two underscores stand for a dot."""
    members: dict[str, bytes | None] = {
        **content_of_members(),
        **{name.replace("__", "."): data for name, data in changed.items()},
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            if data is not None:
                archive.writestr(name, data)
    return path


def npy(array: Array) -> bytes:
    """Return an array as the content of an npy file."""
    with io.BytesIO() as content:
        np.lib.format.write_array(content, array, version=(1, 0))
        return content.getvalue()


def assert_equal(found: SavedMap, expected: SavedMap) -> None:
    """Compare all fields to the bit."""
    for field in fields(SavedMap):
        one, other = getattr(found, field.name), getattr(expected, field.name)
        if isinstance(one, np.ndarray):
            assert one.dtype == other.dtype and one.shape == other.shape, field.name
            assert one.tobytes() == other.tobytes(), field.name
        elif field.name != "cameras":
            assert one == other
    for one, other in zip(found.cameras, expected.cameras, strict=True):
        assert one.model == other.model and one.rate_hz == other.rate_hz and one.readout_s == other.readout_s
        np.testing.assert_array_equal(one.T_imu_cam, other.T_imu_cam)


@given(st.integers(0, 2**32 - 1), st.integers(0, 3))
@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_maps_are_read_back_to_the_bit(tmp_path: Path, seed: int, patches: int) -> None:
    saved = small_map(seed, patches)
    assert_equal(read_map(written(tmp_path / "room.map", saved)), saved)
    assert [each.name for each in tmp_path.iterdir()] == ["room.map"]  # nothing half-written


@pytest.mark.parametrize(
    "change",
    [
        {"lens": "ds", "distortion": (-0.2, 0.6)},
        {"lens": "fov", "distortion": (0.9,)},
        {"distortion": (-0.28, 0.07, 2e-4, 2e-5, -0.01, 0.1, 0.2, 0.3)},
    ],
    ids=["ds", "fov", "rational"],
)
def test_lenses_are_read_back(tmp_path: Path, change: dict[str, Any]) -> None:
    saved = small_map()
    camera = replace(saved.cameras[0], model=replace(saved.cameras[0].model, **change))
    saved = replace(saved, cameras=(camera, *saved.cameras[1:]))
    assert_equal(read_map(written(tmp_path / "room.map", saved)), saved)


def test_the_same_map_gives_the_same_bytes(tmp_path: Path) -> None:
    assert written(tmp_path / "a").read_bytes() == written(tmp_path / "b").read_bytes()
    with zipfile.ZipFile(tmp_path / "a") as archive:
        assert tuple(archive.namelist()) == MEMBERS


@given(st.data())
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_truncated_files_are_refused(tmp_path: Path, data: st.DataObject) -> None:
    content, path = file_content(), tmp_path / "room.map"
    path.write_bytes(content[: data.draw(st.integers(0, len(content) - 1))])
    with pytest.raises(InputError, match=r"room\.map: .*; expected "):
        read_map(path)


@given(st.data())
@settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_flipped_bytes_are_refused_or_harmless(tmp_path: Path, data: st.DataObject) -> None:
    content, path = bytearray(file_content()), tmp_path / "room.map"
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    try:
        found = read_map(path)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert_equal(found, small_map())  # for example the date of a member


@given(st.data())
@settings(max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_damaged_members_are_refused_or_finite(tmp_path: Path, data: st.DataObject) -> None:
    """Damage that the checksums of the archive do not show."""
    name = data.draw(st.sampled_from(MEMBERS))
    content = bytearray(content_of_members()[name])
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = rewritten(tmp_path / "room.map", **{name.replace(".", "__"): bytes(content)})
    try:
        found = read_map(path)
    except DronevioError as error:
        assert str(error).startswith(str(path)) and "\n" not in str(error)
    else:
        known = found.known()
        assert all(np.isfinite(keyframe.T_odom_imu).all() for keyframe in known.keyframes)
        assert sum(len(keyframe.features) for keyframe in known.keyframes) == len(found.pixels)


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("pixels", np.zeros((3, 2), np.float32), r"map whose xy has shape \(24, 2\); expected shape \(3, 2\)"),
        ("pixels", np.zeros((24, 3), np.float32), r"map whose pixels has shape \(24, 3\)"),
        ("pixels", np.zeros((24, 2)), r"pixels\.npy of type <f8; expected type <f4"),
        ("pixels", np.zeros((24, 2), ">f4"), r"pixels\.npy without the header"),
        ("pixels", np.full((24, 2), np.nan, np.float32), "pixels has values that are not finite"),
        ("pixels", np.zeros(24, np.float32), r"pixels\.npy with 1 dimensions; expected 2"),
        ("tiles", np.zeros((12, 5, 6), np.uint8), r"tiles has shape \(12, 5, 6\)"),
        ("t_ns", np.arange(6)[::-1].copy(), "times that do not increase"),
        ("t_ns", np.arange(6) * 2**59, "t_ns has .* times of flights"),
        ("Ts_map_imu", 2.0 * np.tile(np.eye(4), (6, 1, 1)), "R Rᵀ off the identity"),
        ("Ts_map_imu", np.tile(np.diag([-1.0, 1.0, 1.0, 1.0]), (6, 1, 1)), "a reflection"),
        ("corner_counts", np.array([5, 4, 4, 4, 4, 4], np.int32), "the sum 24"),
        ("corner_counts", np.array([-1, 9, 4, 4, 4, 4], np.int32), "no negative one"),
        ("corner_camera", np.ones(24, np.uint8), "corner_camera has the value 1; expected 0 to 0"),
        ("odometry", np.array([[0, 9]] * 5, np.int32), "odometry has the value 9; expected 0 to 5"),
        ("odometry", np.array([[0, 0]] * 5, np.int32), "a keyframe connected with itself"),
        ("odometry", np.array([[0, 1]] * 5, np.int32), "keyframes in 4 parts without connection"),
        ("landmark_ids", np.zeros(18, np.int32), "identities that do not increase"),
        ("loop_covariances", np.zeros((1, 6, 6)), "loop_covariances has the eigenvalue 0"),
        ("first_covariance", np.triu(np.ones((6, 6))), "a matrix that is not symmetric"),
        ("gravity_sigmas_rad", np.array([0.0, 1.0]), "no standard deviations"),
    ],
)
def test_arrays_that_are_not_those_of_a_map(tmp_path: Path, name: str, array: Array, message: str) -> None:
    path = rewritten(tmp_path / "room.map", **{f"{name}__npy": npy(array)})
    with pytest.raises(InputError, match=rf"room\.map: .*{message}"):
        read_map(path)


def without(document: dict[str, Any], *keys: str) -> dict[str, Any]:
    """Return a copy of a document without some keys."""
    return {key: value for key, value in document.items() if key not in keys}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: {**d, "version": 2}, "version 2; expected version 1"),
        (lambda d: {**d, "version": True}, "version True"),
        (lambda d: {**d, "format": "other"}, "another format; expected the format 'dronevio-map'"),
        (lambda d: [d], "another format"),
        (lambda d: {**d, "first": 6}, "first has row 6; expected one of the 6 keyframes"),
        (lambda d: {**d, "first": "0"}, "first = '0'; expected a whole number"),
        (lambda d: without(d, "cameras"), "cameras = None"),
        (lambda d: {**d, "cameras": [{}]}, "an object with model and T_imu_cam"),
        (lambda d: {**d, "cameras": [without(d["cameras"][0], "T_imu_cam")]}, "T_imu_cam = None"),
        (lambda d: {**d, "cameras": [{**d["cameras"][0], "T_imu_cam": [[1, 2, 3, "x"]] * 4}]}, "T_imu_cam = 'x'"),
        (lambda d: {**d, "cameras": [{**d["cameras"][0], "rate_hz": -1.0}]}, "rate_hz"),
        (lambda d: {**d, "cameras": [{**d["cameras"][0], "rate_hz": 1e400}]}, "rate_hz = inf"),
    ],
)
def test_documents_that_are_not_those_of_a_map(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], message: str
) -> None:
    document = json.loads(content_of_members()[DOCUMENT])
    path = rewritten(tmp_path / "room.map", map__json=json.dumps(change(document)).encode())
    with pytest.raises(InputError, match=message):
        read_map(path)


def test_other_members_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "room.map"
    for changed, message in (
        ({"xy__npy": None}, "an archive with 24 members"),
        ({"xy__npy": None, "../xy__npy": b""}, r"the member '\.\./xy\.npy'"),
        ({"xy__npy": None, "/etc/xy__npy": b""}, "the member '/etc/xy"),
        ({"map__json": b"[" * 100_000}, r"map\.json that cannot be read"),
        ({"map__json": b"[" * 2_000_000}, r"map\.json of 2000000 bytes"),
        ({"t_ns__npy": b"\x80\x04K\x01."}, r"t_ns\.npy without the header of an array"),  # a pickle
    ):
        with pytest.raises(InputError, match=message):
            read_map(rewritten(path, **changed))
    for content in (b"", b"PK", b"text" * 100):
        path.write_bytes(content)
        with pytest.raises(InputError, match="no archive, or a truncated one"):
            read_map(path)
    with pytest.raises(InputError, match="a folder"):
        read_map(tmp_path)


def huge_array(shape: str) -> bytes:
    """Return an npy file with a declared shape and little data."""
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * ((64 - (len(header) + 11) % 64) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"\x00" * 32


@pytest.mark.parametrize("shape", ["(99999999999, 32)", "(1, 99999999999999999999999999)", "(-1, 32)", "(0, 1e9)"])
def test_huge_declared_shapes_are_refused(tmp_path: Path, shape: str) -> None:
    with pytest.raises(InputError, match=r"descriptors\.npy with"):
        read_map(rewritten(tmp_path / "room.map", descriptors__npy=huge_array(shape)))


def peak_of_reading(path: Path) -> int:
    """Return the largest memory in use while a damaged map is read [bytes]."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError):
            read_map(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_members_that_expand_are_refused(tmp_path: Path) -> None:
    size = 100 * 2**20
    path = rewritten(tmp_path / "room.map", tiles__npy=bytes(size))
    with pytest.raises(InputError, match=r"members of 1.* bytes; expected at most"):
        read_map(path)
    assert peak_of_reading(path) < 2**20
    content = path.read_bytes()
    path.write_bytes(
        content.replace(size.to_bytes(4, "little"), (2**20).to_bytes(4, "little"))
    )  # as the directory says
    assert content != path.read_bytes() and peak_of_reading(path) < 16 * 2**20


def test_maps_that_contradict_themselves_are_not_made() -> None:
    with pytest.raises(ConfigError, match="map whose first has row 7"):
        replace(small_map(), first=7)
    assert set(LAYOUT) == {field.name for field in fields(SavedMap)} - {"cameras", "first"}
