"""Instance segmentation: every object has a name and agrees with the textured world."""

from functools import partial

import mujoco
import numpy as np
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.sim.appearance.instances import Instance, single_instance, unique_names
from dronevio.sim.appearance.solids import Box
from dronevio.sim.appearance.textures import plain
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.cameras.surfaces import points_in_camera
from dronevio.sim.pictures.texturedness import poses_along
from dronevio.sim.props.furniture import Piece
from dronevio.sim.world import WORLDS, build_world, flight_area, instance_spec

CAMERA = CameraModel(width=188, height=120, fx=115.0, fy=115.0, cx=93.5, cy=59.5)
R_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def names(spec: mujoco.MjSpec) -> list[str]:
    """Return the names of a specification's geoms."""
    return [str(geom.name) for geom in spec.geoms]


def test_instances_of_a_kind_are_numbered() -> None:
    assert unique_names([Instance(kind) for kind in ("tree", "sky", "tree", "log")]) == [
        "tree_1",
        "sky",
        "tree_2",
        "log",
    ]


def test_each_piece_is_an_instance_of_its_own() -> None:
    @single_instance
    def _stool() -> Piece:
        box = Box(np.zeros(3), np.ones(3), partial(plain, colour=(9.0, 9.0, 9.0)), instance=Instance("leg"))
        return Piece((box, box), 1.0, 1.0, 1.0)

    first, second = (_stool().moved(rotation_z(1.0), np.ones(3)).boxes for _ in range(2))
    assert first[0].instance is first[1].instance is not second[0].instance
    assert first[0].instance.kind == "stool"
    assert {face.instance for face in first[0].faces()} == {first[0].instance}


@pytest.mark.parametrize("world", WORLDS)
def test_every_instance_has_a_name(world: str) -> None:
    found = names(instance_spec(world, 4))
    assert len(set(found)) == len(found) > 20
    assert "floor" in found
    assert not [name for name in found if name.startswith("something")]
    assert names(instance_spec(world, 4)) == found


def test_instances_of_a_forest_depend_on_the_seed() -> None:
    assert names(instance_spec("forest", 5)) != names(instance_spec("forest", 6))


@pytest.mark.parametrize("world", ["mirror", "moving", "gates"])
@pytest.mark.slow
def test_instances_agree_with_the_textured_world(world: str) -> None:
    textured, instances = build_world(world, 2), instance_spec(world, 2)
    moved = {mover.body: mover.poses(np.array([7.0]))[0] for mover in textured.movers}
    seen = []
    for spec in (textured.spec, instances):
        with OffscreenCamera(spec.compile(), CAMERA) as offscreen:
            seen.append([offscreen.render_surfaces(T, moved) for T in poses_along(textured.route, 3)])
    for with_texture, bare in zip(*seen, strict=True):
        a, b = (1.0 / surfaces.depth_m.astype(float) for surfaces in (with_texture, bare))
        assert np.mean(np.abs(a - b) > 1e-4) < 2e-3  # except at edges, which are rounded to either side
        np.testing.assert_array_equal(with_texture.geom < 0, bare.geom < 0)


@pytest.mark.parametrize("world", ["room", "warehouse", "mirror"])
def test_floor_and_ceiling_have_their_heights(world: str) -> None:
    model = instance_spec(world, 1).compile()
    with OffscreenCamera(model, CAMERA) as offscreen:
        floor, ceiling = (offscreen.geom_names.index(name) for name in ("floor", "ceiling"))
        shares = []
        for T in poses_along(flight_area(world, 1).route, 6):
            seen = offscreen.render_surfaces(T)
            z = points_in_camera(CAMERA, seen.depth_m) @ T[2, :3] + T[2, 3]
            atol = 0.06  # half a rendered pixel at a grazing angle
            np.testing.assert_allclose(z[seen.geom == floor], 0.0, atol=atol)
            np.testing.assert_allclose(z[seen.geom == ceiling], flight_area(world, 1).space.high[2], atol=atol)
            assert np.mean(seen.geom[np.abs(z) < 1e-4] == floor) > 0.98  # all but the contact of objects with the floor
            shares.append(np.mean(seen.geom == floor))
    assert np.mean(shares) > 0.05


def test_gates_are_numbered_in_the_order_of_the_route() -> None:
    route = flight_area("gates", 3).route  # the start, then a point before and one behind each gate
    with OffscreenCamera(instance_spec("gates", 3).compile(), CAMERA) as offscreen:
        for number, (before, behind) in enumerate(route[1:].reshape(-1, 2, 3), 1):
            direction = behind - before
            T = pose_matrix(rotation_z(float(np.arctan2(direction[1], direction[0]))) @ R_LEVEL, before)
            seen = offscreen.render_surfaces(T)
            nearest = seen.geom[np.isfinite(seen.depth_m) & (np.abs(seen.depth_m - 1.7) < 0.3)]
            assert offscreen.geom_names[np.bincount(nearest).argmax()] == f"gate_{number}"


def test_moving_instances_have_names() -> None:
    model = instance_spec("moving", 1).compile()
    person = pose_matrix(np.eye(3), np.array([0.0, 0.0, 0.0]))
    T = pose_matrix(R_LEVEL, np.array([-2.0, 0.0, 1.2]))
    with OffscreenCamera(model, CAMERA) as offscreen:
        seen = offscreen.render_surfaces(T, {"person_3": person})
        shown = seen.geom == offscreen.geom_names.index("person_3")
    assert 0.05 < shown.mean() < 0.5
    assert np.all(np.abs(seen.depth_m[shown] - 2.0) < 0.5)
