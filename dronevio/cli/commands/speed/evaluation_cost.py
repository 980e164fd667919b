"""Processor time and memory of the evaluation, as a command and as a library, compared with evo."""

import importlib.util
import os
import resource
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from dronevio.eval import ate, rpe, score
from dronevio.models.errors import ConfigError
from dronevio.models.performance import PerformanceFigure
from dronevio.models.recordings.kitti import FRAME_NS, write_kitti
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory

KITTI_00_POSES = 4541
"""Number of poses in the first sequence of the KITTI odometry benchmark."""
_EVO_APE = "import sys; from evo.cli.entry_points import ape; sys.exit(ape())"


def has_evo() -> bool:
    """Return whether evo is installed."""
    return importlib.util.find_spec("evo") is not None


def trajectory_pair(poses: int, seed: int = 0) -> tuple[Trajectory, Trajectory]:
    """Return a smooth drive at 10 m/s with 10 poses per second, and a noisy estimate of it."""
    rng = np.random.default_rng(seed)
    t_ns = FRAME_NS * np.arange(poses)
    t = t_ns * 1e-9
    heading = np.sin(0.05 * t) + 0.5 * np.sin(0.013 * t)
    step = 1.0 * np.stack([np.cos(heading), np.sin(heading), 0.02 * np.sin(0.03 * t)], axis=1)
    rotations = np.stack([0.02 * np.sin(0.3 * t), 0.02 * np.cos(0.2 * t), heading], axis=1)
    truth = Trajectory(t_ns, np.cumsum(step, axis=0), quat_wxyz_from_matrix(exp_so3(rotations)))
    noise_m, noise_rad = rng.normal(0.0, 0.1, (poses, 3)), rng.normal(0.0, 0.01, (poses, 3))
    return truth, Trajectory(t_ns, truth.p_world_imu + noise_m, quat_wxyz_from_matrix(exp_so3(rotations + noise_rad)))


def command_figure(files: tuple[Path, Path] | None, tries: int) -> PerformanceFigure:
    """Measure the processor time of ``dronevio evaluate`` relative to that of ``evo_ape``, as processes.

    Args:
        files: Ground truth and estimate as KITTI files; None to generate them.
        tries: Number of measurements, of which the smallest counts.
    """
    with ExitStack() as stack:
        if files is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dronevio-speed-")))
            files = folder / "truth.txt", folder / "estimate.txt"
            for path, trajectory in zip(files, trajectory_pair(KITTI_00_POSES), strict=True):
                write_kitti(path, trajectory)
        truth, estimate = map(str, files)
        ours = [sys.executable, "-m", "dronevio.cli", "evaluate", truth, estimate, "--alignment", "se3"]
        theirs = [sys.executable, "-c", _EVO_APE, "kitti", truth, estimate, "-a"]
        ours_s, theirs_s = _smallest(tries, lambda: _process_s(ours)), _smallest(tries, lambda: _process_s(theirs))
    return PerformanceFigure(
        "dronevio evaluate, relative to evo_ape",
        ours_s / theirs_s,
        "",
        0.5,
        "at most",
        f"{ours_s:.2f} s and {theirs_s:.2f} s of processor time with all imports; ours computes ATE and RPE of position"
        " and orientation and errors by length, evo_ape the ATE of position",
    )


def library_figure(poses: int, tries: int) -> PerformanceFigure:
    """Measure the processor time of ATE and RPE in evo relative to ours."""
    truth, estimate = trajectory_pair(poses)
    ours_s, theirs_s = _smallest(tries, lambda: _ours_s(truth, estimate)), _evo_s(truth, estimate)
    return PerformanceFigure(
        f"ATE and RPE of {poses} poses in evo, relative to ours",
        theirs_s / ours_s,
        "",
        10.0,
        "at least",
        f"{theirs_s:.2f} s and {ours_s:.3f} s of processor time, se3 alignment, relative errors between consecutive"
        " poses, position and orientation",
    )


def size_figure(poses: int, tries: int) -> PerformanceFigure:
    """Measure the processor time of ATE and RPE of many poses."""
    truth, estimate = trajectory_pair(poses)
    ours_s = _smallest(tries, lambda: _ours_s(truth, estimate))
    whole_s = _cpu_s(lambda: score(truth, estimate))
    return PerformanceFigure(
        f"ATE and RPE of {poses} poses",
        ours_s,
        "s",
        2.0,
        "at most",
        f"processor time; {whole_s:.2f} s for all scores with association and errors by length",
    )


def memory_figure(poses: int) -> PerformanceFigure:
    """Measure how the memory of the evaluation grows from a tenth of the poses to all of them."""
    few_mb, many_mb = (_peak_mb(*trajectory_pair(count)) for count in (poses // 10, poses))
    return PerformanceFigure(
        "memory for ten times the poses, divided by ten",
        many_mb / few_mb / 10.0,
        "",
        1.1,
        "at most",
        f"{many_mb:.1f} MB for {poses} poses, {few_mb:.1f} MB for {poses // 10}: peak memory of numpy arrays",
    )


def _ours_s(truth: Trajectory, estimate: Trajectory) -> float:
    """Return the processor time of our ATE and RPE [s]."""
    poses = truth.p_world_imu, truth.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz

    def work() -> None:
        ate(truth.p_world_imu, estimate.p_world_imu, "se3")
        relative = rpe(*poses, 1, "frames")
        _ = relative.translation_m, relative.rotation_deg

    return _cpu_s(work)


def _evo_s(truth: Trajectory, estimate: Trajectory) -> float:
    """Return the processor time of evo's ATE and RPE [s]."""
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D

    both = [PoseTrajectory3D(x.p_world_imu, x.quat_wxyz, x.t_ns * 1e-9) for x in (truth, estimate)]

    def work() -> None:
        both[1].align(both[0])
        relations = metrics.PoseRelation
        by_frames = {"delta": 1, "delta_unit": metrics.Unit.frames, "all_pairs": True}
        wanted: list[Any] = [
            metrics.APE(relations.translation_part),
            metrics.RPE(relations.translation_part, **by_frames),
            metrics.RPE(relations.rotation_angle_deg, **by_frames),
        ]
        for metric in wanted:
            metric.process_data(tuple(both))
            metric.get_all_statistics()

    return _cpu_s(work)


def _peak_mb(truth: Trajectory, estimate: Trajectory) -> float:
    """Return the peak memory of the evaluation [MB]."""
    tracemalloc.start()
    try:
        score(truth, estimate)
        return tracemalloc.get_traced_memory()[1] * 1e-6
    finally:
        tracemalloc.stop()


def _smallest(tries: int, measure: Callable[[], float]) -> float:
    """Return the smallest of several measurements; disturbances only add to the time of a process."""
    return min(measure() for _ in range(tries))


def _cpu_s(work: Callable[[], object]) -> float:
    """Return the processor time of a function in this process [s]."""
    start = time.process_time()
    work()
    return time.process_time() - start


def _process_s(words: list[str]) -> float:
    """Return the processor time of a process [s].

    Raises:
        ConfigError: The process fails.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {key: value for key, value in os.environ.items() if key != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
    if done.returncode != 0:
        raise ConfigError(f"{' '.join(words[1:])} failed; {done.stderr.strip() or done.stdout.strip()}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
