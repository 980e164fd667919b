"""Commercial IMUs with the parameters of their data sheets, in SI units.

Data sheets use degrees, g and hours; `deg`, `per_hour`, `per_root_hour` and `g` convert them where the values are
written. Values that a data sheet calls typical, and the ± values of Bosch and Analog Devices, are regarded as one
standard deviation, and the tolerances of InvenSense as three.

No data sheet specifies the random walk of a bias. The density used here is that for which the Allan deviation of the
walk, K √(τ/3), equals the bias instability at τ = 1000 s, because measured curves rise beyond that time. The bias
instability is therefore from the data sheet, and the random walk an assumption; the densities of EuRoC (`EUROC_IMU`)
are larger, as is usual for the parameters of an estimator.
"""

import math

from dronevio.models.errors import unknown_name
from dronevio.models.imu import EUROC_IMU, STANDARD_GRAVITY_M_S2, ImuModel

_RANDOM_WALK_FROM_S = 1000.0


def deg(degrees: float) -> float:
    """Return degrees as radians."""
    return math.radians(degrees)


def g(multiple: float) -> float:
    """Return a multiple of the standard gravity [m/s²]."""
    return multiple * STANDARD_GRAVITY_M_S2


def per_hour(value: float) -> float:
    """Return a value per hour as a value per second."""
    return value / 3600.0


def per_root_hour(value: float) -> float:
    """Return an angular or velocity random walk, x/√h, as a white noise density, x/√s = x/s/√Hz."""
    return value / 60.0


def random_walk_of(floor: float) -> float:
    """Return the density of the random walk whose Allan deviation is ``floor`` at 1000 s [unit of floor /s/√Hz]."""
    return floor * math.sqrt(3.0 / _RANDOM_WALK_FROM_S)


ADIS16448 = ImuModel(
    name="ADIS16448",
    rate_hz=200.0,
    gyro_noise_density=deg(0.0135),
    gyro_random_walk=random_walk_of(per_hour(deg(14.5))),
    accel_noise_density=g(0.23e-3),
    accel_random_walk=random_walk_of(g(0.25e-3)),
    gyro_turn_on_bias_rad_s=deg(0.5),
    accel_turn_on_bias_m_s2=g(20e-3),
    gyro_bias_instability_rad_s=per_hour(deg(14.5)),
    accel_bias_instability_m_s2=g(0.25e-3),
    gyro_scale_error=0.01,
    accel_scale_error=0.005,
    gyro_misalignment_rad=deg(0.05),
    accel_misalignment_rad=deg(0.2),
    gyro_g_sensitivity_rad_s_per_m_s2=deg(0.015) / g(1.0),
    gyro_range_rad_s=deg(1000.0),
    accel_range_m_s2=g(18.0),
    gyro_resolution_rad_s=deg(0.04),
    accel_resolution_m_s2=g(1.0 / 1200.0),
    gyro_bandwidth_hz=330.0,
    accel_bandwidth_hz=330.0,
)
"""Analog Devices ADIS16448, the IMU of EuRoC's rig without calibration: ADIS16448 data sheet, table 1. Rate noise
0.0135 °/s/√Hz, in-run bias stability 14.5 °/h and 0.25 mg, acceleration noise 0.23 mg/√Hz, initial bias 0.5 °/s and
20 mg, sensitivity to 1 % and 0.5 %, axis-to-axis misalignment 0.05° and 0.2°, linear acceleration effect 0.015 °/s/g,
ranges ±1000 °/s and ±18 g, 0.04 °/s and 0.833 mg a bit, 330 Hz."""

BMI088 = ImuModel(
    name="BMI088",
    rate_hz=400.0,
    gyro_noise_density=deg(0.014),
    gyro_random_walk=random_walk_of(per_hour(deg(2.0))),
    accel_noise_density=g(175e-6),
    accel_random_walk=random_walk_of(g(30e-6)),
    gyro_turn_on_bias_rad_s=deg(1.0),
    accel_turn_on_bias_m_s2=g(20e-3),
    gyro_bias_instability_rad_s=per_hour(deg(2.0)),
    accel_bias_instability_m_s2=g(30e-6),
    gyro_scale_error=0.01,
    accel_scale_error=0.005,
    gyro_misalignment_rad=0.01,
    accel_misalignment_rad=0.005,
    gyro_g_sensitivity_rad_s_per_m_s2=deg(0.1) / g(1.0),
    gyro_range_rad_s=deg(2000.0),
    accel_range_m_s2=g(24.0),
    gyro_resolution_rad_s=deg(1.0 / 16.384),
    accel_resolution_m_s2=g(24.0 / 32768.0),
    gyro_bandwidth_hz=116.0,
    accel_bandwidth_hz=145.0,
)
"""Bosch BMI088, the IMU of many flight controllers and racing drones: data sheet BST-BMI088-DS001. Noise 0.014 °/s/√Hz
and 175 µg/√Hz, bias stability of the gyroscope below 2 °/h, zero offsets 1 °/s and 20 mg, sensitivity to 1 % and 0.5 %,
cross-axis sensitivity 1 % and 0.5 %, 0.1 °/s/g, ranges ±2000 °/s and ±24 g in 16 bits; output filters of 116 Hz and
145 Hz. The data sheet does not specify the bias stability of the accelerometer; 30 µg is an assumption."""

MPU_6050 = ImuModel(
    name="MPU-6050",
    rate_hz=200.0,
    gyro_noise_density=deg(0.005),
    gyro_random_walk=random_walk_of(deg(0.0012)),
    accel_noise_density=g(400e-6),
    accel_random_walk=random_walk_of(g(100e-6)),
    gyro_turn_on_bias_rad_s=deg(20.0) / 3.0,
    accel_turn_on_bias_m_s2=g(50e-3) / 3.0,
    gyro_bias_instability_rad_s=deg(0.0012),
    accel_bias_instability_m_s2=g(100e-6),
    gyro_scale_error=0.03 / 3.0,
    accel_scale_error=0.03 / 3.0,
    gyro_misalignment_rad=0.02 / 3.0,
    accel_misalignment_rad=0.02 / 3.0,
    gyro_g_sensitivity_rad_s_per_m_s2=deg(0.1) / g(1.0),
    gyro_range_rad_s=deg(1000.0),
    accel_range_m_s2=g(16.0),
    gyro_resolution_rad_s=deg(1.0 / 32.8),
    accel_resolution_m_s2=g(1.0 / 2048.0),
    gyro_bandwidth_hz=98.0,
    accel_bandwidth_hz=94.0,
)
"""InvenSense MPU-6050, a low-cost IMU: product specification PS-MPU-6000A-00, rev. 3.4, tables 6.1 and 6.2. Noise
0.005 °/s/√Hz and 400 µg/√Hz, zero offsets within ±20 °/s and ±50 mg, sensitivity within 3 %, cross-axis sensitivity
within 2 %, 0.1 °/s/g, ranges ±1000 °/s at 32.8 bits per °/s and ±16 g at 2048 per g; low-pass filter 2, 98 and 94 Hz.
The data sheet does not specify bias stabilities: 0.0012 °/s of the gyroscope was measured on one unit (Robotics Stack
Exchange, 8860), and 100 µg of the accelerometer is an assumption."""

TACTICAL = ImuModel(
    name="tactical",
    rate_hz=500.0,
    gyro_noise_density=per_root_hour(deg(0.15)),
    gyro_random_walk=random_walk_of(per_hour(deg(0.5))),
    accel_noise_density=per_root_hour(0.06),
    accel_random_walk=random_walk_of(g(0.05e-3)),
    gyro_turn_on_bias_rad_s=per_hour(deg(4.0)),
    accel_turn_on_bias_m_s2=g(0.75e-3),
    gyro_bias_instability_rad_s=per_hour(deg(0.5)),
    accel_bias_instability_m_s2=g(0.05e-3),
    gyro_scale_error=500e-6,
    accel_scale_error=300e-6,
    gyro_misalignment_rad=1e-3,
    accel_misalignment_rad=1e-3,
    gyro_g_sensitivity_rad_s_per_m_s2=per_hour(deg(1.0)) / g(1.0),
    gyro_range_rad_s=deg(400.0),
    accel_range_m_s2=g(10.0),
    gyro_resolution_rad_s=per_hour(deg(0.22)),
    accel_resolution_m_s2=g(1.9e-6),
    gyro_bandwidth_hz=131.0,
    accel_bandwidth_hz=131.0,
)
"""Sensonor STIM300 with 10 g accelerometers, a tactical-grade MEMS IMU: data sheet TS1524. Angular random walk
0.15 °/√h, velocity random walk 0.06 m/s/√h, bias instability 0.5 °/h and 0.05 mg, run to run 4 °/h and 0.75 mg, scale
500 and 300 ppm, misalignment 1 mrad, 1 °/h/g with g-compensation, ranges ±400 °/s and ±10 g, 0.22 °/h and 1.9 µg a bit,
filter of 131 Hz. Aggressive flight exceeds its ranges."""

IMUS: dict[str, ImuModel] = {
    "euroc": EUROC_IMU,
    **{imu.name: imu for imu in (ADIS16448, BMI088, MPU_6050, TACTICAL)},
}
"""The IMU models by name."""


def imu_named(name: str) -> ImuModel:
    """Return the IMU model with a given name.

    Raises:
        ConfigError: There is no IMU with this name.
    """
    if name not in IMUS:
        raise unknown_name("IMU", name, IMUS)
    return IMUS[name]
