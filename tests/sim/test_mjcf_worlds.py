"""Worlds of one's own in MJCF: their static geoms are solid and seen, and files cannot reach out of their folder."""

from collections.abc import Callable
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from dronevio.models.errors import ConfigError
from dronevio.models.rotation import pose_matrix
from dronevio.sim.ray_casting import RayCaster
from dronevio.sim.world import collision_spec, flight_area, resolved_world, solid_space, visible_quads, world_builder

GEOMS = """
<geom name="ground" type="plane" size="8 6 .1" material="grid"/>
<geom name="wall" type="box" size="2 .1 1" pos="0 4 1" euler="0 0 20" rgba=".8 .3 .2 1"/>
<geom name="pole" type="cylinder" size=".2 1.5" pos="4 0 1.5"/>
<geom name="ball" type="sphere" size=".5" pos="-5 -3 1"/>
<geom name="pill" type="capsule" size=".3 .7" pos="-4 0 1"/>
<geom name="egg" type="ellipsoid" size=".6 .3 .4" pos="-4 3 1"/>
<geom name="wedge" type="mesh" mesh="wedge" pos="5 -4 0"/>
<geom name="board" type="plane" size="1 .5 .1" pos="2 -4 1" euler="90 0 0"/>
<geom name="ghost" type="box" size=".3 .3 .3" pos="6 3 1" contype="0" conaffinity="0"/>
<geom name="unseen" type="box" size=".3 .3 .3" pos="6 5 1" group="3"/>
<body pos="2 2 1"><body euler="0 0 90"><geom name="nested" type="box" size=".4 .1 .1" pos="1 0 0"/></body></body>
<body pos="-2 -2 1"><freejoint/><geom name="loose" size=".3"/></body>
<body mocap="true" pos="-2 2 1"><geom name="carried" size=".3"/></body>
<replicate count="3" offset="1 0 0"><geom name="post" type="box" size=".1 .1 .5" pos="-7 5 .5"/></replicate>
"""
ASSETS = """
<texture name="grid" type="2d" builtin="checker" rgb1=".2 .4 .3" rgb2=".7 .7 .6" width="64" height="64"/>
<material name="grid" texture="grid" texrepeat="1 1" texuniform="true"/>
<mesh name="wedge" vertex="0 0 0  2 0 0  0 1 0  0 0 1.5"/>
"""

Writer = Callable[..., str]


def model(geoms: str = GEOMS, assets: str = ASSETS, rest: str = "") -> str:
    """Return the text of a model."""
    return f"<mujoco>{rest}<asset>{assets}</asset><worldbody>{geoms}</worldbody></mujoco>"


@pytest.fixture
def written(tmp_path: Path) -> Writer:
    """Writes a file of a world and returns its name."""

    def write(text: str, name: str = "yard.xml") -> str:
        (tmp_path / name).write_text(text, encoding="utf-8")
        return str(tmp_path / name)

    return write


def message(name: str) -> str:
    """Return the message of the error that a world causes."""
    with pytest.raises(ConfigError) as caught:
        resolved_world(name)
    return str(caught.value)


def test_static_geoms_are_solid(written: Writer) -> None:
    """Distances to our solids are those to MuJoCo's own geoms, within the flat faces of round ones."""
    text = model()
    space = solid_space(written(text), 0)
    np.testing.assert_array_equal([space.low, space.high], [[-8, -6, 0], [8, 6, 4.5]])
    own = mujoco.MjSpec.from_string(text)
    probe = own.worldbody.add_body(name="probe", mocap=True)
    probe.add_geom(name="probe", size=[1e-6, 0, 0], type=mujoco.mjtGeom.mjGEOM_SPHERE)
    compiled = own.compile()
    data = mujoco.MjData(compiled)
    solid = ["wall", "pole", "ball", "pill", "egg", "wedge", "unseen", "nested"]
    numbers = [compiled.geom(name).id for name in solid]
    numbers += [k for k in range(compiled.ngeom) if compiled.geom(k).name.startswith("post")]
    assert len(numbers) == len(solid) + 3
    rng = np.random.default_rng(0)
    for point in rng.uniform([-7.9, -5.9, 0.1], [7.9, 5.9, 3.0], (150, 3)):
        data.mocap_pos[compiled.body("probe").mocapid[0]] = point
        mujoco.mj_kinematics(compiled, data)
        apart = [mujoco.mj_geomDistance(compiled, data, compiled.geom("probe").id, k, 20.0, None) for k in numbers]
        aside = np.maximum(np.abs(point - [2.0, -4.0, 1.0]) - [1.0, 0.0, 0.5], 0.0)
        expected = min(*apart, float(np.linalg.norm(aside)))
        expected = min(expected, float(np.minimum(point - space.low, space.high - point).min()))
        found = float(space.clearance(point))
        if expected > 0.1:
            assert found == pytest.approx(expected, abs=0.08), point  # cells of 5 cm fill the wedge


def test_what_moves_is_left_out_and_what_is_hidden_is_not_seen(written: Writer) -> None:
    name = written(model())
    seen = set(visible_quads(name, 0))
    assert {"wall", "pole", "ball", "pill", "egg", "wedge", "board", "ghost", "nested"} <= seen
    assert seen.isdisjoint({"loose", "carried", "unseen", "ground"})
    solid = {geom.name.rpartition("_part_")[0] for geom in collision_spec(name, 0).geoms}
    assert {"wall", "pole", "ball", "pill", "egg", "wedge", "board", "unseen", "nested"} <= solid
    assert solid.isdisjoint({"loose", "carried", "ghost"})


def test_geoms_are_seen_where_they_are(written: Writer) -> None:
    name = written(model())
    caster = RayCaster(name, 0)
    ahead = np.array([[1.0, 0.0, 0.0]])
    ranges = [
        float(caster.ranges_m(pose_matrix(np.eye(3), np.array(start))[None], ahead)[0, 0])
        for start in ([0.0, 0.03, 1.5], [-7.0, -2.97, 1.05], [4.0, 3.0, 1.0], [1.5, 3.0, 1.0])
    ]
    np.testing.assert_allclose(ranges, [3.8, 1.5, 1.7, 0.4], atol=0.02)  # pole, ball, ghost and nested


def test_pad_floor_and_bounds_come_from_the_model(written: Writer) -> None:
    floor = '<geom type="plane" size="0 0 .1" pos="0 0 .5"/><geom type="box" size="1 1 1" pos="4 5 1.5"/>'
    area = flight_area(written(model(floor + '<site name="pad" pos="1 -1 3"/>')), 0)
    np.testing.assert_allclose(area.pad, [1.0, -1.0, 0.5])
    np.testing.assert_allclose([area.space.low, area.space.high], [[-2, -2, 0.5], [7, 8, 4.5]])


def test_yaml_and_mjcf_join(written: Writer) -> None:
    written(model())
    name = written("size_m: [20, 14, 6]\nmjcf: yard.xml\nfloor: {texture: tiles}\n", "yard.yaml")
    both, alone = solid_space(name, 0), solid_space(str(Path(name).with_suffix(".xml")), 0)
    np.testing.assert_array_equal(both.high, [10, 7, 6])
    assert {tuple(row) for row in alone.centres[:, :2]} <= {tuple(row) for row in both.centres[:, :2]}


def test_textures_are_kept(written: Writer) -> None:
    shell = world_builder(written(model())).layout(np.random.default_rng(0)).shell
    image = shell[0].paint(np.random.default_rng(0), 200, 300)
    colours = np.array([[51.0, 102.0, 76.5], [178.5, 178.5, 153.0]])
    nearest = np.abs(image.reshape(-1, 1, 3) - colours).max(axis=2)
    assert (nearest.min(axis=1) < 2.0).mean() > 0.8  # apart from the edges
    assert 0.4 < (nearest[:, 0] < 2.0).mean() + 0.1 < 0.6


def test_files_are_read_from_the_folder_only(written: Writer, tmp_path: Path) -> None:
    inside, outside = tmp_path / "inside", tmp_path
    (inside / "parts").mkdir(parents=True)
    (outside / "secret.xml").write_text("<mujoco/>")
    (outside / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    cv2.imwrite(str(outside / "a.png"), np.full((8, 8, 3), 90, np.uint8))

    def error(text: str) -> str:
        (inside / "yard.xml").write_text(text)
        return message(str(inside / "yard.xml"))

    for file in ("../a.obj", str(outside / "a.obj"), "parts/../../a.obj"):
        assert "in the folder of the world" in error(model("", f'<mesh name="a" file="{file}"/>'))
    assert "in the folder" in error(model("", '<mesh name="a" file="a.obj"/>', '<compiler meshdir=".."/>'))
    assert "in the folder" in error(model("", '<texture name="a" type="2d" file="../a.png"/>'))
    assert "in the folder" in error(model('<include file="../secret.xml"/>'))
    assert "does not exist" in error(model("", '<mesh name="a" file="parts/a.obj"/>'))
    (inside / "parts" / "a.obj").write_bytes((outside / "a.obj").read_bytes())
    (inside / "parts" / "a.png").write_bytes((outside / "a.png").read_bytes())
    (inside / "more.xml").write_text(
        '<mujoco><worldbody><geom name="more" type="mesh" mesh="a" pos="3 2 0"/></worldbody></mujoco>'
    )
    assets = '<mesh file="a.obj"/><texture name="t" type="2d" file="parts/a.png"/><material name="m" texture="t"/>'
    text = model(GEOMS, ASSETS + assets, '<compiler meshdir="parts"/><include file="more.xml"/>')
    (inside / "yard.xml").write_text(text)
    name = str(inside / "yard.xml")
    before = resolved_world(name)
    assert "more" in visible_quads(name, 0)
    (inside / "more.xml").write_text((inside / "more.xml").read_text().replace("3 2 0", "3 2.5 0"))
    assert resolved_world(name) != before


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("<mujoco>", ":1: MJCF: "),
        ("<robot/>", "the element 'robot'; expected MJCF"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><mujoco/>', "a document type; expected XML without"),
        (
            model('<replicate count="100000"><geom size=".1"/></replicate>'),
            "replicate count='100000'; expected at most",
        ),
        (
            model('<replicate count="1000"><replicate count="1000"><geom size=".1"/></replicate></replicate>'),
            "replicate count='1000'",
        ),
        (model("", '<texture name="a" type="2d" builtin="flat" width="100000" height="9"/>'), "width='100000'"),
        (model("", '<mesh name="a" builtin="sphere" params="1000"/>'), "params='1000'"),
        (model('<body><composite type="cable" count="9 1 1"/></body>'), "the element 'composite'"),
        (model('<geom type="box" size="1 1 -1"/>'), "yard.xml: "),
        (model('<geom size="1"/><geom size="1" material="no"/>'), "expected a model that MuJoCo compiles"),
        (model(""), "no static geom that collides; expected a floor and obstacles"),
        (model('<geom type="plane" size="1 1 .1"/>'), "a world of 2 × 2 × 4 m; expected 3 to 200 m"),
        (
            model('<geom type="plane" size="9 9 .1"/><site name="pad" pos="20 0 0"/>'),
            "the landing pad at [20.0, 0.0] m",
        ),
        (model('<geom size="1" pos="1e9 0 0"/>'), "expected at most 1000 m"),
    ],
)
def test_errors_name_file_and_element(written: Writer, text: str, part: str) -> None:
    found = message(written(text))
    assert "yard.xml" in found and part in found and "expected" in found


def test_infinite_walls_are_refused(written: Writer) -> None:
    geoms = (
        '<geom type="plane" size="9 9 .1"/><geom name="cliff" type="plane" size="0 0 .1" pos="5 0 0" euler="0 -90 0"/>'
    )
    with pytest.raises(ConfigError, match="geom cliff: an infinite plane; expected a floor, or a plane with a size"):
        flight_area(written(model(geoms)), 0)


ATTRIBUTES = st.sampled_from(
    ['size="1"', 'size="nan"', 'type="box"', 'pos="1 1"', 'type="hfield"', 'mesh="wedge"', 'count="3"']
)
ELEMENTS = st.sampled_from(["geom", "body", "frame", "replicate", "joint", "site", "light", "include", "camera", "x"])


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(parts=st.lists(st.tuples(ELEMENTS, st.lists(ATTRIBUTES, max_size=3, unique=True)), max_size=4))
@example(parts=[("body", []), ("joint", ['type="box"'])])
def test_malformed_models_are_errors_for_people(tmp_path: Path, parts: list[tuple[str, list[str]]]) -> None:
    path = tmp_path / "yard.xml"
    path.write_text(model("".join(f"<{name} {' '.join(attributes)}/>" for name, attributes in parts)))
    try:
        resolved_world(str(path))
    except ConfigError as error:
        assert str(path) in str(error)
