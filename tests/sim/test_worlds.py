"""Worlds: clear routes and free boxes, layouts determined by the seed, and textured surfaces."""

import cv2
import mujoco
import numpy as np
import pytest

from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.rotation import pose_matrix
from dronevio.sim.appearance import textures_building, textures_storage
from dronevio.sim.appearance.scenery import add_mirror
from dronevio.sim.appearance.solids import Box, Face
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.paths.space import Space
from dronevio.sim.pictures.contact_sheet import contact_sheet, sheet_of_worlds, viewpoints, views
from dronevio.sim.pictures.texturedness import GOOD_CORNERS, GOOD_SHARE, good_corners, poses_along, texturedness
from dronevio.sim.props.traffic import Lap, Swing
from dronevio.sim.world import WORLDS, build_world, flight_area
from dronevio.sim.worlds.assembly import space_of
from dronevio.sim.worlds.layout import ROUTE_CLEARANCE_M, Layout

SMALL = CameraModel(width=120, height=76, fx=62.0, fy=62.0, cx=59.5, cy=37.5)
INDOORS = (
    *("corridor", "warehouse", "low-texture", "repetitive", "dark", "mirror", "moving"),
    *("office", "office-white", "office-glass"),
)
R_DOWN = np.diag([1.0, -1.0, -1.0])  # a camera that looks down, the top of its image towards +y


def layout_of(name: str, seed: int) -> Layout:
    """Return a world's layout."""
    return WORLDS[name].layout(np.random.default_rng(seed))


def points_along(route: Array, step_m: float = 0.05) -> Array:
    """Return points (N, 3) along the closed route (R, 3)."""
    legs = np.roll(route, -1, axis=0) - route
    count = int(np.linalg.norm(legs, axis=1).max() / step_m) + 1
    return np.asarray((route[:, None] + np.linspace(0.0, 1.0, count)[:, None] * legs[:, None]).reshape(-1, 3))


def unbounded_space(layout: Layout) -> Space:
    """Return the space of the obstacles, with distant bounds."""
    space = space_of(layout)
    return Space(layout.low - 100.0, layout.high + 100.0, space.centres, space.halves, space.rotations)


def corners(boxes: tuple[Box, ...]) -> Array:
    """Return the corners (K, 8, 3) of boxes."""
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return np.stack([box.centre + signs * box.half @ box.R.T for box in boxes])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", INDOORS)
def test_the_route_is_clear_and_spans_the_world(name: str, seed: int) -> None:
    layout = layout_of(name, seed)
    assert space_of(layout).clearance(points_along(layout.route)).min() >= ROUTE_CLEARANCE_M
    np.testing.assert_allclose(layout.route[0, :2], layout.pad[:2])
    extent = np.ptp(layout.route[:, :2], axis=0) / (layout.high - layout.low)[:2]
    assert (extent > 0.28).all()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", INDOORS)
def test_the_free_box_is_free_above_the_pad(name: str, seed: int) -> None:
    layout = layout_of(name, seed)
    low, high = layout.free_box
    axes = [np.linspace(a, b, max(int((b - a) / 0.25), 2)) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1)
    assert unbounded_space(layout).clearance(grid).min() > 0.0
    np.testing.assert_allclose(0.5 * (low + high)[:2], layout.pad[:2], atol=1e-9)


@pytest.mark.parametrize("name", INDOORS)
def test_visible_boxes_have_collision_boxes(name: str) -> None:
    layout = layout_of(name, 1)
    points = corners(layout.boxes).reshape(-1, 3)
    to_bounds = np.minimum(points - layout.low, layout.high - points).min(axis=1)
    assert to_bounds.min() > -0.05
    exposed = points[to_bounds > 0.12]  # objects flat on a wall or ceiling are part of it
    if name == "dark":  # lamps and beams are above the flight area
        exposed = exposed[exposed[:, 2] < 2.4]
    assert unbounded_space(layout).clearance(exposed).max(initial=0.0) < 0.08


@pytest.mark.parametrize("name", INDOORS)
def test_layouts_are_determined_by_the_seed(name: str) -> None:
    def places(seed: int) -> Array:
        return corners(layout_of(name, seed).boxes)

    first, again, other = places(3), places(3), places(4)
    np.testing.assert_array_equal(first, again)
    if name != "repetitive":  # the layout of the station is fixed
        assert first.shape != other.shape or not np.allclose(first, other)


def test_flight_area_agrees_with_the_world() -> None:
    world, place = build_world("repetitive", 2), flight_area("repetitive", 2)
    np.testing.assert_array_equal(place.route, world.route)
    np.testing.assert_array_equal(place.space.centres, world.space.centres)
    np.testing.assert_array_equal(place.free_box, world.free_box)


@pytest.mark.parametrize("name", [name for name, kind in WORLDS.items() if kind.difficulty == "normal"])
@pytest.mark.slow
def test_normal_worlds_have_many_corners(name: str) -> None:
    found = texturedness(build_world(name, 0), frames=12)
    assert found.share_good >= GOOD_SHARE
    assert found.levels.min() > 50.0
    assert found.levels.max() < 200.0


def test_the_low_texture_world_has_few_corners() -> None:
    found = texturedness(build_world("low-texture", 0), frames=12)
    assert found.corners.max() < GOOD_CORNERS
    assert np.median(found.corners) < 0.5 * GOOD_CORNERS


def test_corners_of_rectangles_are_counted() -> None:
    image = np.full((480, 752), 60, np.uint8)
    assert good_corners(image) == 0
    for x in range(40, 700, 80):
        cv2.rectangle(image, (x, 100), (x + 40, 140), 200, -1)
    assert good_corners(image) == 4 * len(range(40, 700, 80))
    noise = np.random.default_rng(0).normal(60.0, 1.2, image.shape)  # sensor noise yields no corners
    assert good_corners(noise.astype(np.uint8)) == 0


def test_cameras_look_along_the_route() -> None:
    route = np.array([[0.0, 0.0, 1.0], [4.0, 0.0, 1.0], [4.0, 4.0, 1.0], [0.0, 4.0, 1.0]])
    poses = poses_along(route, 4)
    np.testing.assert_allclose(poses[:, :3, 3], [[2, 0, 1], [4, 2, 1], [2, 4, 1], [0, 2, 1]])
    np.testing.assert_allclose(poses[:, :3, 2], [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], atol=1e-12)
    np.testing.assert_allclose(poses[:, 2, 1], -1.0)


def test_tiles_are_exactly_periodic() -> None:
    image = textures_building.tiles(np.random.default_rng(0), 300, 500, (200.0, 200.0, 190.0), 160.0, tile_m=0.2)
    np.testing.assert_array_equal(image[32:], image[:-32])
    np.testing.assert_array_equal(image[:, 32:], image[:, :-32])
    assert image.std() > 5.0


def test_the_dark_world_is_the_room_with_less_light() -> None:
    dark, lit = layout_of("dark", 0), layout_of("room", 0)
    assert 0.02 <= dark.illumination <= 0.03
    assert [box.centre.tolist() for box in dark.boxes] == [box.centre.tolist() for box in lit.boxes]
    assert 0 < len(dark.lights) < len(lit.lights)
    assert sum(box.glow > 0.0 for box in dark.boxes) == len(dark.lights)


def test_a_mirror_keeps_its_texture_and_shows_reflections() -> None:
    def nothing(rng: np.random.Generator, height: int, width: int) -> Image:
        return np.zeros((height, width, 3), np.uint8)

    pattern = np.zeros((60, 80, 3), np.uint8)
    pattern[:30, :40] = (200, 0, 0)  # largest y, smallest x
    pattern[30:, 40:] = (0, 200, 0)

    def render_mirror(reflectance: float) -> Image:
        spec = mujoco.MjSpec()
        spec.stat.extent, spec.visual.map.znear, spec.visual.map.zfar = 10.0, 0.003, 3.0
        face = Face(np.array([-4.0, 3.0, 0.0]), np.array([8.0, 0.0, 0.0]), np.array([0.0, -6.0, 0.0]), nothing)
        add_mirror(spec, face, pattern, reflectance)
        glow = spec.add_material(name="glow", rgba=[1.0, 1.0, 1.0, 1.0], emission=1.0)
        size, above = [0.6, 0.6, 0.1], [2.0, 1.5, 4.0]
        box = mujoco.mjtGeom.mjGEOM_BOX
        spec.worldbody.add_geom(type=box, size=size, pos=above, material=glow.name, contype=0, conaffinity=0)
        with OffscreenCamera(spec.compile(), SMALL) as offscreen:
            return offscreen.render_rgb(pose_matrix(R_DOWN, np.array([0.0, 0.0, 3.0])))

    plain, polished = render_mirror(0.0), render_mirror(0.5)
    left, right, up, low = 25, 95, 10, 65
    assert plain[up, left, 0] > 150 > 30 > plain[up, left, 1]
    assert plain[low, right, 1] > 150 > 30 > plain[low, right, 0]
    assert plain[low, left].max() < 30
    # The box is above the camera, outside its image; its mirror image is at a depth of 7 m, so 1 m is 62 / 7 px.
    at = (round(37.5 - 62.0 * 1.5 / 7.0), round(59.5 + 62.0 * 2.0 / 7.0))
    assert plain[at].max() < 30
    assert polished[at].min() > 60


def test_the_mirror_world_has_a_reflective_floor() -> None:
    model = build_world("mirror", 0).spec.compile()
    assert model.mat_reflectance[model.geom_matid[model.geom("mirror").id]] > 0.3
    assert model.geom_contype[model.geom("mirror").id] == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_moving_objects_stay_in_lanes_and_off_the_route(seed: int) -> None:
    layout = layout_of("moving", seed)
    times = np.linspace(0.0, 60.0, 241)
    lanes = Space(layout.low - 100.0, layout.high + 100.0, *_parts(layout.lanes))
    route = points_along(layout.route, 0.2)
    assert len(layout.moving) >= 12
    for mover in layout.moving:
        Ts = mover.poses(times)
        vertices = corners(mover.boxes).reshape(-1, 3)
        points = np.einsum("mij,kj->mki", Ts[:, :3, :3], vertices) + Ts[:, None, :3, 3]
        assert lanes.clearance(points).max() < 1e-9 or mover.name.startswith("banner")
        gap = np.linalg.norm(points[::8, :, None] - route, axis=-1).min()
        assert gap >= ROUTE_CLEARANCE_M
        below_knots = points[points[..., 2] < 4.3]  # the knots at the top of a banner's ropes may extend beyond
        assert lanes.clearance(below_knots).max() < 0.05


def _parts(boxes: tuple[Box, ...]) -> tuple[Array, Array, Array]:
    """Return the centres, halves and rotations of boxes."""
    return (
        np.array([box.centre for box in boxes]),
        np.array([box.half for box in boxes]),
        np.array([box.R for box in boxes]),
    )


@pytest.mark.slow
def test_moving_objects_fill_a_large_part_of_the_images() -> None:
    world = build_world("moving", 0)
    removed = {mover.body: pose_matrix(np.eye(3), np.array([0.0, 0.0, -40.0])) for mover in world.movers}
    shares = []
    with OffscreenCamera(world.spec.compile(), SMALL) as offscreen:
        for k, T in enumerate(poses_along(world.route, 12)):
            present = {mover.body: mover.poses(np.array([5.0 * k]))[0] for mover in world.movers}
            full, empty = offscreen.render(T, present), offscreen.render(T, removed)
            shares.append(float(np.mean(np.abs(full.astype(int) - empty) > 4)))
    assert np.mean(shares) > 0.1
    assert max(shares) > 0.2


def test_laps_have_a_constant_speed() -> None:
    lap = Lap((4.0, 3.0), 0.9, 0.1, 1.2)
    times = np.linspace(0.0, 2.0 * lap.length_m / 1.2, 4001)
    Ts = lap(times)
    velocity = np.diff(Ts[:, :3, 3], axis=0) / np.diff(times)[:, None]
    np.testing.assert_allclose(np.linalg.norm(velocity, axis=1), 1.2, rtol=1e-3)
    np.testing.assert_allclose(Ts[0], Ts[2000], atol=1e-9)
    np.testing.assert_allclose(Ts[:, :2, 3].max(axis=0), [4.0, 3.0], atol=1e-3)
    ahead = 0.5 * (Ts[1:, :3, 1] + Ts[:-1, :3, 1])
    assert np.einsum("ij,ij->i", velocity, ahead).min() > 1.19  # y is the direction of motion
    around = Ts[:-1, 0, 3] * velocity[:, 1] - Ts[:-1, 1, 3] * velocity[:, 0]
    assert around.min() > 0.0  # anticlockwise
    back = Lap((4.0, 3.0), 0.9, 0.1, -1.2)(times)
    np.testing.assert_allclose(back[:, :3, 3], lap(-times)[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(back[:, :3, :3]), 1.0)


def test_swings_rotate_about_their_pivot() -> None:
    swing = Swing((1.0, 2.0, 4.0), 0.5 * np.pi, 0.3, 3.0)
    Ts = swing(np.linspace(0.0, 3.0, 61))
    np.testing.assert_allclose(Ts[:, :3, 3], np.tile([1.0, 2.0, 4.0], (61, 1)))
    tip = Ts @ np.array([0.0, 0.0, -2.0, 1.0])
    np.testing.assert_allclose(tip[:, 1], 2.0, atol=1e-12)  # it swings across its axis, which points along y
    np.testing.assert_allclose(np.abs(tip[:, 0] - 1.0).max(), 2.0 * np.sin(0.3), rtol=1e-3)
    np.testing.assert_allclose(Ts[0], Ts[-1], atol=1e-9)


def test_a_contact_sheet_shows_twelve_views() -> None:
    world = build_world("repetitive", 0)
    sheet = contact_sheet(views(world, 12, SMALL))
    assert sheet.shape == (3 * 76, 4 * 120, 3)
    parts = [sheet[76 * i : 76 * (i + 1), 120 * k : 120 * (k + 1)].tobytes() for i in range(3) for k in range(4)]
    assert len(set(parts)) == 12
    poses = viewpoints(world.route, 30)
    assert world.space.clearance(poses[:, :3, 3]).min() >= ROUTE_CLEARANCE_M


def test_a_sheet_of_worlds_has_a_block_for_each() -> None:
    names = ("low-texture", "repetitive", "low-texture")
    taken = [views(build_world(name, 0), 3, SMALL) for name in names[:2]]
    sheet = sheet_of_worlds(names, [*taken, taken[0]])
    block = (30 + 76 + 12, 3 * (120 + 12))
    assert sheet.shape == (2 * block[0] + 12, 2 * block[1] + 12, 3)
    np.testing.assert_array_equal(
        sheet[6 : 6 + block[0], 6 : 6 + block[1]], sheet[-6 - block[0] : -6, 6 : 6 + block[1]]
    )
    assert sheet[-6 - block[0] :, 6 + block[1] :].std() == pytest.approx(sheet[0].std())  # one block is empty


@pytest.mark.slow
def test_contact_sheets_show_dark_worlds_dark() -> None:
    dark, lit = (views(build_world(name, 0), 1, SMALL)[0].mean() for name in ("dark", "repetitive"))
    assert 3.0 < dark < 0.35 * lit


@pytest.mark.parametrize("load", [*textures_storage.LOADS, textures_storage.pallet, textures_building.notice_board])
def test_textures_of_goods_have_contrast(load: textures_storage.Load) -> None:
    for height, width in ((140, 140), (30, 160)):
        image = load(np.random.default_rng(1), height, width)
        assert image.shape == (height, width, 3)
        assert image.std() > 12.0
        np.testing.assert_array_equal(image, load(np.random.default_rng(1), height, width))
