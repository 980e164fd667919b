"""What calibration files say of an IMU: EuRoC's and Kalibr's names for its densities, and ours for the rest.

``gyroscope_turn_on_bias`` and ``accelerometer_turn_on_bias`` are keys of our own, and so are the names of `ImuModel`'s
other fields, under which stands whatever else of the IMU is not perfect. Other readers pass over them.
"""

from dataclasses import fields

from dronevio.models.imu import ImuModel
from dronevio.models.recordings.calibration.sensor_yaml import SensorYaml, shown
from dronevio.models.recordings.files import blamed_on

_DENSITIES = {
    "gyroscope_noise_density": "gyro_noise_density",
    "gyroscope_random_walk": "gyro_random_walk",
    "accelerometer_noise_density": "accel_noise_density",
    "accelerometer_random_walk": "accel_random_walk",
}
_TURN_ON_BIASES = {
    "gyroscope_turn_on_bias": "gyro_turn_on_bias_rad_s",
    "accelerometer_turn_on_bias": "accel_turn_on_bias_m_s2",
}
_UNITS = {
    "gyroscope_noise_density": "rad / s / sqrt(Hz)",
    "gyroscope_random_walk": "rad / s^2 / sqrt(Hz)",
    "accelerometer_noise_density": "m / s^2 / sqrt(Hz)",
    "accelerometer_random_walk": "m / s^3 / sqrt(Hz)",
    "gyroscope_turn_on_bias": "rad / s, standard deviation",
    "accelerometer_turn_on_bias": "m / s^2, standard deviation",
}
_IMPERFECTIONS = tuple(
    field.name for field in fields(ImuModel)[2:] if field.name not in (_DENSITIES | _TURN_ON_BIASES).values()
)
_DEFAULTS = {field.name: field.default for field in fields(ImuModel)}


def read_imu_fields(yaml: SensorYaml, name_key: str, rate_key: str, prefix: str = "") -> ImuModel:
    """Return the IMU that a calibration file describes.

    A density of zero says that a sensor is perfect, and breaks whatever filter believes it: it is refused.

    Args:
        yaml: The file.
        name_key: Where the IMU's name stands, if anywhere.
        rate_key: Where its rate stands [Hz].
        prefix: The map that holds all these keys, with a dot behind it.

    Raises:
        InputError: A field is missing or not what it should be.
    """
    name = yaml.word(prefix + name_key) if prefix + name_key in yaml else "imu0"
    values = {"rate_hz": yaml.positive(prefix + rate_key)}
    values |= {ours: yaml.positive(prefix + theirs) for theirs, ours in _DENSITIES.items()}
    for theirs, ours in _TURN_ON_BIASES.items():
        values[ours] = yaml.number(prefix + theirs) if prefix + theirs in yaml else float(str(_DEFAULTS[ours]))
        if values[ours] < 0.0:
            raise yaml.fault(prefix + theirs, "a standard deviation, zero or more")
    values |= {ours: yaml.positive(prefix + ours) for ours in _IMPERFECTIONS if prefix + ours in yaml}
    with blamed_on(yaml.path):
        return ImuModel(name=name, **values)


def imu_fields_yaml(imu: ImuModel, name_key: str, rate_key: str) -> str:
    """Return the lines that describe an IMU, which `read_imu_fields` reads back to the bit."""
    lines = [f"{name_key}: {shown(imu.name)}", f"{rate_key}: {shown(float(imu.rate_hz))}"]
    lines += [
        f"{theirs}: {shown(float(getattr(imu, ours)))}  # [ {_UNITS[theirs]} ]"
        for theirs, ours in (_DENSITIES | _TURN_ON_BIASES).items()
    ]
    lines += [
        f"{ours}: {shown(float(getattr(imu, ours)))}"
        for ours in _IMPERFECTIONS
        if getattr(imu, ours) != _DEFAULTS[ours]
    ]
    return "".join(f"{line}\n" for line in lines)
