"""TUM files: round trip, an independent reader, and refused files."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from dronevio.models.errors import InputError
from dronevio.models.recordings.trajectory_file import read_trajectory_file
from dronevio.models.recordings.tum import read_tum, write_tum
from dronevio.models.state import Trajectory


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("tum") / "trajectory.tum"


@st.composite
def trajectories(draw: st.DrawFn) -> Trajectory:
    t_ns = np.array(sorted(draw(st.sets(st.integers(1 - 2**62, 2**62 - 1), min_size=1, max_size=8))), dtype=np.int64)
    n = len(t_ns)
    p = draw(hnp.arrays(np.float64, (n, 3), elements=st.floats(allow_nan=False, allow_infinity=False)))
    q = draw(hnp.arrays(np.float64, (n, 4), elements=st.floats(-1, 1)))
    q[:, 0] += 2.0
    return Trajectory(t_ns, p, q / np.linalg.norm(q, axis=1, keepdims=True))


@settings(max_examples=300, deadline=None)
@given(trajectories())
def test_round_trip_is_exact(scratch: Path, trajectory: Trajectory) -> None:
    write_tum(scratch, trajectory)
    back = read_tum(scratch)
    np.testing.assert_array_equal(back.t_ns, trajectory.t_ns)
    np.testing.assert_array_equal(back.p_world_imu, trajectory.p_world_imu)
    np.testing.assert_array_equal(back.quat_wxyz, trajectory.quat_wxyz)


def test_evo_reads_the_file(scratch: Path) -> None:
    """The quaternion order of the format is x y z w."""
    from evo.tools import file_interface

    q = np.array([[0.5, -0.5, 0.5, 0.5], [0.8, 0.6, 0.0, 0.0]])
    trajectory = Trajectory(np.array([1_500_000_000, 1_550_000_000]), np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), q)
    write_tum(scratch, trajectory)
    theirs = file_interface.read_tum_trajectory_file(str(scratch))
    np.testing.assert_array_equal(theirs.timestamps, [1.5, 1.55])
    np.testing.assert_array_equal(theirs.positions_xyz, trajectory.p_world_imu)
    np.testing.assert_array_equal(theirs.orientations_quat_wxyz, q)


def test_writing_is_atomic(tmp_path: Path) -> None:
    trajectory = Trajectory(np.array([0]), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))
    write_tum(tmp_path / "deep" / "down" / "a.tum", trajectory)
    assert [path.name for path in (tmp_path / "deep" / "down").iterdir()] == ["a.tum"]
    (tmp_path / "taken").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        write_tum(tmp_path / "taken", trajectory)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deep", "taken"]


@pytest.mark.parametrize("quaternion", ["0 0 0 0", "1 1 1 1", "0 0 0 2", "1e200 0 0 0"])
def test_quaternions_without_unit_length_are_refused(scratch: Path, quaternion: str) -> None:
    scratch.write_text(f"0.0 1 2 3 0 0 0 1\n0.1 1 2 3 {quaternion}\n")
    with pytest.raises(InputError, match="quaternion of length") as caught:
        read_tum(scratch)
    assert caught.value.line == 2


def test_formats_are_detected(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("# t x y z qx qy qz qw\n\n0.5 1 2 3 0 0 0 1\n")
    (tmp_path / "b.txt").write_text("500000000,1,2,3,1,0,0,0\n")
    (tmp_path / "mav0" / "state_groundtruth_estimate0").mkdir(parents=True)
    (tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv").write_text("500000000,1,2,3,1,0,0,0\n")
    for path in (tmp_path / "a.txt", tmp_path / "b.txt", tmp_path, tmp_path / "mav0"):
        if path.name == "mav0":
            (path / "imu0").mkdir()
        trajectory = read_trajectory_file(path)
        assert trajectory.t_ns.tolist() == [500_000_000]
        np.testing.assert_array_equal(trajectory.p_world_imu, [[1, 2, 3]])
        np.testing.assert_array_equal(trajectory.quat_wxyz, [[1, 0, 0, 0]])


def test_other_files_are_refused(tmp_path: Path) -> None:
    for content in ("", "# only a comment\n", "hello world\n", "1 2 3\n"):
        (tmp_path / "x").write_text(content)
        with pytest.raises(InputError):
            read_trajectory_file(tmp_path / "x")
    for path in (tmp_path, tmp_path / "missing"):
        with pytest.raises(InputError):
            read_trajectory_file(path)
