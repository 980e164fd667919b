"""Bundle adjustment of a map in a process of its own, which ends with the one that has started it."""

import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import psutil
import pytest

from dronevio.estimator.slam.adjustment import adjuster
from dronevio.estimator.slam.adjustment.adjuster import LocalAdjuster, ProcessAdjuster, solved
from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustedMap, AdjustmentConfig, AdjustmentInputs, Scale

CONFIG = AdjustmentConfig(iterations=3)
STARTED = """
import sys, time
from dronevio.estimator.slam.adjustment.adjuster import ProcessAdjuster
from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentConfig
adjuster = ProcessAdjuster(AdjustmentConfig())
print(adjuster._pool.submit(__import__("os").getpid).result(), flush=True)
time.sleep(600.0)
"""
"""A program with an adjuster, which prints the number of the process that adjusts."""


def test_results_do_not_depend_on_the_process(adjustment_inputs: AdjustmentInputs) -> None:
    some = replace(adjustment_inputs, keyframes=adjustment_inputs.keyframes[:30], loops=[])
    local, other = LocalAdjuster(CONFIG), ProcessAdjuster(CONFIG)
    assert local.result() is None and other.result() is None
    for each in (local, other):
        each.start(some)
    expected, found = local.result(), other.result()
    assert expected is not None and expected.poses is not None and found is not None and found.poses is not None
    assert all(found.poses[number].tobytes() == T.tobytes() for number, T in expected.poses.items())
    assert found.text == expected.text
    assert local.cpu_s == 0.0 < other.cpu_s
    assert local.result() is None and other.result() is None  # a result is returned once


def test_singular_system_has_no_result(monkeypatch: pytest.MonkeyPatch, adjustment_inputs: AdjustmentInputs) -> None:
    def fail(inputs: AdjustmentInputs, config: AdjustmentConfig, scale: Scale) -> None:
        raise RuntimeError("Indeterminate linear system")

    monkeypatch.setattr(adjuster, "adjust", fail)
    found = solved(adjustment_inputs, CONFIG)
    assert found.poses is None and found.text == "not used: the linear system is singular"


@pytest.mark.parametrize(
    ("sizes", "noise", "tried", "text"),
    [
        ({Scale.IMU: 1.0}, 1.0, [Scale.IMU], "scale by the IMU"),
        ({Scale.IMU: 0.9, Scale.ODOMETRY: 1.0}, 1.0, [Scale.IMU, Scale.ODOMETRY], "scale by the odometry"),
        ({Scale.IMU: 1.0}, 1.3, [Scale.IMU], "scale by the IMU"),
        ({Scale.ODOMETRY: 1.0}, 1.5, [Scale.ODOMETRY], "scale by the odometry"),
        ({Scale.ODOMETRY: 0.998}, 5.0, [Scale.ODOMETRY], "scale by the odometry"),
        ({Scale.IMU: 0.9, Scale.ODOMETRY: 0.9}, 1.0, [Scale.IMU, Scale.ODOMETRY], "not used: scale differs by -10 %"),
    ],
    ids=["agrees", "contradicts", "nearly noisy", "noisy", "noisy and smaller", "both contradict"],
)
def test_the_scale_has_to_agree_with_the_odometry(
    monkeypatch: pytest.MonkeyPatch,
    adjustment_inputs: AdjustmentInputs,
    sizes: dict[Scale, float],
    noise: float,
    tried: list[Scale],
    text: str,
) -> None:
    """The adjusted map is the odometry, times a factor."""
    params, sheet, found = adjustment_inputs.params, adjustment_inputs.imu_model.accel_noise_density, []
    inputs = replace(adjustment_inputs, params=params.with_noise(params.gyro_variance**0.5, noise * sheet))

    def scaled(inputs: AdjustmentInputs, config: AdjustmentConfig, scale: Scale) -> AdjustedMap:
        found.append(scale)
        poses = {k.number: k.estimate.T_odom_imu.copy() for k in inputs.keyframes}
        for T in poses.values():
            T[:3, 3] *= sizes[scale]
        newest = inputs.keyframes[-1]
        return AdjustedMap(poses, newest.gyro_bias_rad_s, newest.accel_bias_m_s2, scale)

    monkeypatch.setattr(adjuster, "adjust", scaled)
    outcome = solved(inputs, CONFIG)
    assert found == tried and outcome.text.startswith(text)
    assert (outcome.poses is None) == text.startswith("not used")
    if outcome.poses is not None and tried[-1] is Scale.ODOMETRY:  # it has the scale of the odometry then
        first, *_, last = (k.number for k in inputs.keyframes)
        ends = outcome.poses[last][:3, 3] - outcome.poses[first][:3, 3]
        T_first, T_last = (inputs.keyframes[i].estimate.T_odom_imu for i in (0, -1))
        np.testing.assert_allclose(ends, T_last[:3, 3] - T_first[:3, 3], atol=1e-9)


def test_two_cameras_keep_their_scale(monkeypatch: pytest.MonkeyPatch, adjustment_inputs: AdjustmentInputs) -> None:
    """The baseline determines it, also where the IMU contradicts the odometry."""
    calibration, tried = adjustment_inputs.calibration, []
    two = replace(calibration, rig=replace(calibration.rig, cameras=2 * calibration.rig.cameras))
    newest = adjustment_inputs.keyframes[-1]

    def larger(inputs: AdjustmentInputs, config: AdjustmentConfig, scale: Scale) -> AdjustedMap:
        tried.append(scale)
        size = 1.002 if scale is Scale.ODOMETRY else 2.0
        S = np.diag([size, size, size, 1.0])
        poses = {k.number: S @ k.estimate.T_odom_imu @ np.linalg.inv(S) for k in inputs.keyframes}
        return AdjustedMap(poses, newest.gyro_bias_rad_s, newest.accel_bias_m_s2, scale)

    monkeypatch.setattr(adjuster, "adjust", larger)
    outcome = solved(replace(adjustment_inputs, calibration=two), CONFIG)
    assert tried == [Scale.IMU, Scale.ODOMETRY] and outcome.poses is not None
    np.testing.assert_allclose(outcome.poses[newest.number][:3, 3], 1.002 * newest.estimate.T_odom_imu[:3, 3])


@pytest.mark.parametrize("end", [lambda p: p.kill(), lambda p: p.terminate()], ids=["killed", "terminated"])
def test_process_ends_with_the_one_that_started_it(end: Callable[["subprocess.Popen[str]"], None]) -> None:
    with subprocess.Popen([sys.executable, "-c", STARTED], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = psutil.Process(int(parent.stdout.readline()))
        child.send_signal(signal.SIGINT)  # as Ctrl-C sends to all processes of a terminal
        assert child.is_running()
        end(parent)
        assert psutil.wait_procs([child], timeout=60.0)[1] == []
