"""Patch alignment and Lucas-Kanade tracking on analytic images with a known warp, brightness and noise."""

import numpy as np
import pytest

from dronevio.estimator.frontend import klt, patches
from dronevio.estimator.frontend.patches import PatchAligner, PatchAlignment, PatchConfig, noise_sigma
from dronevio.models.arrays import Array, Image

CONFIG = PatchConfig()
LARGE = PatchConfig(side_px=17)  # 1.7 times the pixels, and therefore smaller random errors
WIDTH, HEIGHT = 320, 240
U, V = np.meshgrid(np.arange(30.0, WIDTH - 30.0, 20.0), np.arange(30.0, HEIGHT - 30.0, 20.0))
POINTS = np.stack([U.ravel(), V.ravel()], axis=1)
CENTRE = np.array([WIDTH, HEIGHT]) / 2.0


def scene(x: Array, y: Array) -> Array:
    """Return the grey levels of a smooth function that is defined everywhere, also between pixels."""
    rng = np.random.default_rng(3)
    waves = rng.uniform(-0.5, 0.5, (40, 2))
    phases = rng.uniform(0.0, 2.0 * np.pi, 40)
    return np.asarray(120.0 + 9.0 * sum(np.sin(a * x + b * y + c) for (a, b), c in zip(waves, phases, strict=True)))


def picture(warp: Array | None = None, shift: Array | None = None, noise: float = 0.0, seed: int = 0) -> Image:
    """Return an image of the scene, warped about its centre and shifted: the point x moves to `warped(x)`."""
    A = np.eye(2) if warp is None else warp
    d = np.zeros(2) if shift is None else shift
    u, v = np.meshgrid(np.arange(float(WIDTH)), np.arange(float(HEIGHT)))
    source = (np.stack([u, v], axis=-1) - CENTRE - d) @ np.linalg.inv(A).T + CENTRE
    grey = scene(source[..., 0], source[..., 1]) + noise * np.random.default_rng(seed).normal(size=u.shape)
    return np.asarray(np.clip(np.rint(grey), 0, 255), np.uint8)


def warped(points: Array, warp: Array, shift: Array) -> Array:
    return (points - CENTRE) @ warp.T + CENTRE + shift


def aligned(first: Image, second: Image, start: Array, config: PatchConfig = CONFIG, frames: int = 1) -> PatchAlignment:
    """Extract patches from one image and align them with another, repeatedly as if in several frames."""
    aligner = PatchAligner(config)
    extracted, target = aligner.extract(aligner.scale_space(first), POINTS), aligner.scale_space(second)
    for _ in range(frames):
        result = aligner.align(target, extracted, start)
        extracted, start = result.patches, result.pixels
    return result


def is_close(pixels: Array, expected: Array, median_px: float = 0.02, quantile_px: float = 0.1) -> bool:
    """Return whether the median and the 95 % quantile of the errors are small; some patches have little texture."""
    error = np.linalg.norm(pixels - expected, axis=1)
    return bool(np.median(error) < median_px and np.quantile(error, 0.95) < quantile_px)


def test_identical_images_leave_patches_in_place() -> None:
    result = aligned(picture(), picture(), POINTS)
    np.testing.assert_allclose(result.pixels, POINTS, atol=1e-6)
    np.testing.assert_allclose(result.patches.warp, np.tile(np.eye(2), (len(POINTS), 1, 1)), atol=1e-6)
    np.testing.assert_allclose(result.zncc, 1.0, atol=1e-6)
    assert result.valid.all()


@pytest.mark.parametrize("shift", [[0.5, 0.0], [0.25, -0.75], [-1.3, 1.1], [0.03, 0.0]])
def test_subpixel_displacements_are_recovered(shift: list[float]) -> None:
    d = np.array(shift)
    result = aligned(picture(), picture(shift=d), POINTS)
    assert result.valid.all() and is_close(result.pixels, POINTS + d, median_px=0.03)


@pytest.mark.parametrize(
    "warp",
    [
        np.diag([1.1, 1.1]),
        np.diag([0.92, 1.05]),
        np.array([[np.cos(0.12), -np.sin(0.12)], [np.sin(0.12), np.cos(0.12)]]),
        np.array([[1.05, 0.08], [-0.02, 0.97]]),
    ],
    ids=["scaled", "foreshortened", "rotated", "sheared"],
)
def test_affine_warps_are_recovered(warp: Array) -> None:
    d = np.array([0.4, -0.2])
    expected = warped(POINTS, warp, d)
    result = aligned(picture(), picture(warp, d), expected + 0.5, frames=3)
    inside = np.all((expected > 25.0) & (expected < [WIDTH - 26.0, HEIGHT - 26.0]), axis=1)
    assert result.valid[inside].all()
    assert is_close(result.pixels[inside], expected[inside], median_px=0.03)
    assert np.abs(np.median(result.patches.warp[inside], axis=0) - warp).max() < 0.01


def test_patches_that_have_settled_leave_the_alignment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most do after the first round; each is near the position after all iterations, the others exactly there."""
    d, warp = np.array([0.4, -0.2]), np.array([[1.05, 0.08], [-0.02, 0.97]])
    images, start = (picture(), picture(warp, d)), warped(POINTS, warp, d) + 0.3
    leaving = aligned(*images, start)
    monkeypatch.setattr(patches, "SETTLED_PX", 0.0)
    staying = aligned(*images, start)
    step_px = np.linalg.norm(leaving.pixels - staying.pixels, axis=1)
    assert np.quantile(step_px, 0.95) < 0.02
    monkeypatch.setattr(patches, "SETTLED_PX", np.inf)
    has_left = np.all(aligned(*images, start).pixels == leaving.pixels, axis=1)
    assert 0.3 * len(POINTS) < has_left.sum() < len(POINTS)
    np.testing.assert_array_equal(step_px[~has_left], 0.0)


def test_camera_roll_rotates_the_warp() -> None:
    aligner = PatchAligner(CONFIG)
    patches = aligner.extract(aligner.scale_space(picture()), POINTS)
    for angle in (0.2, -1.3):
        rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        R_cur_prev = np.eye(3)
        R_cur_prev[:2, :2] = rotation
        rolled = patches.rolled(R_cur_prev)
        np.testing.assert_allclose(rolled.warp, np.tile(rotation, (len(POINTS), 1, 1)), atol=1e-12)
        expected = warped(POINTS, rotation, np.zeros(2))
        result = aligner.align(aligner.scale_space(picture(rotation)), rolled, expected + 0.3)
        near = np.linalg.norm(POINTS - CENTRE, axis=1) < 80.0
        assert result.valid[near].all() and is_close(result.pixels[near], expected[near])


def test_prior_limits_the_warp_along_an_edge() -> None:
    """A single edge with noise does not determine the warp along it."""
    step = np.clip((np.arange(WIDTH) - 160.0) * 20.0 + 120.0, 80, 160)

    def edge(seed: int) -> Image:
        grey = step + np.random.default_rng(seed).normal(0.0, 3.0, (HEIGHT, WIDTH))
        return np.asarray(np.clip(np.rint(grey), 0, 255), np.uint8)

    aligner = PatchAligner(CONFIG)
    points = np.stack([np.full(20, 160.0), np.linspace(30.0, 210.0, 20)], axis=1)
    patches = aligner.extract(aligner.scale_space(edge(0)), points)
    result = aligner.align(aligner.scale_space(edge(1)), patches, points)
    assert np.abs(result.patches.warp - np.eye(2)).max() < 2.0 * CONFIG.warp_sigma


def test_the_warp_may_change_more_within_a_longer_time() -> None:
    """The prior is a random walk: within a short time, the warp stays near the predicted one."""
    aligner, weak = PatchAligner(CONFIG), PatchAligner(PatchConfig(warp_sigma=2.0 * CONFIG.warp_sigma))
    target = aligner.scale_space(picture(1.06 * np.eye(2)))
    start = warped(POINTS, 1.06 * np.eye(2), np.zeros(2))
    scales = [
        np.median(
            each.align(target, each.extract(each.scale_space(picture()), POINTS), start, 1, elapsed_s).patches.scale
        )
        for each, elapsed_s in ((aligner, 0.005), (aligner, 0.05), (aligner, 0.2), (weak, 0.05))
    ]
    assert 1.0 < scales[0] < scales[1] < scales[2] < 1.07
    assert scales[2] == pytest.approx(scales[3], rel=1e-6)  # twice the standard deviation after four times the time


@pytest.mark.parametrize(("config", "median_px"), [(LARGE, 0.1), (CONFIG, 0.12)])
def test_patches_are_aligned_up_to_twice_their_size(config: PatchConfig, median_px: float) -> None:
    """The scale grows in small steps; from 1.3 on, the copy of the image with more blur is compared."""
    aligner = PatchAligner(config)
    patches, pixels = aligner.extract(aligner.scale_space(picture()), POINTS), POINTS
    kept = np.arange(len(POINTS))
    for scale in np.linspace(1.05, 2.0, 20):
        warp = scale * np.eye(2)
        start = warped(POINTS[kept], warp, np.zeros(2)) + 0.3
        inside = np.all((start > 30.0) & (start < [WIDTH - 31.0, HEIGHT - 31.0]), axis=1)
        kept, patches, start = kept[inside], patches[inside], start[inside]
        result = aligner.align(aligner.scale_space(picture(warp)), patches, start)
        assert result.valid.all()
        patches, pixels = result.patches, result.pixels
    assert len(kept) > 8
    assert is_close(pixels, warped(POINTS[kept], 2.0 * np.eye(2), np.zeros(2)), median_px, quantile_px=0.25)


@pytest.mark.parametrize(("gain", "offset"), [(0.5, 0.0), (0.8, 40.0), (1.2, -30.0)])
def test_alignment_is_invariant_to_gain_and_offset(gain: float, offset: float) -> None:
    d = np.array([0.3, 0.6])
    changed = np.clip(np.rint(gain * picture(shift=d).astype(float) + offset), 0, 255).astype(np.uint8)
    large = aligned(picture(), changed, POINTS, LARGE)
    assert large.valid.all() and is_close(large.pixels, POINTS + d, median_px=0.03)
    result = aligned(picture(), changed, POINTS)
    rounding = max(1.0, 1.0 / gain)  # relative size of a grey level, which is larger where contrast is less
    assert result.valid.all() and is_close(result.pixels, POINTS + d, 0.022 * rounding, 0.1 * rounding)


def test_noise_adds_a_small_error_and_no_rejections() -> None:
    d = np.array([0.4, -0.6])
    result = aligned(picture(noise=3.0), picture(shift=d, noise=3.0, seed=1), POINTS)
    error = np.linalg.norm(result.pixels - POINTS - d, axis=1)
    assert result.valid.mean() > 0.98 and np.median(error) < 0.1


def test_partly_occluded_patches_are_rejected() -> None:
    image = picture(shift=np.array([0.3, 0.2]))
    image[:, 100:140] = np.random.default_rng(0).integers(40, 200, (HEIGHT, 40)).astype(np.uint8)
    result = aligned(picture(), image, POINTS)
    occluded = (POINTS[:, 0] > 96) & (POINTS[:, 0] < 144)
    assert not result.valid[occluded].any()
    assert result.valid[(POINTS[:, 0] < 85) | (POINTS[:, 0] > 155)].all()


@pytest.mark.parametrize(("noise", "by_chance"), [(0.0, 0.1), (20.0, 0.4)])
def test_patches_resemble_the_image_near_their_place_and_not_elsewhere(noise: float, by_chance: float) -> None:
    """A patch that is not aligned: displaced by half a pixel, brighter, and of less contrast."""
    aligner, d = PatchAligner(CONFIG), np.array([0.4, -0.3])
    patches = aligner.extract(aligner.scale_space(picture()), POINTS)
    image = np.asarray(np.clip(0.7 * picture(shift=d).astype(float) + 30.0, 0, 255), np.uint8)
    noisy = image + noise * np.random.default_rng(1).normal(size=image.shape)
    target = np.asarray(np.clip(noisy, 0, 255), np.uint8)
    near, elsewhere = (aligner.compare(target, noise_sigma(target), patches, POINTS + offset) for offset in (0.0, 9.0))
    assert near[1].mean() > 0.95 and elsewhere[1].mean() < by_chance
    assert (
        np.median(near[0]) > (0.75 if noise else 0.97) and np.abs(np.concatenate([near[0], elsewhere[0]])).max() <= 1.0
    )
    assert not any(map(len, aligner.compare(target, noise, patches[:0], POINTS[:0])))


def test_blank_images_and_points_outside_are_handled() -> None:
    aligner = PatchAligner(CONFIG)
    blank = aligner.scale_space(np.zeros((HEIGHT, WIDTH), np.uint8))
    none = aligner.extract(blank, np.zeros((0, 2)))
    assert len(none) == 0 and len(aligner.align(blank, none, np.zeros((0, 2))).valid) == 0
    patches = aligner.extract(aligner.scale_space(picture()), POINTS)
    for start in (POINTS, np.full_like(POINTS, 1e9), np.full_like(POINTS, -1e9)):
        assert not aligner.align(blank, patches, start).valid.any()
    uniform = aligner.extract(blank, POINTS)
    assert np.all(np.isfinite(aligner.align(aligner.scale_space(picture()), uniform, POINTS).pixels))


@pytest.mark.parametrize("sigma", [1.0, 3.0, 8.0, 15.0])
def test_image_noise_is_estimated(sigma: float) -> None:
    rng = np.random.default_rng(0)
    image = np.clip(np.rint(rng.normal(128.0, sigma, (480, 640))), 0, 255).astype(np.uint8)
    assert noise_sigma(image) == pytest.approx(sigma, rel=0.15, abs=0.3)


def test_klt_recovers_a_known_shift() -> None:
    d = np.array([4.3, -2.6])
    pixels, found = klt.track(picture(), picture(shift=d), POINTS, POINTS, 15, 2)
    assert found.all() and np.median(np.abs(pixels - POINTS - d)) < 0.03


def test_klt_does_not_depend_on_the_start() -> None:
    """A feature that would stay near its starting point would confirm a prediction that is wrong."""
    d, noisy = np.array([1.3, -0.6]), picture(noise=2.0)
    target, right = picture(shift=d, noise=2.0, seed=1), POINTS + d
    found = [klt.track(noisy, target, POINTS, right + e, 11, 3)[0] for e in ([0.4, 0.3], [-0.4, -0.3])]
    assert np.quantile(np.linalg.norm(found[0] - found[1], axis=1), 0.95) < 0.005


def test_brightness_is_matched_only_where_it_differs() -> None:
    source = picture()
    assert klt.match_brightness(source, picture(shift=np.array([1.0, 2.0]))) is source
    assert klt.match_brightness(source, np.zeros_like(source)) is source  # the target has no contrast
    dim = np.rint(0.5 * source).astype(np.uint8)
    assert np.abs(klt.match_brightness(source, dim).astype(float) - dim).mean() < 1.0
