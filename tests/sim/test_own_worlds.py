"""Worlds of one's own in YAML: their geometry, collisions, images, seeds, names and errors."""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from PIL import Image as Pillow

from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.paths.space import Space
from dronevio.sim.physics.batch_plant import BatchPlant, PlantWorld
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.physics.vehicle_states import VehicleStates
from dronevio.sim.ray_casting import RayCaster
from dronevio.sim.scenarios import scenario_named
from dronevio.sim.world import (
    _painted,
    _resolved_layout,
    build_world,
    collision_spec,
    flight_area,
    illumination_and_movers,
    resolved_world,
    scenery_of,
    solid_space,
    world_builder,
)
from dronevio.sim.worlds.layout import ROUTE_CLEARANCE_M
from dronevio.sim.worlds.outdoors import distance_to_legs
from dronevio.sim.worlds.own.bodies import DEVIATION_M
from dronevio.sim.worlds.own.flight_space import found_free_box, route_clearance
from dronevio.sim.worlds.own.looks import TEXTURES, Look
from dronevio.sim.worlds.own.meshes import filling_boxes
from dronevio.sim.worlds.own.names import file_stem, recorded_world, shown_world

YARD = """
size_m: [16, 12, 5]
outdoors: true
obstacles:
  - {shape: box, size_m: [2.0, 1.0, 1.5], position_m: [4, 2], rotation_deg: 30, texture: bricks}
  - {shape: cylinder, radius_m: 0.5, height_m: 3.0, position_m: [-4, 2], texture: bark, name: tree}
"""
SCATTER = """
scatter:
  - {shape: cylinder, count: 20, radius_m: [0.1, 0.3], height_m: [2, 4], texture: bark, name: tree, pad_distance_m: 2.5}
  - {shape: box, count: 5, size_m: [[0.3, 0.3, 0.5], [0.8, 0.8, 2.0]], texture: crate}
"""
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # a camera that looks along x
SMALL = CameraModel(width=60, height=40, fx=40.0, fy=40.0, cx=29.5, cy=19.5)
CUBE = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1)) + "".join(
    f"f {face}\n" for face in ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
)

Writer = Callable[..., str]


@pytest.fixture
def written(tmp_path: Path) -> Writer:
    """Writes a file of a world and returns its name."""

    def write(text: str, name: str = "yard.yaml") -> str:
        (tmp_path / name).write_text(text, encoding="utf-8")
        return str(tmp_path / name)

    return write


def message(name: str, seed: int = 0) -> str:
    """Return the message of the error that a world causes, from the file on."""
    with pytest.raises(ConfigError) as caught:
        flight_area(name, seed)
    return str(caught.value)


def to_box(points: Array, centre: Array, half: Array, R: Array) -> Array:
    """Return the distances of points outside of a box."""
    return np.asarray(np.linalg.norm(np.maximum(np.abs((points - centre) @ R) - half, 0.0), axis=1))


def to_cylinder(points: Array, centre: Array, radius: float, half: float) -> Array:
    """Return the distances of points outside of an upright cylinder."""
    beside = np.linalg.norm((points - centre)[:, :2], axis=1) - radius
    above = np.abs(points[:, 2] - centre[2]) - half
    return np.asarray(np.hypot(np.maximum(beside, 0.0), np.maximum(above, 0.0)))


@pytest.mark.parametrize("space_of", [solid_space, lambda name, seed: flight_area(name, seed).space])
def test_clearance_is_the_distance_to_boxes_and_cylinders(
    written: Writer, space_of: Callable[[str, int], Space]
) -> None:
    space = space_of(written(YARD), 0)
    np.testing.assert_array_equal([space.low, space.high], [[-8, -6, 0], [8, 6, 5]])
    points = np.random.default_rng(0).uniform(space.low, space.high, (4000, 3))
    box = to_box(points, np.array([4.0, 2.0, 0.75]), np.array([1.0, 0.5, 0.75]), rotation_z(np.pi / 6))
    cylinder = to_cylinder(points, np.array([-4.0, 2.0, 1.5]), 0.5, 1.5)
    bounds = np.minimum(points - space.low, space.high - points).min(axis=1)
    found = space.clearance(points)
    outside = (box > 0.0) & (cylinder > DEVIATION_M)
    expected = np.minimum(np.minimum(box, cylinder), bounds)
    assert np.abs(found - expected)[outside].max() < DEVIATION_M + 1e-9
    nearest_is_box = outside & (box < np.minimum(cylinder - 2.0 * DEVIATION_M, bounds))
    assert nearest_is_box.sum() > 100
    np.testing.assert_allclose(found[nearest_is_box], box[nearest_is_box], atol=1e-9)
    assert (found[~outside] < DEVIATION_M).all()


def test_spheres_are_solid_to_their_surface(written: Writer) -> None:
    text = "size_m: [20, 20, 9]\nobstacles:\n  - {shape: sphere, radius_m: 1.0, position_m: [2, 2, 4]}\n"
    space = solid_space(written(text), 0)
    rng = np.random.default_rng(1)
    way = rng.standard_normal((500, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    radius = rng.uniform(1.05, 1.9, (500, 1))
    found = space.clearance(np.array([2.0, 2.0, 4.0]) + radius * way)
    assert np.abs(found - (radius[:, 0] - 1.0)).max() < 0.06  # plane quadrangles instead of the sphere
    inside = np.array([2.0, 2.0, 4.0]) + rng.uniform(0.0, 0.9, (500, 1)) * way
    assert space.clearance(inside).max() < 0.15  # no cavity in which anything fits


def test_a_box_as_mesh_is_filled_exactly(written: Writer, tmp_path: Path) -> None:
    (tmp_path / "cube.obj").write_text(CUBE)
    text = "size_m: [10, 10, 5]\noutdoors: true\nobstacles:\n  - {shape: mesh, file: cube.obj, scale: 1.5,"
    text += " rotation_deg: 20, position_m: [3, 1]}"
    space = solid_space(written(text), 0)
    points = np.random.default_rng(2).uniform([1, -1, 0.1], [4.5, 3, 4.5], (800, 3))
    expected = to_box(points, np.array([3.0, 1.0, 0.75]), np.full(3, 0.75), rotation_z(np.radians(20.0)))
    outside = expected > 0.0
    bounds = np.minimum(points - space.low, space.high - points).min(axis=1)
    np.testing.assert_allclose(space.clearance(points)[outside], np.minimum(expected, bounds)[outside], atol=1e-6)
    assert (space.clearance(points)[~outside] <= 0.0).all()


def test_a_box_in_glb_is_the_box_in_obj(written: Writer, tmp_path: Path) -> None:
    corners = np.array([[x, y, z] for x in (0, 2) for y in (0, 1) for z in (0, 3)], np.float64)
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = [[side[0], *pair] for side in sides for pair in (side[1:3], side[2:])]
    (tmp_path / "block.glb").write_bytes(glb_of(corners, faces))
    text = "size_m: [10, 10, 5]\noutdoors: true\nobstacles:\n  - {shape: mesh, file: block.glb, position_m: [3, 1]}"
    space = solid_space(written(text), 0)
    points = np.random.default_rng(2).uniform([1, -1, 0.1], [4.5, 3, 4.5], (300, 3))
    expected = to_box(points, np.array([3.0, 1.0, 1.5]), np.array([1.0, 0.5, 1.5]), np.eye(3))
    bounds = np.minimum(points - space.low, space.high - points).min(axis=1)
    found, outside = space.clearance(points), expected > 0.0
    np.testing.assert_allclose(found[outside], np.minimum(expected, bounds)[outside], atol=1e-6)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=8), st.integers(0, 600))
def test_a_damaged_glb_is_refused_with_its_name(written: Writer, tmp_path: Path, noise: bytes, at: int) -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
    whole = glb_of(corners, [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    (tmp_path / "block.glb").write_bytes(whole[:at] + noise)
    name = written("size_m: [10, 10, 5]\nobstacles:\n  - {shape: mesh, file: block.glb, position_m: [3, 1]}")
    assert "'block.glb': " in message(name) and "expected a mesh" in message(name)


def test_the_boxes_of_a_mesh_hold_its_surface_and_its_inside() -> None:
    tetrahedron = np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [0, 0, 1.5]], np.float64)
    triangles = tetrahedron[[[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]]]
    boxes = filling_boxes(triangles)
    weights = np.random.default_rng(3).dirichlet(np.ones(4), 500)
    points = weights @ tetrahedron
    space = Space(
        np.full(3, -9.0),
        np.full(3, 9.0),
        np.array([box.centre for box in boxes]),
        np.array([box.half for box in boxes]),
        np.array([box.R for box in boxes]),
    )
    assert space.clearance(points).max() <= 1e-9
    volume = sum(float(8.0 * np.prod(box.half)) for box in boxes)
    assert 0.5 < volume < 0.9  # 0.5 m³ and a layer of cells of 5 cm
    for k, box in enumerate(boxes):  # they do not overlap
        for other in boxes[:k]:
            assert np.any(np.abs(box.centre - other.centre) >= box.half + other.half - 1e-9)


def test_the_free_box_is_the_largest_between_obstacles(written: Writer) -> None:
    area = flight_area(written(YARD), 0)
    low, high = area.free_box
    np.testing.assert_allclose(0.5 * (low + high)[:2], area.pad[:2], atol=1e-12)
    axes = [np.linspace(a, b, 15) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    space = area.space
    bare = Space(space.low - 9.0, space.high + 9.0, space.centres, space.halves, space.rotations)
    assert bare.clearance(grid).min() >= 0.3 - 1e-9
    # Along x, the cylinder leaves 3.5 m less the margin of 0.3 m, and y has all 6 m less 0.3 m.
    np.testing.assert_allclose(
        high, [4.0 - np.hypot(1.0, 0.5) * np.cos(np.pi / 6 - np.arctan2(0.5, 1.0)) - 0.3, 5.7, 4.7]
    )


def test_there_is_no_free_box_below_an_obstacle() -> None:
    from dronevio.sim.appearance.prisms import UNPAINTED
    from dronevio.sim.appearance.solids import Box

    bounds = np.array([-5.0, -5.0, 0.0]), np.array([5.0, 5.0, 4.0]), np.zeros(3)
    lid = Box(np.array([0.0, 0.0, 2.5]), np.array([1.0, 1.0, 0.1]), UNPAINTED)
    found = found_free_box(*bounds, [lid])
    assert found is not None and found[1, 2] == pytest.approx(2.1)
    table = Box(np.array([0.0, 0.0, 1.0]), np.array([1.0, 1.0, 0.1]), UNPAINTED)
    assert found_free_box(*bounds, [table]) is None


@pytest.mark.parametrize("seed", range(3))
def test_routes_are_clear_and_pads_stay_free(written: Writer, seed: int) -> None:
    area = flight_area(written(YARD + SCATTER), seed)
    assert route_clearance(area.space, area.route) >= ROUTE_CLEARANCE_M
    np.testing.assert_allclose(area.route[0, :2], area.pad[:2])
    assert (np.ptp(area.route[:, :2], axis=0) > [8.0, 6.0]).all()
    above = area.pad + np.linspace([0.0, 0.0, 0.3], [0.0, 0.0, 4.0], 20)
    assert (area.space.clearance(above) >= np.minimum(0.9, np.minimum(above[:, 2], 5.0 - above[:, 2])) - 1e-9).all()


def test_given_routes_and_free_boxes_are_kept_clear(written: Writer) -> None:
    route = [[0, 0, 1.2], [6, -4, 1.5], [-6, -4, 2]]
    text = YARD + SCATTER + f"route_m: {route}\nfree_box_m: [[-2.5, -2.5, 0], [2.5, 2.5, 3]]\n"
    name = written(text)
    for seed in range(3):
        area = flight_area(name, seed)
        np.testing.assert_array_equal(area.route, route)
        np.testing.assert_array_equal(area.free_box, [[-2.5, -2.5, 0], [2.5, 2.5, 3]])
        assert route_clearance(area.space, area.route) >= ROUTE_CLEARANCE_M


def test_scattered_obstacles_keep_their_distances(written: Writer) -> None:
    layout = world_builder(written(YARD + SCATTER)).layout(np.random.default_rng(4))
    trees = [box for box in layout.obstacles if box.instance.kind == "tree"][1:]
    assert len(trees) == 20
    places = np.array([tree.centre[:2] for tree in trees])
    radii = np.array([tree.half[0] for tree in trees]) / (0.95 * 0.5**0.5)
    assert (radii >= 0.1).all() and (radii <= 0.3).all()
    assert (np.linalg.norm(places, axis=1) - radii).min() >= 2.5
    apart = np.linalg.norm(places[:, None] - places, axis=2) - radii - radii[:, None] + 99.0 * np.eye(20)
    assert apart.min() >= 0.8
    assert (np.abs(places) + radii[:, None] <= [8.0, 6.0]).all()


def test_the_seed_determines_the_scatter_only(written: Writer) -> None:
    name = written(YARD + SCATTER)

    first, other = solid_space(name, 5), solid_space(name, 6)
    assert first.centres.tobytes() != other.centres.tobytes()
    again = solid_space(str(Path(name).parent / "." / "yard.yaml"), 5)
    assert first.centres.tobytes() == again.centres.tobytes()
    np.testing.assert_array_equal(first.centres[0], other.centres[0])


def test_the_same_seed_gives_the_same_bytes(written: Writer) -> None:
    name = written("size_m: [9, 8, 3]\nfloor: {texture: white}\n" + SCATTER.replace("20", "4").replace("2.5", "1.5"))

    def seen(seed: int) -> list[bytes]:
        _painted.cache_clear()  # otherwise the cached world would be returned
        _resolved_layout.cache_clear()
        return [part.tobytes() for mesh in scenery_of(name, seed).meshes for part in (mesh.vertices, mesh.texture)]

    first = seen(5)
    assert first == seen(5) != seen(6)


def test_other_light_leaves_the_scatter(written: Writer) -> None:
    name = written(YARD + SCATTER + "floor: {texture: white}\n")
    a, b = (build_world(name, 1, light_seed=seed).spec.compile() for seed in (None, 3))
    np.testing.assert_array_equal(a.geom_pos, b.geom_pos)
    assert a.tex_data.tobytes() != b.tex_data.tobytes()


def test_drones_that_fly_into_obstacles_collide(written: Writer) -> None:
    name = written(YARD)
    spec, rig = collision_spec(name, 0), euroc_rig()
    plant = BatchPlant(3, rig, worlds=[PlantWorld(spec)])
    speeds = plant.quadrotor.hover_speed_rad_s
    starts = np.array([[-4.0, 0.0, 1.2], [-2.0, 0.0, 1.2], [4.0, 0.0, 1.2]])
    velocity = np.tile([0.0, 5.0, 0.0], (3, 1))  # to the cylinder, past everything, to the box
    plant.reset(np.ones(3, np.bool_), VehicleStates.at(starts, None, velocity, 0.0, speeds))
    single = QuadrotorPlant(rig, surroundings=collision_spec(name, 0))
    for start, hits in zip(starts, (True, False, True), strict=True):
        single.reset(pose_matrix(np.eye(3), start), velocity[0], np.zeros(3), np.full(4, speeds))
        for _ in range(100):
            single.advance(single.t_ns + single.interval_ns, np.full(4, speeds))
        assert (single.collision is not None) == hits
    for _ in range(100):
        plant.advance(np.full((3, 4), speeds))
    np.testing.assert_array_equal(plant.now.touched, [True, False, True])


def test_the_depth_of_a_box_is_its_distance(written: Writer) -> None:
    text = "size_m: [20, 12, 5]\nobstacles:\n  - {shape: box, size_m: [1, 6, 4], position_m: [5, 0], texture: crate}\n"
    name = written(text)
    T = pose_matrix(FORWARD, np.array([1.0, 0.5, 1.5]))
    with OffscreenCamera(build_world(name, 0, texture_reduction=4).spec.compile(), SMALL) as camera:
        depth = camera.render_depth(T)
    rays = np.stack(np.meshgrid(np.arange(60.0), np.arange(40.0)), axis=-1).reshape(-1, 2)
    bearings = SMALL.unproject(rays)
    ranges = RayCaster(name, 0).ranges_m(T[None], bearings)[0]
    to_box = 3.5 / bearings[:, 2]  # the front is at x = 4.5 m
    hits = (np.abs(0.5 - bearings[:, 0] * to_box) < 2.9) & (np.abs(1.5 - bearings[:, 1] * to_box - 2.0) < 1.95)
    assert hits.sum() > 1000
    np.testing.assert_allclose(ranges[hits], to_box[hits], rtol=1e-6)
    np.testing.assert_allclose(depth.ravel()[hits], 3.5, rtol=2e-3)  # along the optical axis


def glb_of(vertices: Array, faces: list[list[int]], uv: Array | None = None, picture: Image | None = None) -> bytes:
    """Return a mesh with z up as GLB, by trimesh; a picture is in BGR."""
    trimesh = pytest.importorskip("trimesh")
    visual = None
    if uv is not None and picture is not None:
        visual = trimesh.visual.TextureVisuals(uv, image=Pillow.fromarray(picture[..., ::-1].astype(np.uint8)))
    mesh = trimesh.Trimesh(vertices[:, [0, 2, 1]] * [1.0, 1.0, -1.0], faces, visual=visual, process=False)
    return bytes(mesh.export(file_type="glb"))


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_images_are_seen_on_boxes_and_meshes(written: Writer, tmp_path: Path, kind: str) -> None:
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32, :32, 2], picture[32:, 32:, 1] = 220, 220  # red (BGR) at the top left, green at the bottom right
    cv2.imwrite(str(tmp_path / "sign.png"), picture)
    corners = "v 0 -1 0\nv 0 1 0\nv 0 1 2\nv 0 -1 2\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "sign.obj").write_text(corners + "f 2/1 1/2 4/3 3/4\n")  # seen from −x, y to the left
    if kind == "glb":  # with the image in the file
        vertices = np.array([[0, 1, 0], [0, -1, 0], [0, -1, 2], [0, 1, 2]], np.float64)
        uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
        (tmp_path / "sign.glb").write_bytes(glb_of(vertices, [[0, 1, 2], [0, 2, 3]], uv, picture))
    texture = ", texture: sign.png" if kind == "obj" else ""
    text = (
        "size_m: [20, 12, 5]\nobstacles:\n"
        f"  - {{shape: mesh, file: sign.{kind}{texture}, position_m: [4, 2, 1.5]}}\n"
        "  - {shape: box, size_m: [1, 2, 2], position_m: [4.5, -2, 1.5], texture: sign.png}\n"
    )
    model = build_world(written(text), 0).spec.compile()
    with OffscreenCamera(model, CameraModel(width=200, height=100, fx=80.0, fy=80.0, cx=99.5, cy=49.5)) as camera:
        seen = camera.render_rgb(pose_matrix(FORWARD, np.array([0.0, 0.0, 1.5]))).astype(int)
    for left in (50, 130):  # y = 2 and −2 at a distance of 4 m, 20 px a metre: 59.5 and 139.5 are the middles
        top, low = seen[40, left], seen[59, left + 19]
        assert top[0] > 60 > 30 > top[1], left
        assert low[1] > 60 > 30 > low[0], left


@pytest.mark.parametrize("name", TEXTURES)
def test_textures_fit_all_sizes(name: str) -> None:
    paint = Look(name).paint(100.0)
    for height, width in ((6, 6), (6, 900), (700, 6), (300, 400)):
        image = paint(np.random.default_rng(0), height, width)
        assert image.shape == (height, width, 3) and image.dtype == np.uint8
        np.testing.assert_array_equal(image, paint(np.random.default_rng(0), height, width))
    other = Look(name, (200.0, 30.0, 30.0)).paint(100.0)(np.random.default_rng(0), 300, 400).astype(int)
    assert (other.mean(axis=(0, 1)) != image.mean(axis=(0, 1))).any()


def test_changed_files_are_other_worlds(written: Writer) -> None:
    name = written(YARD)
    before, first = resolved_world(name), flight_area(name, 0)
    assert flight_area(name, 0) is first and flight_area(before, 0) is first
    written(YARD.replace("16, 12", "18, 12"))
    after = resolved_world(name)
    assert before.split("#")[0] == after.split("#")[0] == name
    assert before != after
    assert flight_area(name, 0).space.high[0] == 9.0
    assert flight_area(before, 0) is first  # an environment that was made before keeps its world


def test_a_change_of_a_texture_or_mesh_is_another_world(written: Writer, tmp_path: Path) -> None:
    (tmp_path / "cube.obj").write_text(CUBE)
    name = written("size_m: [10, 10, 5]\nobstacles:\n  - {shape: mesh, file: cube.obj, position_m: [3, 1]}")
    before = resolved_world(name)
    (tmp_path / "cube.obj").write_text(CUBE.replace("v 0 0 0", "v 0 0 0.1"))
    assert resolved_world(name) != before


def test_recorded_names_are_found_again(written: Writer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = resolved_world(written(YARD))
    recorded = recorded_world(name)
    assert re.fullmatch(r"yard\.yaml#[0-9a-f]{16}", recorded)
    assert (shown_world(name), file_stem(name)) == ("yard.yaml", "yard")
    assert (recorded_world("room"), shown_world("room"), file_stem("low-texture")) == ("room", "room", "low-texture")
    monkeypatch.chdir(tmp_path)
    assert resolved_world(recorded) == resolved_world("yard.yaml") == resolved_world(name) == name
    written(YARD + "description: another\n")
    assert "expected " + recorded[-16:] in message(recorded)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    assert f"world {recorded}: there is no file yard.yaml in {elsewhere}" in message(recorded)


def test_scenarios_state_the_file_without_its_folder(written: Writer) -> None:
    from dataclasses import replace

    scenario = replace(scenario_named("room", 0), world=written(YARD))
    assert scenario.recorded.world == recorded_world(resolved_world(scenario.world))
    assert (scenario.recorded.world_seed, replace(scenario, world="room").recorded.world) == (0, "room")


def test_builders_in_modules_are_worlds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "dim_worlds.py").write_text(
        "from dataclasses import replace\n"
        "from dronevio.sim.worlds import room\n"
        "from dronevio.sim.worlds.layout import WorldBuilder\n"
        "def layout(rng):\n    return replace(room.layout(rng), illumination=0.5)\n"
        "DIM = WorldBuilder('a dim room', layout)\nNONE = 3\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    name = "python:dim_worlds:DIM"
    assert illumination_and_movers(name, 0)[0] == 0.5
    assert world_builder(name).description == "a dim room"
    resolved = resolved_world(name)
    assert re.fullmatch(re.escape(name) + r"#[0-9a-f]{16}", resolved) and resolved_world(resolved) == resolved
    assert "NONE in dim_worlds is a int; expected a WorldBuilder" in message("python:dim_worlds:NONE")
    assert "cannot import no_such_module" in message("python:no_such_module:DIM")
    assert "expected python:package.module:NAME" in message("python:dim_worlds")
    assert "expected 0123456789abcdef" in message(f"{name}#0123456789abcdef")


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("outdoors: true", "no field size_m; expected size_m: 3 numbers from 0 to 200"),
        ("size_m: [2, 2, 2]", ":1: size_m: [2.0, 2.0, 2.0]; expected length and width of 3 to 200 m"),
        ("size_m: [16, 12, .nan]", ":1: size_m"),
        ("size_m: [16, 12, 5]\nsize: 3", ":2: unknown field size; expected some of size_m,"),
        ("size_m: [16, 12, 5]\nfloor: {texture: grss}", ":2: floor.texture: grss; expected an image"),
        ("size_m: [16, 12, 5]\nfloor: grass", ":2: floor: grass; expected a map"),
        ("size_m: [16, 12, 5]\noutdoors: true\nwalls: {texture: bricks}", ":3: walls"),
        ("size_m: [16, 12, 5]\npad_m: [8, 0]", ":2: pad_m: [8.0, 0.0]; expected a place at least 1 m"),
        ("size_m: [16, 12, 5]\nobstacles: 3", ":2: obstacles: 3.0; expected a list of maps"),
        ("size_m: [16, 12, 5]\nobstacles:\n  - {shape: cone}", ":3: obstacles.0.shape: cone; expected one of box,"),
        ("size_m: [16, 12, 5]\nobstacles:\n  - {shape: box, position_m: [1, 1]}", "obstacles.0.size_m"),
        (
            "size_m: [16, 12, 5]\nobstacles:\n  - {shape: box, size_m: [1, 1, 1], position_m: [9, 1]}",
            ":3: obstacles.0.position_m: [9.0, 1.0]; expected a place in the world: -8 to 8, -6 to 6, 0 to 5 m",
        ),
        (
            "size_m: [16, 12, 5]\nobstacles:\n  - {shape: box, size_m: [1, 1, 1], radius_m: 1, position_m: [3, 1]}",
            "obstacles.0.radius_m: 1.0; expected only size_m of a box",
        ),
        (
            "size_m: [16, 12, 5]\nobstacles:\n  - {shape: mesh, file: ../x.obj, position_m: [3, 1]}",
            ":3: obstacles.0.file: '../x.obj'; expected a file .obj or .stl or .glb in the folder of the world",
        ),
        (
            "size_m: [16, 12, 5]\nobstacles:\n  - {shape: mesh, file: /etc/passwd, position_m: [3, 1]}",
            "obstacles.0.file: '/etc/passwd'",
        ),
        (
            "size_m: [16, 12, 5]\nobstacles:\n  - {shape: mesh, file: x.obj, position_m: [3, 1]}",
            "obstacles.0.file: 'x.obj' does not exist",
        ),
        ("size_m: [16, 12, 5]\nwalls: {texture: '../a.png'}", "walls.texture: '../a.png'; expected a file"),
        (
            "size_m: [16, 12, 5]\nscatter:\n  - {shape: sphere, count: 1e9, radius_m: 0.1}",
            "scatter.0.count: 1000000000.0; expected a number from 1 to 1000",
        ),
        (
            "size_m: [16, 12, 5]\nscatter:\n  - {shape: sphere, count: 600, radius_m: 0.1}\n"
            "  - {shape: sphere, count: 600, radius_m: 0.1}",
            "1200 obstacles, scattered ones included; expected at most 1000",
        ),
        (
            "size_m: [16, 12, 5]\nscatter:\n  - {shape: sphere, count: 500, radius_m: 0.4}",
            "scatter.0: no place for number",
        ),
        (
            "size_m: [16, 12, 5]\nobstacles:\n  - {shape: box, size_m: [2, 2, 2], position_m: [0, 0]}",
            "pad_m: the space above the landing pad at [0.0, 0.0] m is too narrow",
        ),
        (
            "size_m: [16, 12, 5]\nroute_m: [[0, 0, 1], [5, 0, 1], [5, 5.8, 1]]",
            "route_m: 0.20 m of clearance; expected at least 0.6 m on all legs",
        ),
        ("size_m: [16, 12, 5]\nroute_m: [[1, 0, 1], [5, 0, 1], [5, 4, 1]]", "route_m: the first point [1.0, 0.0, 1.0]"),
        (
            "size_m: [16, 12, 5]\nfree_box_m: [[-2, -2, 0], [2, 2, 2]]\n"
            "obstacles:\n  - {shape: box, size_m: [1, 1, 1], position_m: [1.5, 0]}",
            "free_box_m: ",
        ),
        ("size_m: [3, 3, 5]\nobstacles: &a\n  - *a", "alias"),
        ("size_m: !!python/object/apply:os.system ['true']", "the tag"),
    ],
)
def test_errors_name_file_and_field(written: Writer, text: str, part: str) -> None:
    found = message(written(text))
    assert "yard.yaml" in found and part in found and "expected" in found


def test_unknown_and_missing_worlds_are_named(tmp_path: Path) -> None:
    assert "did you mean forest?" in message("forrest")
    assert message("yard").endswith("FILE.yaml, FILE.xml, python:package.module:NAME")
    assert str(tmp_path / "no.yaml") in message(str(tmp_path / "no.yaml"))


def test_links_out_of_the_folder_are_refused(written: Writer, tmp_path: Path) -> None:
    inner = tmp_path / "inner"
    inner.mkdir()
    (tmp_path / "cube.obj").write_text(CUBE)
    (inner / "cube.obj").symlink_to(tmp_path / "cube.obj")
    (inner / "yard.yaml").write_text(
        "size_m: [10, 10, 5]\nobstacles:\n  - {shape: mesh, file: cube.obj, position_m: [3, 1]}"
    )
    assert "in the folder of the world" in message(str(inner / "yard.yaml"))


def test_large_images_are_refused(written: Writer, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "long.png"), np.zeros((8, 9000), np.uint8))
    text = "size_m: [10, 10, 5]\nfloor: {texture: long.png}\n"
    assert "floor.texture: 'long.png': 9000 × 8 px; expected a PNG or JPEG image of at most 8192" in message(
        written(text)
    )


VALUES = st.recursive(
    st.one_of(st.floats(), st.integers(), st.text(max_size=8), st.sampled_from(["true", "box", "mesh", "grass", ""])),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.sampled_from(["shape", "texture", "size_m", "0"]), inner)
    ),
    max_leaves=6,
)
FIELDS = st.sampled_from(
    ["size_m", "outdoors", "pad_m", "floor", "walls", "obstacles", "scatter", "route_m", "free_box_m", "mjcf", "x"]
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.one_of(st.binary(max_size=80), st.dictionaries(FIELDS, VALUES).map(repr).map(str.encode)))
@example(content=b"size_m: [16, 12, 5]\nobstacles:\n - {shape: box, size_m: [1, 1, 1], position_m: [1e308, 1]}")
@example(content=b"size_m: [16, 12, 5]\nobstacles: [[1, 2], [3]]")
@example(content=b"size_m: [16, 12, 5]\nobstacles:\n")
@example(content=b"size_m: [16, 12, 5]\nfloor:\n")
@example(content=b"size_m: [16, 12, 5]\nobstacles: {0: {shape: box}}")
@example(content=b"size_m: [16, 12, 5]\nwalls: {texture: '\\0.png'}")
def test_malformed_files_are_errors_for_people(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "yard.yaml"
    path.write_bytes(content)
    try:
        resolved_world(str(path))
    except ConfigError as error:
        assert str(path) in str(error)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_changed_fields_are_errors_or_worlds(tmp_path: Path, data: st.DataObject) -> None:
    lines = (YARD + SCATTER).strip().splitlines()
    row = data.draw(st.integers(0, len(lines) - 1))
    found = list(re.finditer(r"[\w.]+", lines[row]))
    if not found:
        return
    word = data.draw(st.sampled_from(found))
    value = data.draw(
        st.one_of(st.floats(width=16).map(str), st.sampled_from(["[]", "{}", "~", "''", "box", "[1, 2]"]))
    )
    lines[row] = lines[row][: word.start()] + value + lines[row][word.end() :]
    path = tmp_path / "yard.yaml"
    path.write_text("\n".join(lines), encoding="utf-8")
    try:
        resolved_world(str(path))
    except ConfigError as error:
        assert str(path) in str(error)


def test_distance_to_legs_is_that_of_scattered_obstacles(written: Writer) -> None:
    """Scattered obstacles stay off a given route."""
    route = np.array([[0, 0, 1.2], [6, -4, 1.5], [-6, -4, 2]])
    layout = world_builder(written(YARD + SCATTER + f"route_m: {route.tolist()}\n")).layout(np.random.default_rng(0))
    places = np.array([box.centre[:2] for box in layout.obstacles])
    assert distance_to_legs(places, route).min() > ROUTE_CLEARANCE_M
