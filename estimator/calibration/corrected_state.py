"""The state of the vehicle by a corrected calibration, propagated from the end of a window to the newest keyframe."""

from collections.abc import Sequence

import gtsam

from dronevio.estimator.calibration.window import WindowKeyframe
from dronevio.estimator.imu.covariance import propagate_covariance
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuModel
from dronevio.models.state import NavState


def propagated_state(adjusted: NavState, later: Sequence[WindowKeyframe], before: Array, imu: ImuModel) -> NavState:
    """Return a state propagated by the IMU, with its covariance.

    Args:
        adjusted: State at the end of a window, with its covariance relative to the first keyframe of the window.
        later: The keyframes after the window, in the order of time.
        before: (3, 3) Covariance of the position of that first keyframe [m²].
        imu: The sensor model, for the random walks of the biases.
    """
    assert adjusted.covariance is not None
    P, t_ns = adjusted.covariance.copy(), adjusted.t_ns
    P[3:6, 3:6] += before
    nav = gtsam.NavState(gtsam.Pose3(adjusted.T_world_imu), adjusted.velocity_m_s)
    bias = gtsam.imuBias.ConstantBias(adjusted.accel_bias_m_s2, adjusted.gyro_bias_rad_s)
    for keyframe in later:
        pim = keyframe.preintegrated
        assert pim is not None
        P = propagate_covariance(
            P,
            nav.attitude().matrix(),
            dR=pim.deltaRij().matrix(),
            dp=pim.deltaPij(),
            dv=pim.deltaVij(),
            dt_s=pim.deltaTij(),
            imu=imu,
            noise=pim.preintMeasCov()[:9, :9],
        )
        nav, t_ns = pim.predict(nav, bias), keyframe.state.t_ns
    return NavState(t_ns, nav.pose().matrix(), nav.velocity(), adjusted.gyro_bias_rad_s, adjusted.accel_bias_m_s2, P)
