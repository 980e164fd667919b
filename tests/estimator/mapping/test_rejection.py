"""Rejection of matched depths, and what is around them."""

import numpy as np
import pytest

from dronevio.estimator.mapping import rejection
from dronevio.models.arrays import Floats, Mask


def cut(disparity: Floats) -> Mask:
    """Return where disparities are left out at edges."""
    return rejection.edges(disparity, disparity, rejection.slopes(disparity))


def test_edges_are_cut_on_both_sides_but_poles_stay() -> None:
    """Bands beside a jump are left out; a strip narrower than the bands is kept, and its background is not."""
    disparity = np.full((20, 60), 5.0, np.float32)
    disparity[:, 40:] = 10.0
    disparity[:, 15:18] = 10.0
    k = rejection.EDGE_PX
    assert np.flatnonzero(cut(disparity)[10]).tolist() == [
        *range(15 - k, 15),
        *range(18, 18 + k),
        *range(40 - k, 40 + k),
    ]


def test_a_slanted_surface_is_no_edge() -> None:
    """A near slanted surface is kept up to its edge, where it ends before a background."""
    u, v = np.meshgrid(np.arange(60.0, dtype=np.float32), np.arange(40.0, dtype=np.float32))
    surface = np.float32(20.0) + np.float32(0.2) * u + np.float32(0.3) * v
    assert not cut(surface)[3:-3, 3:-3].any()
    ended = np.where(u < 30.0, surface, np.float32(5.0)).astype(np.float32)
    k = rejection.EDGE_PX
    assert np.flatnonzero(cut(ended)[20]).tolist() == list(range(30 - k, 30 + k))


def marks(columns: tuple[int, int], disparities: tuple[float, float]) -> tuple[Floats, Floats]:
    """Return disparities (60, 80) of two marks on a wall without texture, and their information."""
    disparity, information = np.zeros((60, 80), np.float32), np.full((60, 80), 1e-3, np.float32)
    for column, value in zip(columns, disparities, strict=True):
        disparity[:, column - 2 : column + 3] = value  # as far as windows reach
        information[:, column] = 1.0
    return disparity, information


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("is_flipped", [False, True])
@pytest.mark.parametrize(
    ("columns", "disparities", "expected"),
    [
        ((30, 40), (8.0, 8.0), [28, 29, 41, 42]),
        ((30, 40), (8.0, 5.0), [28, 29, 31, 32, 38, 39, 41, 42]),
        ((30, 35 + rejection.BETWEEN_PX), (8.0, 8.0), [28, 29, 31, 32, 48, 49, 51, 52]),
    ],
    ids=["similar", "other surface", "too far"],
)
def test_disparities_are_borrowed_from_texture_beside_them(
    columns: tuple[int, int], disparities: tuple[float, float], expected: list[int], is_flipped: bool, axis: int
) -> None:
    """Beside a mark, a disparity needs support from the other side: by another mark at the same depth."""
    arrays = marks(columns, disparities)
    if is_flipped:
        arrays, expected = (arrays[0][:, ::-1], arrays[1][:, ::-1]), sorted(79 - k for k in expected)
    if axis == 0:
        arrays = arrays[0].T, arrays[1].T
    found = rejection.borrowed(np.ascontiguousarray(arrays[0]), np.ascontiguousarray(arrays[1]))
    line = found[:, 30] if axis == 0 else found[30]
    assert np.flatnonzero(line).tolist() == expected


def test_the_variance_grows_beside_an_edge() -> None:
    """It is the probability of the other surface times the squared jump within a distance, and 0 beyond."""
    disparity = np.full((40, 120), 5.0, np.float32)
    disparity[:, 60:] = 10.0
    variance = rejection.variance_around(disparity, disparity, rejection.slopes(disparity))[20]
    k = rejection.BESIDE_PX
    assert np.flatnonzero(variance).tolist() == list(range(60 - k, 60 + k))
    assert variance[60 - k : 60 + k] == pytest.approx(25.0 * rejection.OTHER_SURFACE)


def test_the_variance_grows_beside_a_gap() -> None:
    """What lies in a gap may be infinitely far; a hole that is smaller than `HOLE_PX` is no gap."""
    k, side = rejection.BESIDE_PX, rejection.AROUND_PX // 2
    for width, p in ((rejection.HOLE_PX - 1, 0.0), (20, rejection.OTHER_SURFACE)):
        disparity = np.full((60, 160), 5.0, np.float32)
        disparity[:, 80 : 80 + width] = 0.0
        variance = rejection.variance_around(disparity, disparity, rejection.slopes(disparity))[30]
        beside = variance[80 - k + 1 : 80 - side]
        assert beside == pytest.approx(25.0 * p)
        assert (variance[80 - side : 80] > beside[-1]).all()  # some around it were left out
        assert variance[: 80 - k] == pytest.approx(0.0)


def test_the_variance_grows_with_the_slope() -> None:
    """The disparity of a slanted surface is that of a place near the pixel."""
    u, _ = np.meshgrid(np.arange(120.0, dtype=np.float32), np.arange(80.0, dtype=np.float32))
    surface = np.float32(20.0) + np.float32(0.2) * u
    variance = rejection.variance_around(surface, surface, rejection.slopes(surface))
    assert variance[40, 60] == pytest.approx((0.2 * rejection.SLANT_PX) ** 2, rel=0.02)


def test_small_patches_are_speckles() -> None:
    """A patch that nothing supports is left out."""
    disparity = np.full((40, 40), 5.0, np.float32)
    disparity[10:14, 10:14] = 20.0
    disparity[30:, :] = 0.0
    expected = (disparity == 0.0) | (disparity == 20.0)
    assert np.array_equal(rejection.speckles(disparity), expected)
