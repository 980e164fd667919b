"""The image sensor against its equations (noise, gain, saturation, vignetting); exposure control against theory."""

import numpy as np
import pytest
from scipy.special import ndtri

from dronevio.models.errors import ConfigError
from dronevio.sim.cameras.exposure import AutoExposure, Exposures, FixedExposure
from dronevio.sim.cameras.imaging import VI_SENSOR, Imaging, image_sensor_named

NOMINAL_S = 0.002


def grey(level: float, shape: tuple[int, int] = (400, 400)) -> np.ndarray:
    return np.full(shape, level, np.uint8)


def histogram(image: np.ndarray) -> np.ndarray:
    return np.bincount(image.ravel(), minlength=256) / image.size


@pytest.mark.parametrize("gain", [1.0, 4.0])
def test_noise_has_the_stated_variance(gain: float) -> None:
    sensor = Imaging(read_sigma=1.5, shot_sigma=3.0, vignetting=0.0)
    for level in (20, 120, 220):
        noisy = sensor.digitize(grey(level), 1.0, NOMINAL_S / gain, gain, np.random.default_rng(0)).astype(float)
        signal = level / gain
        expected = gain**2 * (1.5**2 + 3.0**2 * signal / 255.0) + 1.0 / 12.0  # the last term is that of rounding
        assert abs(noisy.mean() - level) < 0.1
        assert noisy.var() == pytest.approx(expected, rel=0.03)


def test_level_is_proportional_to_light_until_saturation() -> None:
    sensor = Imaging(read_sigma=0.0, shot_sigma=0.0, vignetting=0.0)
    rng = np.random.default_rng(0)
    for irradiance, exposure_s, gain in ((0.5, NOMINAL_S, 1.0), (1.0, 0.5 * NOMINAL_S, 1.0), (0.05, NOMINAL_S, 10.0)):
        assert np.all(sensor.digitize(grey(100), irradiance, exposure_s, gain, rng) == 50)
    assert np.all(sensor.digitize(grey(100), 1.0, 3.0 * NOMINAL_S, 1.0, rng) == 255)
    fine = sensor.digitize(np.full((4, 4), 10.3, np.float32), 0.1, NOMINAL_S, 10.0, rng)
    assert np.all(fine == 10)  # light is not rounded before the converter


def test_vignetting_darkens_the_corners_only() -> None:
    sensor = Imaging(read_sigma=0.0, shot_sigma=0.0, vignetting=0.2)
    image = sensor.digitize(grey(200, (101, 201)), 1.0, NOMINAL_S, 1.0, np.random.default_rng(0))
    assert image[50, 100] == 200
    assert image[0, 0] == image[-1, -1] == 160


def test_blur_has_the_stated_width() -> None:
    sensor = Imaging(read_sigma=0.0, shot_sigma=0.0, vignetting=0.0, blur_sigma_px=1.5)
    step = np.where(np.arange(41) < 20, 50.0, 150.0)[None].repeat(41, axis=0).astype(np.float32)
    edge = np.diff(sensor.digitize(step, 1.0, NOMINAL_S, 1.0, np.random.default_rng(0))[20].astype(float))
    centre = edge @ np.arange(40) / edge.sum()
    assert np.sqrt(edge @ (np.arange(40) - centre) ** 2 / edge.sum()) == pytest.approx(1.5, abs=0.05)


def test_contrast_widens_the_range_of_light() -> None:
    """With an exponent of 2, half of the middle grey has a quarter of its light, and 1.25 times it 1.56 times."""
    sensor = Imaging(read_sigma=0.0, shot_sigma=0.0, vignetting=0.0, contrast=2.0)
    levels = [
        int(sensor.digitize(grey(level), 1.0, NOMINAL_S, 1.0, np.random.default_rng(0))[0, 0])
        for level in (64, 128, 160, 250)
    ]
    assert levels == [32, 128, 200, 255]


def test_auto_exposure_meters_the_light_with_contrast() -> None:
    """Levels of 64 and 160 have light of 32 and 200."""
    scene = 0.5 * histogram(grey(64)) + 0.5 * histogram(grey(160))
    sensor = Imaging(AutoExposure(tolerance=0.0, target_level=58.0), NOMINAL_S, contrast=2.0)
    exposures = sensor.exposures(np.stack([scene] * 3), np.ones(3))
    np.testing.assert_allclose(exposures.time_s / NOMINAL_S, 58.0 / 116.0, rtol=1e-3)


def test_pattern_of_pixels_is_fixed_for_a_camera() -> None:
    sensor = Imaging(read_sigma=0.0, shot_sigma=0.0, vignetting=0.0, response_sigma=0.05)
    one, two, other = (
        sensor.digitize(grey(120), 1.0, NOMINAL_S, 1.0, np.random.default_rng(frame), pixels).astype(float)
        for frame, pixels in ((0, 7), (1, 7), (0, 8))
    )
    np.testing.assert_array_equal(one, two)
    assert one.std() == pytest.approx(6.0, rel=0.02)
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.02
    dark = sensor.digitize(grey(12), 1.0, NOMINAL_S, 1.0, np.random.default_rng(0), 7).astype(float)
    assert dark.std() == pytest.approx(np.hypot(0.6, np.sqrt(1.0 / 12.0)), rel=0.05)  # proportional to the light


def test_defaults_leave_images_as_they_are() -> None:
    """The image of a sensor without the further properties is that of the equations of EMVA 1288 alone."""
    light = np.random.default_rng(0).integers(0, 200, (60, 80)).astype(np.uint8)
    image = Imaging(vignetting=0.0).digitize(light, 1.0, NOMINAL_S, 1.0, np.random.default_rng(5), 3)
    signal = light.astype(np.float32)
    drawn = np.random.default_rng(5).integers(65536, size=light.shape, dtype=np.uint16)
    noise = ndtri((drawn.astype(float) + 0.5) / 65536)
    expected = np.clip(np.rint(signal + np.sqrt(1.2**2 + 2.2**2 / 255.0 * signal) * noise), 0, 255)
    assert np.mean(image == expected) > 0.999  # but for the rounding of single precision


def test_image_sensors_have_names() -> None:
    assert image_sensor_named("standard") == Imaging()
    assert image_sensor_named("vi-sensor") == VI_SENSOR
    with pytest.raises(ConfigError, match=r"no image sensor 'vi'; expected one of standard, vi-sensor"):
        image_sensor_named("vi")


def test_same_seed_same_bytes() -> None:
    sensor = Imaging()
    one, two, other = (sensor.digitize(grey(90), 1.0, NOMINAL_S, 1.0, np.random.default_rng(k)) for k in (0, 0, 1))
    np.testing.assert_array_equal(one, two)
    assert np.any(one != other)


def control(auto: AutoExposure, histograms: list[np.ndarray], irradiance: np.ndarray) -> Exposures:
    return Imaging(auto, NOMINAL_S).exposures(np.stack(histograms), irradiance)


def test_a_constant_scene_has_the_target_level() -> None:
    scene = histogram(np.random.default_rng(0).integers(20, 140, (60, 90)))
    exposures = control(AutoExposure(tolerance=0.0), [scene] * 3, np.ones(3))
    mean = scene @ np.minimum(np.arange(256) * exposures.time_s[0] / NOMINAL_S, 255.0)
    assert mean == pytest.approx(110.0, abs=0.5)
    np.testing.assert_allclose(exposures.time_s, exposures.time_s[0], rtol=1e-6)
    assert np.all(exposures.gain == 1.0)


def test_saturated_pixels_count_as_white() -> None:
    scene = 0.4 * histogram(grey(250)) + 0.6 * histogram(grey(20))  # as through a window
    exposures = control(AutoExposure(tolerance=0.0, target_level=150.0, longest_s=0.05), [scene] * 60, np.ones(60))
    assert exposures.time_s[-1] / NOMINAL_S == pytest.approx((150.0 - 0.4 * 255.0) / (0.6 * 20.0), rel=1e-3)


def test_exposure_follows_a_step_of_light_without_overshoot() -> None:
    scene = histogram(grey(100))
    light = np.where(np.arange(40) < 10, 1.0, 0.25)
    x = np.log(control(AutoExposure(tolerance=0.0, longest_s=0.05), [scene] * 40, light).time_s)
    # Frame 10 is dark; frame 12 is the first that its histogram affects
    np.testing.assert_allclose(x[:12], x[0], atol=1e-9)
    step = (x[12:] - x[0]) / np.log(4.0)
    n = np.arange(len(step))
    np.testing.assert_allclose(1.0 - step, (0.5 * (n + 1) + 1.0) * 0.5 ** (n + 1.0), atol=1e-3)  # (a + b n) ½ⁿ
    assert np.all(np.diff(step) > -1e-9)


def test_exposure_recovers_from_darkness_in_half_a_second() -> None:
    scene = histogram(np.random.default_rng(0).integers(20, 200, (60, 90)))
    light = np.where((np.arange(60) >= 10) & (np.arange(60) < 20), 1e-4, 1.0)
    exposures = control(AutoExposure(), [scene] * 60, light)
    brightness = exposures.time_s * exposures.gain / (exposures.time_s[0] * exposures.gain[0])
    assert brightness[20] > 10.0
    np.testing.assert_allclose(brightness[30:], 1.0, atol=0.25)
    assert brightness[20:].min() > 0.6


def test_gain_increases_only_at_the_longest_exposure() -> None:
    scene = histogram(grey(110))
    for light, time_s, gain in ((0.5, 0.004, 1.0), (0.05, 0.010, 4.0), (0.0001, 0.010, 16.0), (1000.0, 2e-5, 1.0)):
        exposures = control(AutoExposure(tolerance=0.0), [scene] * 60, np.full(60, light))
        assert exposures.time_s[-1] == pytest.approx(time_s, rel=1e-3)
        assert exposures.gain[-1] == pytest.approx(gain, rel=1e-3)


def test_errors_within_the_tolerance_are_ignored() -> None:
    scenes = [histogram(grey(level)) for level in (110, 112, 108, 111, 110, 140, 140, 140)]
    exposures = control(AutoExposure(tolerance=0.05), scenes, np.ones(8))
    assert np.all(exposures.time_s[:7] == exposures.time_s[0])
    assert exposures.time_s[7] < exposures.time_s[6]


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: FixedExposure(time_s=0.0), "time_s"),
        (lambda: FixedExposure(gain=0.5), "gain"),
        (lambda: AutoExposure(target_level=300.0), "target_level"),
        (lambda: AutoExposure(speed=1.5), "speed"),
        (lambda: AutoExposure(shortest_s=0.1), "shortest_s"),
        (lambda: Imaging(vignetting=1.2), "vignetting"),
        (lambda: Imaging(read_sigma=float("nan")), "read_sigma"),
        (lambda: Imaging(blur_sigma_px=-0.1), "blur_sigma_px"),
        (lambda: Imaging(response_sigma=0.5), "response_sigma"),
        (lambda: Imaging(contrast=0.0), "contrast"),
    ],
)
def test_invalid_settings_are_refused_by_name(make: object, name: str) -> None:
    assert callable(make)
    with pytest.raises(ConfigError, match=name):
        make()
