"""Rooms: determined by the seed, free of obstacles in the middle, with textured surfaces."""

import itertools

import cv2
import mujoco
import numpy as np
import pytest

from dronevio.models.arrays import Array, Image
from dronevio.models.errors import ConfigError
from dronevio.sim.appearance import pictures, textures
from dronevio.sim.appearance.lightmap import AreaLight, bake
from dronevio.sim.appearance.solids import Box, Face
from dronevio.sim.props.room import FREE_BOX_M, SIZE_M, Room, furnished_room
from dronevio.sim.world import World, _painted, build_world

COLOUR = (150.0, 120.0, 90.0)


def extent(box: Box) -> Array:
    """Return the lowest and highest corner (2, 3) of the axis-aligned box around a box."""
    half = np.abs(box.R) @ box.half
    return np.stack([box.centre - half, box.centre + half])


def overlap_m(a: Array, b: Array) -> float:
    """Return the overlap of two axis-aligned boxes (2, 3) along the axis of the least overlap; negative if separate."""
    return float(np.min(np.minimum(a[1], b[1]) - np.maximum(a[0], b[0])))


@pytest.fixture(scope="module")
def world() -> World:
    return build_world("room", 0)


@pytest.fixture(scope="module", params=range(6))
def room(request: pytest.FixtureRequest) -> Room:
    return furnished_room(np.random.default_rng(request.param))


def test_the_free_box_contains_no_objects(room: Room) -> None:
    for box in (*room.boxes, *room.obstacles):
        assert overlap_m(extent(box), FREE_BOX_M) <= 0.0


def test_everything_is_inside_the_room(room: Room) -> None:
    low, high = np.array([-0.5, -0.5, 0.0]) * SIZE_M, np.array([0.5, 0.5, 1.0]) * SIZE_M
    for box in room.boxes:
        found = extent(box)
        assert (found[0] > low - 0.001).all()
        assert (found[1] < high + 0.001).all()


def test_furniture_does_not_overlap(room: Room) -> None:
    assert len(room.obstacles) >= 10
    for a, b in itertools.combinations(room.obstacles, 2):
        assert overlap_m(extent(a), extent(b)) <= 0.0


@pytest.mark.slow
def test_rooms_are_determined_by_the_seed() -> None:
    def fingerprint(name: str, seed: int) -> tuple[bytes, bytes]:
        model = build_world(name, seed).spec.compile()
        return model.tex_data.tobytes(), model.geom_pos.tobytes()

    first, other = fingerprint("room", 0), fingerprint("room", 5)
    assert first[0] != other[0]
    assert first[1] != other[1]
    _painted.cache_clear()  # otherwise the cached world would be returned
    assert fingerprint("room", 0) == first


def test_the_model_has_few_geoms_and_separate_collisions(world: World) -> None:
    model = world.spec.compile()
    seen = model.geom_group == 0
    assert seen.sum() <= 20  # draw calls of an image: pages of textures share them, whatever the number of objects
    assert (~seen).sum() <= 260  # solids cost time: 230 slow a batch by 18 %, and the 2500 of a warehouse by 35 %
    assert (model.geom_contype[seen] == 0).all()
    assert (model.geom_contype[~seen] == 1).all()
    assert model.vis.map.znear * model.stat.extent < 0.05
    assert model.vis.map.zfar * model.stat.extent > np.linalg.norm(SIZE_M)


def test_a_bouncing_ball_stays_inside(world: World) -> None:
    spec = build_world("room", 0).spec
    body = spec.worldbody.add_body(name="ball", pos=[0.0, 0.0, 1.0])
    body.add_freejoint()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0.0, 0.0], mass=1.0)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[:3] = [3.0, -2.0, 0.0]
    mujoco.mj_step(model, data, 3000)
    assert np.abs(data.qpos[:2]).max() < 4.0
    assert data.qpos[2] == pytest.approx(0.1, abs=0.01)


def test_the_outline_is_that_of_the_room(world: World) -> None:
    assert world.outline.shape[1:] == (2, 3)
    np.testing.assert_allclose(world.outline.reshape(-1, 3).max(axis=0), [4.0, 3.0, 3.5])
    np.testing.assert_allclose(world.outline.reshape(-1, 3).min(axis=0), [-4.0, -3.0, 0.0])


def test_unknown_worlds_are_named() -> None:
    with pytest.raises(ConfigError, match=r"moon.*expected.*room"):
        build_world("moon", 0)


@pytest.mark.parametrize(
    "pattern",
    [
        textures.planks,
        textures.parquet,
        textures.bricks,
        textures.wallpaper,
        textures.stripes,
        textures.plaster,
        textures.rug,
        textures.wood,
        textures.fabric,
        textures.plain,
        textures.foliage,
        textures.cardboard,
        textures.drawers,
        textures.door,
        textures.radiator,
        textures.lampshade,
        textures.screen,
    ],
)
def test_textures_have_contrast_at_any_size(pattern: textures.Pattern) -> None:
    for height, width in ((300, 420), (6, 200), (200, 6)):
        image = pattern(np.random.default_rng(0), height, width, COLOUR)
        assert image.shape == (height, width, 3)
        assert image.dtype == np.uint8
        np.testing.assert_array_equal(image, pattern(np.random.default_rng(0), height, width, COLOUR))
    large = pattern(np.random.default_rng(0), 300, 420, COLOUR).mean(axis=2)
    assert large.std() > 4.0
    assert cv2.goodFeaturesToTrack(large.astype(np.uint8), 100, 0.01, 10.0).shape[0] >= 25


@pytest.mark.parametrize("picture", [*pictures.PICTURES, pictures.window_view, textures.books])
def test_pictures_have_contrast(picture: pictures.Picture) -> None:
    image = picture(np.random.default_rng(1), 180, 240)
    assert image.shape == (180, 240, 3)
    assert image.mean(axis=2).std() > 12.0


def test_light_decreases_with_distance_and_is_occluded() -> None:
    def paint(rng: np.random.Generator, height: int, width: int) -> Image:
        return np.zeros((height, width, 3), np.uint8)

    floor = Face(np.array([-2.0, 2.0, 0.0]), np.array([4.0, 0.0, 0.0]), np.array([0.0, -4.0, 0.0]), paint)
    lamp = AreaLight(np.array([[0.0, 0.0, 2.0]]), 1.0)
    (bare,) = bake([floor], [], [lamp])
    np.testing.assert_allclose(bare, bare[::-1, ::-1], atol=1e-5)
    assert bare.max() == bare[13:15, 13:15].max()
    table = Box(np.array([0.0, 0.0, 1.5]), np.array([0.4, 0.4, 0.02]), paint)
    (shaded,) = bake([floor], [table], [lamp])
    # By similar triangles, the table of half width 0.4 m, 0.5 m below the lamp, casts a shadow of half width 1.6 m
    x = (np.arange(28) + 0.5) / 7.0 - 2.0
    inside = (np.abs(x)[:, None] < 1.55) & (np.abs(x)[None] < 1.55)
    outside = (np.abs(x)[:, None] > 1.65) | (np.abs(x)[None] > 1.65)
    assert shaded[inside].max() < shaded[outside].min()
    np.testing.assert_allclose(shaded[inside], shaded[inside][0], atol=1e-5)


def test_ambient_light_is_occluded_in_corners() -> None:
    def paint(rng: np.random.Generator, height: int, width: int) -> Image:
        return np.zeros((height, width, 3), np.uint8)

    floor = Face(np.array([-2.0, 2.0, 0.0]), np.array([4.0, 0.0, 0.0]), np.array([0.0, -4.0, 0.0]), paint)
    wall = Box(np.array([2.1, 0.0, 1.0]), np.array([0.1, 2.0, 1.0]), paint)
    (light,) = bake([floor], [wall], [])
    assert light[14, 0] == pytest.approx(light[14, 10])
    assert light[14, -1] < 0.85 * light[14, 0]
    assert (np.diff(light[14, -6:]) <= 1e-6).all()
