"""The script that compares real and simulated images: epipolar residuals, corrections of poses, image properties."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3
from dronevio.sim.scenarios import scenario_named

Result = Any  # the class of conftest, which cannot be imported
FOCAL_PX = 458.0


@pytest.fixture(scope="module")
def tracks(script: Callable[[str], Any]) -> Any:
    return script("epipolar_tracks")


@pytest.fixture(scope="module")
def properties(script: Callable[[str], Any]) -> Any:
    return script("image_properties")


@pytest.fixture(scope="module")
def realism(script: Callable[[str], Any]) -> Any:
    return script("image_realism")


def poses_of(count: int) -> np.ndarray:
    """Return poses (F, 4, 4) of a camera that moves sidewards and turns, at 20 Hz."""
    t = 0.05 * np.arange(count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = exp_so3(0.3 * np.stack([np.sin(2.0 * t), np.cos(3.0 * t), np.sin(t)], axis=1))
    poses[:, :3, 3] = np.stack([0.6 * t, 0.3 * np.sin(2.0 * t), 0.2 * np.cos(t)], axis=1)
    return poses


def pairs_of(tracks: Any, poses: np.ndarray, noise_px: float = 0.0) -> Any:
    """Return pairs of views of random points, exact but for noise in the later views."""
    rng = np.random.default_rng(0)
    first, frame = np.array([(i, i + a) for i in range(len(poses)) for a in (2, 5, 10) if i + a < len(poses)]).T
    first, frame = np.repeat(first, 40), np.repeat(frame, 40)
    points = rng.uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 8.0], (len(first), 3))
    world = np.einsum("mij,mj->mi", poses[first, :3, :3], points) + poses[first, :3, 3]
    seen = np.einsum("mji,mj->mi", poses[frame, :3, :3], world - poses[frame, :3, 3])
    seen += noise_px / FOCAL_PX * seen[:, 2:] * rng.standard_normal(seen.shape)
    unit = [rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (points, seen)]
    return tracks.ViewPairs(first, frame, *unit)


def test_residual_is_the_distance_from_the_epipolar_line(tracks: Any) -> None:
    """After a motion along x, the epipolar line of the optical axis is the row of the principal point."""
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.1
    for offset_px, expected in (((0.0, 2.0), 2.0), ((7.0, 0.0), 0.0), ((-3.0, -1.5), -1.5)):
        ray = np.array([offset_px[0] / FOCAL_PX - 0.05, offset_px[1] / FOCAL_PX, 1.0])
        pair = tracks.ViewPairs(*(np.array([k]) for k in (0, 1)), np.array([[0.0, 0.0, 1.0]]), ray[None])
        pair = replace(pair, bearings=pair.bearings / np.linalg.norm(ray))
        assert abs(tracks.residuals_px(poses, pair, FOCAL_PX)[0]) == pytest.approx(abs(expected), rel=2e-3, abs=1e-9)
    poses[1, 0, 3] = 0.5 * tracks.MIN_BASELINE_M
    assert np.isnan(tracks.residuals_px(poses, pair, FOCAL_PX)[0])


def test_jacobian_equals_differences(tracks: Any) -> None:
    poses = poses_of(12)
    pairs = pairs_of(tracks, poses)  # exact, so that the length of the normal has no effect
    jacobian = tracks._jacobian(poses, pairs, FOCAL_PX).toarray()
    for column in (6, 8, 9, 11, 40):
        step = np.zeros(6 * len(poses))
        step[column] = 1e-6
        moved = [tracks._corrected(poses, sign * step.reshape(-1, 6)) for sign in (1.0, -1.0)]
        plus, minus = (tracks.residuals_px(Ts, pairs, FOCAL_PX) for Ts in moved)
        np.testing.assert_allclose(jacobian[:, column], (plus - minus) / 2e-6, atol=1e-3 * abs(jacobian).max())


def test_rows_of_a_rolling_shutter_have_poses_of_their_own(tracks: Any, realism: Any) -> None:
    """The residual of exact views is zero with the poses of their rows, and not with those of their frames."""
    rows, frames = 3, 4
    poses = poses_of(12)  # of three rows in each of four frames
    points = np.random.default_rng(0).uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 8.0], (20, 3))
    image_rows = [np.random.default_rng(k).integers(0, rows, 20) for k in range(frames)]
    observed = []
    for k, row in enumerate(image_rows):
        T = poses[rows * k + row]
        seen = np.einsum("nji,nj->ni", T[:, :3, :3], points - T[:, :3, 3])
        observed.append((np.arange(20), k, seen / np.linalg.norm(seen, axis=1, keepdims=True)))
    observed[3][2][5] = np.nan  # outside the lens, and left out
    table = realism.rolling_table_of(observed, [row.astype(float) for row in image_rows], rows)
    pairs = tracks.view_pairs(table, (2, 3))
    assert len(pairs.first) == 39 and set(pairs.ages) == {2, 3} and tracks.survival(table, 3) == 0.95
    assert np.abs(tracks.residuals_px(poses, pairs, FOCAL_PX)).max() < 1e-9
    assert np.array_equal(pairs[pairs.ages == 2].ages, np.full(20, 2)) and len(pairs.joined(pairs).ages) == 78
    of_frames = tracks.view_pairs(realism.table_of(observed), (2, 3))
    assert np.median(np.abs(tracks.residuals_px(poses[1::rows], of_frames, FOCAL_PX))) > 1.0


def test_corrections_recover_errors_of_the_poses(tracks: Any) -> None:
    poses = poses_of(60)
    pairs = pairs_of(tracks, poses, noise_px=0.1)
    rng = np.random.default_rng(1)
    drift = np.cumsum(rng.normal(size=(60, 6)) * tracks.STEP_SIGMA, axis=0)
    wrong = tracks._corrected(poses, drift)
    exact, given = (np.median(np.abs(tracks.residuals_px(Ts, pairs, FOCAL_PX))) for Ts in (poses, wrong))
    refined, corrections = tracks.refined_poses(wrong, pairs, FOCAL_PX)
    found = np.median(np.abs(tracks.residuals_px(refined, pairs, FOCAL_PX)))
    assert given > 2.0 * exact and found < 1.1 * exact
    assert corrections.shape == (60, 6)
    untouched, _ = tracks.refined_poses(poses, pairs, FOCAL_PX)
    assert np.median(np.abs(tracks.residuals_px(untouched, pairs, FOCAL_PX))) == pytest.approx(exact, rel=0.05)


def test_corrections_do_not_hide_outliers(tracks: Any) -> None:
    poses = poses_of(40)
    pairs = pairs_of(tracks, poses, noise_px=0.1)
    wrong = np.random.default_rng(2).random(len(pairs.first)) < 0.2
    pairs.bearings[wrong] += [0.0, 5.0 / FOCAL_PX, 0.0]
    refined, _ = tracks.refined_poses(poses, pairs, FOCAL_PX)
    residual = np.abs(tracks.residuals_px(refined, pairs, FOCAL_PX))
    assert np.median(residual[~wrong]) < 0.15
    assert np.mean(residual[wrong] > 1.0) > 0.9


def test_constant_rotation_is_found(tracks: Any) -> None:
    poses = poses_of(80)
    rotation = np.array([0.002, -0.003, 0.001])
    true = poses.copy()
    true[:, :3, :3] = poses[:, :3, :3] @ exp_so3(rotation)
    pairs = pairs_of(tracks, true[1:], noise_px=0.05)
    offset_s, found = tracks.constant_offsets(poses[1:], pairs, FOCAL_PX, 0.05)
    assert offset_s == pytest.approx(0.0, abs=1e-3)
    np.testing.assert_allclose(found, rotation, atol=4e-4)


def test_survival_counts_features_that_could_live_so_long(tracks: Any) -> None:
    """Feature 0 lives 6 frames, feature 1 two; feature 2 begins too late to count at an age of five."""
    ids = np.array([0] * 7 + [1] * 3 + [2] * 2)
    frame = np.array([*range(7), 0, 1, 2, 8, 9])
    table = tracks.TrackTable(ids, frame, np.tile([0.0, 0.0, 1.0], (len(ids), 1)), 10)
    assert [tracks.survival(table, age) for age in (1, 2, 5)] == [1.0, 1.0, 0.5]
    assert table.features_per_frame == 1.2
    pairs = tracks.view_pairs(table, (5,))
    assert pairs.first.tolist() == [0] and pairs.frame.tolist() == [5]


def shapes(blur_px: float, motion_px: float = 0.0, noise: float = 1.5, shift: float = 0.0) -> np.ndarray:
    """Return an image (H, W) of discs with a blur and a motion blur along x, drawn at four times the size."""
    rng = np.random.default_rng(0)
    large = np.full((4 * 480, 4 * 752), 90, np.uint8)
    for _ in range(60):
        x, y = rng.integers(0, [4 * 752, 4 * 480]).tolist()
        cv2.circle(large, (x + round(4 * shift), y), int(rng.integers(80, 240)), int(rng.integers(40, 200)), -1)
    light: Any = large.astype(np.float32)
    if blur_px:
        light = cv2.GaussianBlur(light, (0, 0), 4.0 * blur_px)
    if motion_px:
        light = cv2.blur(light, (round(4 * motion_px) | 1, 1))
    small = cv2.resize(light, (752, 480), interpolation=cv2.INTER_AREA)
    return np.asarray(np.clip(np.rint(small + rng.normal(0.0, noise, small.shape)), 0, 255), np.uint8)


@pytest.mark.parametrize("blur_px", [0.5, 0.8, 1.2])
def test_blur_of_edges_is_found(properties: Any, blur_px: float) -> None:
    _, _, variance = properties.edge_blurs(shapes(blur_px))
    expected = np.sqrt(blur_px**2 + 1.0 / 12.0)  # with the area of a pixel
    assert np.sqrt(np.median(variance)) == pytest.approx(expected, abs=0.12)


def test_exposure_is_found_by_motion_blur(properties: Any) -> None:
    """Edges that move by 0 to 12 px per frame at an exposure of 0.4 frames."""
    moving = [(shapes(0.6, 0.4 * u), shapes(0.6, 0.4 * u, shift=u)) for u in (1.0, 4.0, 7.0, 9.0, 11.0)]
    blur, exposure_s = properties.blur_and_exposure(moving, 0.05)
    assert 0.018 < exposure_s < 0.027  # a box is steeper than the Gaussian that the estimate assumes
    assert blur == pytest.approx(0.67, abs=0.25)
    sharp = [(shapes(0.6), shapes(0.6, shift=u)) for u in (1.0, 4.0, 7.0, 9.0, 11.0)]
    assert properties.blur_and_exposure(sharp, 0.05)[1] < 0.006


def test_noise_is_found_at_its_grey_level(properties: Any) -> None:
    ramp = np.repeat(np.linspace(5.0, 245.0, 752)[None], 480, axis=0)
    sigma = 1.0 + ramp / 200.0
    noisy = ramp + sigma * np.random.default_rng(0).standard_normal(ramp.shape)
    found = properties.noise_by_level([np.clip(np.rint(noisy), 0, 255).astype(np.uint8)])
    expected = [1.0 + level / 200.0 for level in properties.LEVELS]
    np.testing.assert_allclose(found[1:-1], expected[1:-1], rtol=0.15)


def test_spectrum_has_the_exponent_of_its_noise(properties: Any) -> None:
    """White noise has the exponent 0; its amplitude over the frequency, −2."""
    rng = np.random.default_rng(0)
    white = rng.normal(128.0, 20.0, (256, 256))
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(256), np.fft.fftfreq(256)))
    frequency[0, 0] = 1.0
    pink = np.real(np.fft.ifft2(np.fft.fft2(white - 128.0) / frequency))
    pink = 128.0 + 30.0 * pink / pink.std()
    for image, expected in ((white, 0.0), (pink, -2.0)):
        assert properties.spectral_slope([np.clip(np.rint(image), 0, 255).astype(np.uint8)]) == pytest.approx(
            expected, abs=0.15
        )


def test_fixed_pattern_is_separated_from_noise(properties: Any) -> None:
    rng = np.random.default_rng(0)
    pattern = 1.0 + 0.01 * rng.standard_normal((200, 300))
    images = [np.rint(120.0 * pattern + rng.normal(0.0, 2.0, pattern.shape)).astype(np.uint8) for _ in range(40)]
    assert properties.fixed_pattern(images) == pytest.approx(1.2, rel=0.05)
    free = [np.rint(120.0 + rng.normal(0.0, 2.0, pattern.shape)).astype(np.uint8) for _ in range(40)]
    assert properties.fixed_pattern(free) < 0.1


def test_change_of_brightness_is_found(properties: Any) -> None:
    image = shapes(0.6)
    darker = np.rint(0.9 * image.astype(float)).astype(np.uint8)
    common, own = properties.brightness_changes([image, darker, image, darker, image, darker], 1)
    np.testing.assert_allclose(np.abs(common), -np.log(0.9), atol=0.01)
    assert np.median(own) < 0.01


@pytest.mark.slow
def test_tables_of_a_simulated_flight(
    realism: Any, flown: Result, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """On exact poses, the front end's tracks are within a fraction of a pixel, and corrections hardly change them."""
    command = realism.RealismCommand((flown.folder,), frames=60, json=tmp_path / "figures.json")
    assert realism.main(command) == 0
    printed = capsys.readouterr().out
    assert "| front end | 1 |" in printed and "| OpenCV KLT | 1 |" in printed
    section = realism.section_of(flown.folder, 0, 60)
    figures = realism.measure(section, 4)
    young = figures.trackers[0].ages[1]
    assert young.pairs > 50 and young.true_median_px < 0.2 and young.median_px < 1.1 * young.true_median_px
    assert abs(figures.truth.time_offset_ms) < 1.0
    late = replace(section, truth=section.truth[2:], frames=section.frames[:-2])  # by two frames
    assert realism.measure(late, 4).trackers[0].ages[1].true_median_px > 2.0 * young.true_median_px


def test_conditions_change_images_as_they_say(script: Callable[[str], Any]) -> None:
    conditions = script("image_conditions").CONDITIONS
    image = np.tile(np.arange(50, 210, dtype=np.uint8), (480, 1))
    changed = {name: condition(image, 20, 1) for name, condition in conditions.items()}
    assert all(each.shape == image.shape and each.dtype == np.uint8 for each in changed.values())
    unchanged = {name for name, each in changed.items() if np.array_equal(each, image)}
    assert unchanged == {"none", "smudge"}  # the smudge is on the lens of the other camera
    assert not np.array_equal(conditions["smudge"](image, 20, 0), image)
    assert changed["exposure-steps"][0, 10] == 96  # 60 times 1.6 in the second step
    np.testing.assert_allclose(
        changed["vignetting"][[0, 0, -1, -1], [0, -1, 0, -1]], 0.3 * image[0, [0, -1, 0, -1]], atol=0.5
    )
    assert np.std(changed["noise"].astype(float) - image) == pytest.approx(8.0, rel=0.03)
    dead = changed["dead-pixels-0.1%"] != image
    assert np.mean(dead) == pytest.approx(1e-3, rel=0.5)
    assert set(np.unique(changed["dead-pixels-0.1%"][dead])) == {0, 255}
    np.testing.assert_array_equal(conditions["dead-pixels-0.1%"](image, 21, 1), changed["dead-pixels-0.1%"])


def test_rendered_conditions_keep_brightness_and_path(script: Callable[[str], Any]) -> None:
    conditions = script("rendered_conditions").CONDITIONS
    scenario = replace(scenario_named("room-medium", 3), rig=rig_named("euroc-stereo"))
    light = np.full((480, 752), 100.0, np.float32)
    for name, condition in conditions.items():
        changed = condition(scenario)
        imaging = changed.imaging
        time_s = imaging.control.longest_s
        image = imaging.digitize(light, 1.0, time_s, 1.0, np.random.default_rng(0))
        assert image[220:260, 356:396].mean() == pytest.approx(100.0, abs=0.5)
        assert image[220:260, 356:396].std() == pytest.approx(np.sqrt(1.2**2 + 2.2**2 * 100.0 / 255.0), rel=0.1)
        assert [camera.readout_s for camera in changed.rig.cameras] == [0.02 * (name == "rolling-20ms")] * 2
        if name.startswith("exposure"):
            assert time_s == 1e-3 * float(name.removeprefix("exposure-").removesuffix("ms"))
        assert (changed.seed, changed.plan, changed.world) == (3, scenario.plan, scenario.world)
