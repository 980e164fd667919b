"""One thread for linear algebra and OpenCV within the estimators, whatever the process has otherwise."""

import os
import subprocess
import sys
import threading
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.threads import single_threaded
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import euroc_rig
from dronevio.models.state import CameraFrame

_PROBE = """
import hashlib

import numpy as np

from dronevio.models.rig import euroc_rig
from tests.estimator.conftest import Motion, SyntheticFlight, room

flight = SyntheticFlight(Motion(rest_s=1.0), 4.0, 0, euroc_rig(), room(np.random.default_rng(0)), max_features=200)
digest = hashlib.sha256()
for estimate in flight.run():
    if estimate.state is not None:
        digest.update(estimate.state.T_world_imu.tobytes())
print(digest.hexdigest())
"""


def threads() -> list[int]:
    """Return the numbers of threads of the BLAS libraries and of OpenCV."""
    blas = [library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"]
    assert blas
    return [*blas, cv2.getNumThreads()]


@pytest.fixture
def two_threads() -> Iterator[list[int]]:
    """Let BLAS libraries and OpenCV use two threads during a test, and return what `threads` then does."""
    before = cv2.getNumThreads()
    with threadpool_limits(2, user_api="blas"):
        cv2.setNumThreads(2)
        yield threads()
        cv2.setNumThreads(before)


def test_numbers_of_threads_are_limited_and_restored(two_threads: list[int]) -> None:
    with single_threaded():
        assert set(threads()) == {1}
        with single_threaded():
            assert set(threads()) == {1}
        assert set(threads()) == {1}
    assert threads() == two_threads


def test_numbers_of_threads_are_restored_after_an_error(two_threads: list[int]) -> None:
    with pytest.raises(ValueError, match="inside"), single_threaded():
        raise ValueError("inside")
    assert threads() == two_threads


def test_overlapping_contexts_of_several_threads_restore_once(two_threads: list[int]) -> None:
    entered, may_leave = threading.Event(), threading.Event()

    def other() -> None:
        with single_threaded():
            entered.set()
            may_leave.wait(10.0)

    thread = threading.Thread(target=other)
    with single_threaded():
        thread.start()
        assert entered.wait(10.0)
    assert set(threads()) == {1}  # the other thread is still within its context
    may_leave.set()
    thread.join()
    assert threads() == two_threads


def test_the_odometry_works_on_one_thread(two_threads: list[int]) -> None:
    seen: list[list[int]] = []

    class FrontEnd:
        def track(self, *_: object) -> object:
            seen.append(threads())
            raise KeyError("seen")

    vio = VisualInertialOdometry(euroc_rig(), front_end=FrontEnd())  # type: ignore[arg-type]
    vio.add_imu(ImuSamples(np.arange(10) * 5_000_000, np.zeros((10, 3)), np.tile([0.0, 0.0, 9.81], (10, 1))))
    with pytest.raises(KeyError):
        vio.add_frame(CameraFrame(20_000_000, (np.zeros((480, 752), np.uint8),)))
    assert set(seen[0]) == {1}
    assert threads() == two_threads


def test_estimates_do_not_depend_on_the_number_of_threads() -> None:
    """The threads of a process that has imported NumPy before the package are those of the machine."""

    def digest(**threads: str) -> str:
        environment = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
        found = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment | threads, capture_output=True, text=True, check=True
        )
        return found.stdout

    assert digest() == digest(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
