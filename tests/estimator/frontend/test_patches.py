"""Patches that are found again in pictures that were bent, moved, dimmed and spoilt by a known amount."""

import cv2
import numpy as np
import pytest

from dronevio.estimator.frontend.corners import CornerConfig, new_corners
from dronevio.estimator.frontend.klt import as_bright_as, follow
from dronevio.estimator.frontend.patches import Fit, PatchAligner, PatchConfig, noise_of

CONFIG = PatchConfig()
LARGE = PatchConfig(side_px=17)  # has 1.7 times the pixels: less of what errs is chance
WIDTH, HEIGHT = 320, 240
ACROSS, DOWN = np.meshgrid(np.arange(30.0, WIDTH - 30.0, 20.0), np.arange(30.0, HEIGHT - 30.0, 20.0))
PLACES = np.stack([ACROSS.ravel(), DOWN.ravel()], axis=1)
MIDDLE = np.array([WIDTH, HEIGHT]) / 2.0


def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the grey levels of a smooth picture that is known everywhere, also between pixels."""
    rng = np.random.default_rng(3)
    waves = rng.uniform(-0.5, 0.5, (40, 2))
    phases = rng.uniform(0.0, 2.0 * np.pi, 40)
    return 120.0 + 9.0 * sum(np.sin(a * x + b * y + c) for (a, b), c in zip(waves, phases, strict=True))


def picture(
    bend: np.ndarray | None = None, shift: np.ndarray | None = None, noise: float = 0.0, seed: int = 0
) -> np.ndarray:
    """Return the picture, bent about its middle and shifted: what was at x is at `moved(x)`."""
    A = np.eye(2) if bend is None else bend
    d = np.zeros(2) if shift is None else shift
    u, v = np.meshgrid(np.arange(float(WIDTH)), np.arange(float(HEIGHT)))
    back = (np.stack([u, v], axis=-1) - MIDDLE - d) @ np.linalg.inv(A).T + MIDDLE
    grey = scene(back[..., 0], back[..., 1]) + noise * np.random.default_rng(seed).normal(size=u.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def moved(places: np.ndarray, bend: np.ndarray, shift: np.ndarray) -> np.ndarray:
    return (places - MIDDLE) @ bend.T + MIDDLE + shift


def found(
    first: np.ndarray, second: np.ndarray, start: np.ndarray, config: PatchConfig = CONFIG, times: int = 1
) -> Fit:
    """Cut patches out of one picture and find them in another; ``times`` as if in so many frames."""
    aligner = PatchAligner(config)
    patches, prepared = aligner.cut(aligner.prepare(first), PLACES), aligner.prepare(second)
    for _ in range(times):
        fit = aligner.align(prepared, patches, start)
        patches, start = fit.patches, fit.pixels
    return fit


def is_close(pixels: np.ndarray, there: np.ndarray, median_px: float = 0.02, most_px: float = 0.1) -> bool:
    """Whether patches are where they should be: half of them closely, and 19 of 20 nearly, as some hold little."""
    error = np.linalg.norm(pixels - there, axis=1)
    return bool(np.median(error) < median_px and np.quantile(error, 0.95) < most_px)


def test_a_patch_is_where_it_was_cut_out() -> None:
    fit = found(picture(), picture(), PLACES)
    np.testing.assert_allclose(fit.pixels, PLACES, atol=1e-6)
    np.testing.assert_allclose(fit.patches.bend, np.tile(np.eye(2), (len(PLACES), 1, 1)), atol=1e-6)
    np.testing.assert_allclose(fit.zncc, 1.0, atol=1e-6)
    assert fit.good.all()


@pytest.mark.parametrize("shift", [[0.5, 0.0], [0.25, -0.75], [-1.3, 1.1], [0.03, 0.0]])
def test_displacements_are_found_between_pixels(shift: list[float]) -> None:
    d = np.array(shift)
    fit = found(picture(), picture(shift=d), PLACES)
    assert fit.good.all() and is_close(fit.pixels, PLACES + d, median_px=0.03)


@pytest.mark.parametrize(
    "bend",
    [
        np.diag([1.1, 1.1]),
        np.diag([0.92, 1.05]),
        np.array([[np.cos(0.12), -np.sin(0.12)], [np.sin(0.12), np.cos(0.12)]]),
        np.array([[1.05, 0.08], [-0.02, 0.97]]),
    ],
    ids=["nearer", "foreshortened", "rolled", "askew"],
)
def test_bends_are_found(bend: np.ndarray) -> None:
    d = np.array([0.4, -0.2])
    there = moved(PLACES, bend, d)
    fit = found(picture(), picture(bend, d), there + 0.5, times=3)
    inside = np.all((there > 25.0) & (there < [WIDTH - 26.0, HEIGHT - 26.0]), axis=1)
    assert fit.good[inside].all()
    assert is_close(fit.pixels[inside], there[inside], median_px=0.03)
    assert np.abs(np.median(fit.patches.bend[inside], axis=0) - bend).max() < 0.01


def test_patches_roll_with_the_camera() -> None:
    aligner = PatchAligner(CONFIG)
    patches = aligner.cut(aligner.prepare(picture()), PLACES)
    for angle in (0.2, -1.3):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        R_cur_prev = np.eye(3)
        R_cur_prev[:2, :2] = turn
        rolled = patches.rolled(R_cur_prev)
        np.testing.assert_allclose(rolled.bend, np.tile(turn, (len(PLACES), 1, 1)), atol=1e-12)
        fit = aligner.align(aligner.prepare(picture(turn)), rolled, moved(PLACES, turn, np.zeros(2)) + 0.3)
        near = np.linalg.norm(PLACES - MIDDLE, axis=1) < 80.0
        assert fit.good[near].all() and is_close(fit.pixels[near], moved(PLACES, turn, np.zeros(2))[near])


def test_bends_stay_near_what_is_expected_where_little_tells_them() -> None:
    """One edge, and noise: along the edge nothing tells how the patch is bent."""
    step = np.clip((np.arange(WIDTH) - 160.0) * 20.0 + 120.0, 80, 160)

    def edge(seed: int) -> np.ndarray:
        grey = step + np.random.default_rng(seed).normal(0.0, 3.0, (HEIGHT, WIDTH))
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)

    aligner = PatchAligner(CONFIG)
    places = np.stack([np.full(20, 160.0), np.linspace(30.0, 210.0, 20)], axis=1)
    fit = aligner.align(aligner.prepare(edge(1)), aligner.cut(aligner.prepare(edge(0)), places), places)
    assert np.abs(fit.patches.bend - np.eye(2)).max() < 0.1


@pytest.mark.parametrize(("config", "median_px"), [(LARGE, 0.1), (CONFIG, 0.12)])
def test_much_nearer_is_found_step_by_step(config: PatchConfig, median_px: float) -> None:
    """Twice as near, by small steps; there the comparison is with a more blurred image."""
    aligner = PatchAligner(config)
    patches, pixels = aligner.cut(aligner.prepare(picture()), PLACES), PLACES
    kept = np.arange(len(PLACES))
    for zoom in np.linspace(1.05, 2.0, 20):
        bend = zoom * np.eye(2)
        start = moved(PLACES[kept], bend, np.zeros(2)) + 0.3
        inside = np.all((start > 30.0) & (start < [WIDTH - 31.0, HEIGHT - 31.0]), axis=1)
        kept, patches, start = kept[inside], patches[inside], start[inside]
        fit = aligner.align(aligner.prepare(picture(bend)), patches, start)
        assert fit.good.all()
        patches, pixels = fit.patches, fit.pixels
    assert len(kept) > 8
    assert is_close(pixels, moved(PLACES[kept], 2.0 * np.eye(2), np.zeros(2)), median_px, most_px=0.25)


@pytest.mark.parametrize(("gain", "offset"), [(0.5, 0.0), (0.8, 40.0), (1.2, -30.0)])
def test_brightness_and_contrast_do_not_matter(gain: float, offset: float) -> None:
    d = np.array([0.3, 0.6])
    dimmed = np.clip(np.rint(gain * picture(shift=d).astype(float) + offset), 0, 255).astype(np.uint8)
    large = found(picture(), dimmed, PLACES, LARGE)
    assert large.good.all() and is_close(large.pixels, PLACES + d, median_px=0.03)
    fit = found(picture(), dimmed, PLACES)
    rounding = max(1.0, 1.0 / gain)  # to whole grey levels, which are fewer where contrast is less
    assert fit.good.all() and is_close(fit.pixels, PLACES + d, 0.022 * rounding, 0.1 * rounding)


def test_noise_costs_a_little_and_no_trust() -> None:
    d = np.array([0.4, -0.6])
    fit = found(picture(noise=3.0), picture(shift=d, noise=3.0, seed=1), PLACES)
    error = np.linalg.norm(fit.pixels - PLACES - d, axis=1)
    assert fit.good.mean() > 0.98 and np.median(error) < 0.1


def test_what_is_half_hidden_is_not_believed() -> None:
    hidden = picture(shift=np.array([0.3, 0.2]))
    hidden[:, 100:140] = np.random.default_rng(0).integers(40, 200, (HEIGHT, 40)).astype(np.uint8)
    fit = found(picture(), hidden, PLACES)
    behind = (PLACES[:, 0] > 96) & (PLACES[:, 0] < 144)
    assert not fit.good[behind].any()
    assert fit.good[(PLACES[:, 0] < 85) | (PLACES[:, 0] > 155)].all()


def test_nothing_and_nowhere_are_no_reason_to_fail() -> None:
    aligner = PatchAligner(CONFIG)
    blank = aligner.prepare(np.zeros((HEIGHT, WIDTH), np.uint8))
    none = aligner.cut(blank, np.zeros((0, 2)))
    assert len(none) == 0 and len(aligner.align(blank, none, np.zeros((0, 2))).good) == 0
    patches = aligner.cut(aligner.prepare(picture()), PLACES)
    for start in (PLACES, np.full_like(PLACES, 1e9), np.full_like(PLACES, -1e9)):
        assert not aligner.align(blank, patches, start).good.any()
    faceless = aligner.cut(blank, PLACES)
    assert np.all(np.isfinite(aligner.align(aligner.prepare(picture()), faceless, PLACES).pixels))


@pytest.mark.parametrize("sigma", [1.0, 3.0, 8.0, 15.0])
def test_noise_is_measured(sigma: float) -> None:
    rng = np.random.default_rng(0)
    grey = np.clip(np.rint(rng.normal(128.0, sigma, (480, 640))), 0, 255).astype(np.uint8)
    assert noise_of(grey) == pytest.approx(sigma, rel=0.15, abs=0.3)


def squares(seed: int = 0) -> np.ndarray:
    """Bright squares on grey, with corners at whole pixels."""
    rng = np.random.default_rng(seed)
    grey = np.full((HEIGHT, WIDTH), 90, np.uint8)
    for x, y in rng.integers(20, [WIDTH - 40, HEIGHT - 40], (25, 2)).tolist():
        grey[y : y + 14, x : x + 14] = 190
    return cv2.GaussianBlur(grey, (0, 0), 0.8)


def test_corners_are_those_of_the_whole_image() -> None:
    grey = squares()
    corners = new_corners(grey, 0.0, np.zeros((0, 2)), 12, CornerConfig())
    assert len(corners) > 10 and np.array_equal(corners, np.rint(corners))
    score = cv2.cornerMinEigenVal(grey, blockSize=5, ksize=3)
    for u, v in corners.astype(int).tolist():
        assert score[v, u] > 0.6 * score[v - 3 : v + 4, u - 3 : u + 4].max()


def test_corners_keep_their_distance_from_features() -> None:
    grey, config = squares(), CornerConfig()
    first = new_corners(grey, 0.0, np.zeros((0, 2)), 12, config)
    taken = first[::2]
    second = new_corners(grey, 0.0, taken, 12, config)
    away = np.linalg.norm(second[:, None] - taken[None], axis=2)
    assert len(second) > 3 and away.min() > config.spacing_px - 5


@pytest.mark.parametrize("sigma", [2.0, 6.0, 12.0, 25.0])
def test_noise_has_no_corners(sigma: float) -> None:
    rng = np.random.default_rng(1)
    grey = np.clip(np.rint(rng.normal(128.0, sigma, (480, 752))), 0, 255).astype(np.uint8)
    assert len(new_corners(grey, noise_of(grey), np.zeros((0, 2)), 12, CornerConfig())) <= 2


def test_flow_of_known_shifts() -> None:
    d = np.array([4.3, -2.6])
    pixels, there = follow(picture(), picture(shift=d), PLACES, PLACES, 15, 2)
    assert there.all() and np.median(np.abs(pixels - PLACES - d)) < 0.03


def test_brightness_is_made_alike_only_where_it_differs() -> None:
    one = picture()
    assert as_bright_as(picture(shift=np.array([1.0, 2.0])), one) is one
    assert as_bright_as(np.zeros_like(one), one) is one  # nothing to be alike
    dim = np.rint(0.5 * one).astype(np.uint8)
    assert np.abs(as_bright_as(dim, one).astype(float) - dim).mean() < 1.0
