"""KITTI files: round trip, an independent reader, times, and refused files."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dronevio.models.errors import InputError
from dronevio.models.recordings.kitti import (
    FRAME_NS,
    R_UP_KITTI,
    is_kitti,
    read_kitti,
    read_kitti_poses,
    read_times_ns,
    write_kitti,
)
from dronevio.models.recordings.trajectory_file import read_trajectory_file
from dronevio.models.rotation import exp_so3, matrix_from_quat_wxyz, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory

IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0\n"


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("kitti") / "00.txt"


@st.composite
def trajectories(draw: st.DrawFn) -> Trajectory:
    n = draw(st.integers(1, 8))
    p = draw(hnp.arrays(np.float64, (n, 3), elements=st.floats(allow_nan=False, allow_infinity=False)))
    phi = draw(hnp.arrays(np.float64, (n, 3), elements=st.floats(-3, 3)))
    return Trajectory(FRAME_NS * np.arange(n), p, quat_wxyz_from_matrix(exp_so3(phi)))


@settings(max_examples=200, deadline=None)
@given(trajectories())
def test_round_trip_is_exact_up_to_rotations(scratch: Path, trajectory: Trajectory) -> None:
    write_kitti(scratch, trajectory)
    for back in (read_kitti(scratch), read_trajectory_file(scratch)):
        np.testing.assert_array_equal(back.t_ns, trajectory.t_ns)
        np.testing.assert_array_equal(back.p_world_imu, trajectory.p_world_imu)
        np.testing.assert_allclose(
            matrix_from_quat_wxyz(back.quat_wxyz), matrix_from_quat_wxyz(trajectory.quat_wxyz), atol=1e-14
        )


def test_evo_reads_the_file(scratch: Path) -> None:
    from evo.tools import file_interface

    quat_wxyz = quat_wxyz_from_matrix(exp_so3(np.array([[0.1, -0.2, 0.3], [1.0, 2.0, -0.5]])))
    trajectory = Trajectory(FRAME_NS * np.arange(2), np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), quat_wxyz)
    write_kitti(scratch, trajectory)
    theirs = file_interface.read_kitti_poses_file(str(scratch))
    np.testing.assert_allclose(np.array(theirs.poses_se3), trajectory.Ts_world_imu, atol=1e-15)


def test_rounded_matrices_become_the_nearest_rotations(scratch: Path) -> None:
    R = exp_so3(np.array([0.3, -1.2, 0.7]))
    rows = np.hstack([R, [[7.0], [8.0], [9.0]]])
    scratch.write_text(" ".join(f"{x:.3f}" for x in rows.ravel()) + "\n")
    poses = read_kitti_poses(scratch)
    np.testing.assert_array_equal(poses.Ts_world_cam[0], np.round(rows, 3))  # without conversion
    found = poses.trajectory().rotations[0]
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(found, R, atol=1e-3)


def test_times_and_frame_numbers(tmp_path: Path) -> None:
    poses, times = tmp_path / "poses.txt", tmp_path / "times.txt"
    poses.write_text("".join(f"{frame} {IDENTITY}" for frame in (2, 3, 7)))
    times.write_text("".join(f"{0.1037 * i:e}\n" for i in range(9)))
    assert read_kitti(poses).t_ns.tolist() == [200_000_000, 300_000_000, 700_000_000]
    assert read_kitti(poses, times).t_ns.tolist() == [207_400_000, 311_100_000, 725_900_000]
    assert read_trajectory_file(poses, times=times).t_ns.tolist() == [207_400_000, 311_100_000, 725_900_000]
    times.write_text("0\n0.1\n0.2\n0.3\n")
    with pytest.raises(InputError, match="frame 7; expected frames below 4") as caught:
        read_kitti(poses, times)
    assert (caught.value.path, caught.value.line) == (poses, 3)
    times.write_text("".join(f"{0.1 * i}\n" for i in range(7)))
    with pytest.raises(InputError, match="frame 7; expected frames below 7"):
        read_kitti(poses, times)
    (tmp_path / "x.tum").write_text("0.5 1 2 3 0 0 0 1\n")
    with pytest.raises(InputError, match="a KITTI trajectory"):
        read_trajectory_file(tmp_path / "x.tum", times=times)


def test_the_format_is_detected(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("# a comment\n\n" + IDENTITY)
    (tmp_path / "b").write_text("0.5 1 2 3 0 0 0 1\n")
    (tmp_path / "c").write_text("5,1,2,3,1,0,0,0\n")
    assert [is_kitti(path) for path in (tmp_path / "a", tmp_path / "b", tmp_path / "c", tmp_path)] == [True] + 3 * [
        False
    ]


def test_world_axes_are_converted_to_z_up() -> None:
    down, forward = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    np.testing.assert_array_equal(R_UP_KITTI @ down, [0.0, 0.0, -1.0])
    np.testing.assert_array_equal(R_UP_KITTI @ forward, [1.0, 0.0, 0.0])
    assert np.linalg.det(R_UP_KITTI) == 1.0


@pytest.mark.parametrize(
    ("text", "line", "found"),
    [
        (IDENTITY + "1 0 0 0 0 1 0 0 0 0 1\n" + IDENTITY, 2, "11 columns"),
        (IDENTITY + "1 0 0 0 0 1 0 0 0 0 1", 2, "a last row of 11 columns (a truncated file?)"),
        (IDENTITY + "5 " + IDENTITY, 2, "13 columns"),
        (IDENTITY + IDENTITY.replace("1 0 0 0 0", "1 0 x 0 0"), 2, "'x'"),
        (IDENTITY + IDENTITY.replace("1 0 0 0 0", "1 0 nan 0 0"), 2, "'nan'"),
        (IDENTITY + IDENTITY.replace("1 0 0 0 0", "1 0 1e999 0 0"), 2, "'1e999'"),
        ("\n#\n" + IDENTITY.replace("1 0 0 0 0", "2 0 0 0 0"), 3, "not a rotation"),
        ("-" + IDENTITY, 1, "not a rotation"),
        (IDENTITY.replace("1 0 0 0 0", "1e200 0 0 0 0"), 1, "not a rotation"),
        ("0 " + IDENTITY + "0 " + IDENTITY, 2, "frame 0 after frame 0"),
        ("0.5 " + IDENTITY, 1, "frame 0.5"),
        ("-1 " + IDENTITY, 1, "frame -1"),
        ("1e17 " + IDENTITY, 1, "frame 1e+17"),
        (IDENTITY.replace("0\n", "0.25\n") + IDENTITY.replace("0\n", "0.2"), 2, "without a line end"),
    ],
)
def test_errors_name_the_line_and_the_cause(scratch: Path, text: str, line: int, found: str) -> None:
    scratch.write_text(text)
    with pytest.raises(InputError) as caught:
        read_kitti(scratch)
    assert caught.value.line == line and caught.value.path == scratch
    assert found in str(caught.value) and "expected" in str(caught.value)


@pytest.mark.parametrize("text", ["", "\n\n", "# nothing\n"])
def test_empty_files_are_refused(scratch: Path, text: str) -> None:
    scratch.write_text(text)
    with pytest.raises(InputError, match="no rows"):
        read_kitti(scratch)
    with pytest.raises(InputError, match="no rows"):
        read_times_ns(scratch)


@pytest.mark.parametrize(
    ("text", "line"), [("0\n0.1\nx\n", 3), ("0\n0.1 0.2\n", 2), ("0.1\n0.1\n", 2), ("0.2\n0.1\n", 2), ("1e12\n", 1)]
)
def test_invalid_times_are_refused(scratch: Path, text: str, line: int) -> None:
    scratch.write_text(text)
    with pytest.raises(InputError) as caught:
        read_times_ns(scratch)
    assert caught.value.line == line
