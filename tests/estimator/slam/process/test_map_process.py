"""The map in a worker process: the answers of a map in this process, and an end in every case."""

import copy
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.mapper import Mapper
from dronevio.estimator.slam.worker.map_builder import LocalMap, MapMessage, MarginalizedKeyframe, TrackLost
from dronevio.estimator.slam.worker.map_process import MOST_UNANSWERED, MapProcess
from dronevio.models.errors import DefectError
from tests.estimator.slam.process.conftest import DRIFT_M, PLACES, one_camera


@pytest.fixture
def worker() -> Iterator[MapProcess]:
    """Return a map in a worker process, which ends after the test."""
    process = MapProcess(one_camera(), SlamConfig())
    yield process
    process.close()


def has_ended(pid: int, within_s: float = 60.0) -> bool:
    """Return whether a process ends in time; one that nobody waits for counts as ended."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        found = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False)
        if not found.stdout.strip() or found.stdout.startswith("Z"):
            return True
        time.sleep(0.05)
    return False


def test_answers_equal_those_of_a_map_in_this_process(worker: MapProcess, two_laps: list[MarginalizedKeyframe]) -> None:
    local = LocalMap(one_camera(), SlamConfig())
    for message in two_laps:
        local.send(message)
        worker.send(message)
    pairs = [(local.receive(), worker.receive()) for _ in two_laps]
    for expected, found in pairs:
        assert expected is not None and found is not None
        assert found.T_map_odom is not None and expected.T_map_odom is not None
        assert found.T_map_odom.tobytes() == expected.T_map_odom.tobytes()
        assert [getattr(found.changes, name).tobytes() for name in vars(found.changes)] == [
            getattr(expected.changes, name).tobytes() for name in vars(expected.changes)
        ]
        assert len(found.changes.t_ns) >= 1
        assert found.covariance.tobytes() == expected.covariance.tobytes()
        assert [loop.T_first_second.tobytes() for loop in found.loops] == [
            loop.T_first_second.tobytes() for loop in expected.loops
        ]
    last = pairs[-1][1]
    assert (
        last is not None and last.T_map_odom is not None and sum(len(found.loops) for _, found in pairs if found) >= 2
    )
    assert last.T_map_odom[1, 3] == pytest.approx(-DRIFT_M, abs=0.3 * DRIFT_M)  # the second lap is moved back
    final, expected_final = (each.ask(Mapper.final_solution) for each in (worker, local))
    assert final is not None and expected_final is not None
    assert len(final.graph.poses) == 2 * PLACES
    for number, T in final.graph.poses.items():
        assert T.tobytes() == expected_final.graph.poses[number].tobytes()


def test_cost_contains_the_time_of_the_worker(worker: MapProcess, two_laps: list[MarginalizedKeyframe]) -> None:
    worker.send(two_laps[0])
    worker.receive()  # its imports take longer than this call
    worker.send(two_laps[1])
    cost = worker.cost(frames=10)
    assert cost.results == cost.waits == 1 and cost.frames == 10
    assert cost.worker_cpu_ms_per_frame == pytest.approx(100.0 * cost.worker_cpu_s) and cost.worker_cpu_s > 0.0
    assert worker.receive() is not None  # the answer that was read before it was due
    after = worker.cost(frames=10)
    assert after.results == 2 and after.waits == 1 and after.worker_cpu_s == cost.worker_cpu_s


def test_answers_after_a_loss_belong_to_another_track(worker: MapProcess, two_laps: list[MarginalizedKeyframe]) -> None:
    lost = TrackLost(two_laps[PLACES].estimate.t_ns)
    messages: list[MapMessage] = [*two_laps[:PLACES], lost, *two_laps[PLACES:]]
    for message in messages:
        worker.send(message)
    answers = [worker.receive() for _ in range(2 * PLACES + 1)]
    assert answers.pop(PLACES) is None
    tracks = [answer.track for answer in answers if answer is not None]
    assert tracks == PLACES * [0] + PLACES * [1]
    joined = [answer for answer in answers if answer is not None and answer.is_joined]
    assert len(joined) == 1 and joined[0].track == 1 and joined[0].T_map_odom is not None
    assert joined[0].T_map_odom[1, 3] == pytest.approx(-DRIFT_M, abs=0.3 * DRIFT_M)
    before = [answer for answer in answers[PLACES:] if answer is not None][: answers[PLACES:].index(joined[0])]
    assert before and all(answer.T_map_odom is None for answer in before)


def test_number_of_unanswered_messages_is_limited(worker: MapProcess) -> None:
    for _ in range(MOST_UNANSWERED + 5):
        worker.send(TrackLost(0))
    assert worker.cost(1).results == 0 and worker.cost(1).waits >= 1  # the start takes longer than sending
    assert [worker.receive() for _ in range(MOST_UNANSWERED + 5)] == [None] * (MOST_UNANSWERED + 5)


def test_death_of_the_worker_is_a_defect(worker: MapProcess, two_laps: list[MarginalizedKeyframe]) -> None:
    worker.send(two_laps[0])
    worker.receive()
    os.kill(worker.pid, signal.SIGKILL)
    with pytest.raises(DefectError, match=r"^the mapping process was killed by SIGKILL(\n|$)"):
        for message in two_laps:
            worker.send(message)
            worker.receive()
    with pytest.raises(DefectError, match="SIGKILL"):
        worker.ask(Mapper.final_solution)


def test_exception_in_the_worker_is_a_defect(worker: MapProcess) -> None:
    with pytest.raises(DefectError, match=r"^the mapping process failed: TypeError: .*Mapper.*") as caught:
        worker.ask(len)  # type: ignore[arg-type]
    assert "request.function(builder.mapper)" in caught.value.__notes__[0]


def test_interrupt_does_not_reach_the_worker(worker: MapProcess, two_laps: list[MarginalizedKeyframe]) -> None:
    worker.send(two_laps[0])
    worker.receive()
    os.kill(worker.pid, signal.SIGINT)
    worker.send(two_laps[1])
    assert worker.receive() is not None


def test_worker_ends_with_the_last_reference() -> None:
    worker = MapProcess(one_camera(), SlamConfig())
    pid = worker.pid
    del worker
    assert has_ended(pid)


def test_closed_map_says_so(worker: MapProcess) -> None:
    worker.close()
    assert has_ended(worker.pid)
    with pytest.raises(DefectError, match="closed"):
        worker.ask(Mapper.final_solution)


def test_worker_ends_when_its_parent_is_killed() -> None:
    code = (
        "import os, signal\n"
        "from dronevio.estimator.slam.config import SlamConfig\n"
        "from dronevio.estimator.slam.worker.map_process import MapProcess\n"
        "from tests.estimator.slam.process.conftest import one_camera\n"
        "worker = MapProcess(one_camera(), SlamConfig())\n"
        "print(worker.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode == -signal.SIGKILL, ran.stderr
    assert has_ended(int(ran.stdout))


def test_copy_of_the_mapper_continues(worker: MapProcess, two_laps: list[MarginalizedKeyframe]) -> None:
    for message in two_laps[:3]:
        worker.send(message)
    copied: Mapper = worker.ask(copy.copy)
    assert [keyframe.t_ns for keyframe in copied.keyframes] == [message.estimate.t_ns for message in two_laps[:3]]
    graph = copied.graph
    assert graph is not None and np.array_equal(graph.poses[0], two_laps[0].estimate.T_odom_imu)
