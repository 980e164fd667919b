"""The rate of images is measured where the drone can fly, in all directions."""

import numpy as np

from dronevio.sim.speed.image_rate import ImageRate, image_figures, image_rates
from dronevio.sim.speed.image_rate import _camera_poses as camera_poses


def test_image_rates_are_measured_by_world_and_kind() -> None:
    done: list[tuple[int, int]] = []
    rates = image_rates(("low-texture",), ("grey", "depth"), 4, 1, progress=lambda *state: done.append(state))
    assert done == [(0, 2), (1, 2), (2, 2)]
    assert [(rate.world, rate.kind) for rate in rates] == [("low-texture", "grey"), ("low-texture", "depth")]
    assert all(10.0 < rate.per_cpu_s < 1e5 for rate in rates)
    (large,) = image_rates(("low-texture",), ("flow",), 2, 1, size=(320, 240))
    assert (large.width, large.height) == (320, 240) and large.per_cpu_s < rates[0].per_cpu_s


def test_figures_have_the_bound_of_the_first_world() -> None:
    rates = [
        ImageRate("room", "grey", 64, 64, 700.4, 1.0),
        ImageRate("hall", "grey", 64, 64, 500.0, 1.0),
        ImageRate("room", "depth", 64, 64, 599.0, 1.0),
        ImageRate("hall", "depth", 64, 64, 450.6, 1.0),
    ]
    grey, depth = image_figures(rates)
    assert (grey.value, grey.met, depth.met) == (700.4, True, False)
    assert grey.name == "grey images of 64 × 64 px, room"
    assert grey.method.endswith("other worlds: hall 500") and depth.method.endswith("hall 451")


def test_poses_are_spread_over_route_and_directions() -> None:
    route = np.array([[0.0, 0.0, 1.0], [4.0, 0.0, 1.0], [4.0, 4.0, 2.0]])
    T = camera_poses(route, 60)
    np.testing.assert_allclose(T[20, :3, 3], route[1], atol=1e-9)
    np.testing.assert_allclose(T[50, :3, 3], [2.0, 2.0, 1.5], atol=1e-9)  # halfway back to the start
    ahead = T[:, :3, 2]
    np.testing.assert_allclose(ahead[:, 2], 0.0, atol=1e-12)  # level
    headings = np.sort(np.arctan2(ahead[:, 1], ahead[:, 0]))
    assert np.diff(headings).max() < np.radians(15.0)
