"""Fields of an IMU in calibration files of EuRoC and Kalibr.

The noise densities have the keys of EuRoC and Kalibr. ``gyroscope_turn_on_bias``, ``accelerometer_turn_on_bias`` and
the names of the other fields of `ImuModel` are additional keys, which other readers ignore.
"""

from dataclasses import fields

from dronevio.models.imu import ImuModel
from dronevio.models.recordings.calibration.yaml_document import YamlDocument
from dronevio.models.recordings.calibration.yaml_text import yaml_text
from dronevio.models.recordings.files import as_input_error

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
_OTHER_ERRORS = tuple(
    field.name for field in fields(ImuModel)[2:] if field.name not in (_DENSITIES | _TURN_ON_BIASES).values()
)
_DEFAULTS = {field.name: field.default for field in fields(ImuModel)}


def read_imu_fields(yaml: YamlDocument, name_key: str, rate_key: str, prefix: str = "") -> ImuModel:
    """Return the IMU of a calibration file.

    Noise densities of zero are refused, because no filter can use them.

    Args:
        yaml: The calibration file.
        name_key: Key of the name of the IMU, which is optional.
        rate_key: Key of its rate [Hz].
        prefix: Name of the map that contains these keys, with a dot at its end; empty for the top level.

    Raises:
        InputError: A field is missing or invalid.
    """
    name = yaml.word(prefix + name_key) if prefix + name_key in yaml else "imu0"
    values = {"rate_hz": yaml.positive(prefix + rate_key)}
    values |= {ours: yaml.positive(prefix + theirs) for theirs, ours in _DENSITIES.items()}
    for theirs, ours in _TURN_ON_BIASES.items():
        values[ours] = yaml.number(prefix + theirs) if prefix + theirs in yaml else float(str(_DEFAULTS[ours]))
        if values[ours] < 0.0:
            raise yaml.error(prefix + theirs, "a non-negative standard deviation")
    values |= {ours: yaml.positive(prefix + ours) for ours in _OTHER_ERRORS if prefix + ours in yaml}
    with as_input_error(yaml.path):
        return ImuModel(name=name, **values)


def imu_fields_yaml(imu: ImuModel, name_key: str, rate_key: str) -> str:
    """Return the lines of an IMU in a calibration file, without loss of precision."""
    lines = [f"{name_key}: {yaml_text(imu.name)}", f"{rate_key}: {yaml_text(float(imu.rate_hz))}"]
    lines += [
        f"{theirs}: {yaml_text(float(getattr(imu, ours)))}  # [ {_UNITS[theirs]} ]"
        for theirs, ours in (_DENSITIES | _TURN_ON_BIASES).items()
    ]
    lines += [
        f"{ours}: {yaml_text(float(getattr(imu, ours)))}"
        for ours in _OTHER_ERRORS
        if getattr(imu, ours) != _DEFAULTS[ours]
    ]
    return "".join(f"{line}\n" for line in lines)
