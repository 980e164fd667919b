"""Worlds of one's own, by the page that describes them: commands, environments and recordings."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dronevio.autonomy.exploration import exploration_scenario
from dronevio.cli import main
from dronevio.envs import DroneEnv, DroneVectorEnv, Navigate, Termination
from dronevio.models.recordings.scenario_file import world_of
from dronevio.sim.envs.sensing.range_beams import BeamSettings
from dronevio.sim.ray_casting import RayCaster
from dronevio.sim.world import flight_area, resolved_world
from dronevio.sim.worlds.own.names import recorded_world

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "own-world.md"
FORWARD = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
Result = Any  # the class of conftest, which cannot be imported
CommandRunner = Callable[..., Result]

pytestmark = pytest.mark.skipif(not PAGE.exists(), reason="not a checkout")


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files of the page, which is the current one."""
    for name, text in re.findall(r"The file `(\w+\.\w+)`:\n\n```\w+\n(.*?)^```$", PAGE.read_text("utf-8"), re.M | re.S):
        (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def crashes(env: Any, seeds: range) -> int:
    """Return the number of episodes that end by a collision in straight flight."""
    count = 0
    for seed in seeds:
        env.reset(seed=seed)
        ended = False
        while not ended:
            _, _, terminated, truncated, info = env.step(FORWARD)
            ended = terminated or truncated
        count += info["termination"] == Termination.COLLISION
    return count


def test_the_example_is_short_and_spacious(here: Path) -> None:
    assert len((here / "yard.yaml").read_text().splitlines()) <= 30
    for seed in range(4):
        area = flight_area("yard.yaml", seed)
        assert (np.ptp(area.free_box, axis=0) > 2.0).all()
        assert (np.ptp(area.route[:, :2], axis=0) > [9.0, 7.0]).all()


@pytest.mark.parametrize("name", ["yard.yaml", "yard.xml", "python:my_worlds:DIM_ROOM"])
def test_worlds_are_listed(here: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["worlds", "--world", name, "--json"]) == 0
    [row] = json.loads(capsys.readouterr().out)["worlds"]
    assert row["name"].startswith(name + "#") and str(here) not in row["name"]
    assert main(["worlds", "--world", name]) == 0
    assert "#" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (["run", "--world", "no.yaml"], "no.yaml: no such file; expected a world in YAML or MJCF"),
        (["fly", "--world", "bad.yaml"], "bad.yaml:1: unknown field sise_m; expected some of size_m, outdoors"),
        (["worlds", "--world", "bad.xml"], "bad.xml: MJCF: the element 'robot'; expected MJCF"),
        (["explore", "bad.yaml"], "bad.yaml:1: unknown field sise_m"),
        (["run", "--world", "yard.yaml#0123456789abcdef"], "expected 0123456789abcdef, as it was recorded"),
        (["run", "--world", "gone.yaml#0123456789abcdef"], "there is no file gone.yaml in "),
    ],
)
def test_wrong_files_are_one_line(
    here: Path, arguments: list[str], part: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "bad.yaml").write_text("sise_m: [9, 9, 3]\n")
    (here / "bad.xml").write_text("<robot/>\n")
    assert main(arguments) == 2
    shown = capsys.readouterr().err
    assert part in shown and "Traceback" not in shown and len(shown.strip().splitlines()) == 1


def test_an_environment_in_a_file_passes_the_check_and_has_its_obstacles(here: Path) -> None:
    empty = "size_m: [9, 9, 4]\noutdoors: true\nobstacles:\n"
    sides = [("[8, 0.3, 3]", x) for x in ("[0, 3.8]", "[0, -3.8]")] + [
        ("[0.3, 8, 3]", x) for x in ("[3.8, 0]", "[-3.8, 0]")
    ]
    box = "  - {{shape: box, size_m: {}, position_m: {}}}\n"
    (here / "cell.yaml").write_text(empty + "".join(box.format(*side) for side in sides))
    (here / "open.yaml").write_text(empty + box.format("[0.1, 0.1, 0.1]", "[4.4, 4.4]"))
    settings: dict[str, Any] = {"task": Navigate(distance_m=(0.8, 2.0), episode_s=8.0), "observations": ("goals",)}
    env = gymnasium.make("dronevio.envs:dronevio/Navigate-v0", world="cell.yaml", **settings)
    check_env(env.unwrapped, skip_render_check=True)
    assert crashes(env, range(3)) > crashes(DroneEnv(world="open.yaml", **settings), range(3)) == 0


def test_vectors_and_worker_processes_have_the_same_world(here: Path) -> None:
    settings: dict[str, Any] = {"world": "yard.yaml", "world_seed": 2, "observations": ("goals", "ranges")}
    envs = DroneVectorEnv(2, "navigate", **settings)
    workers: Any = gymnasium.make_vec(
        "dronevio.envs:dronevio/Navigate-v0", num_envs=2, vectorization_mode="async", **settings
    )
    try:
        apart, single = workers.reset(seed=[4, 5])[0], DroneEnv(Navigate(), **settings)
        for row, seed in enumerate((4, 5)):
            expected = single.reset(seed=seed)[0]
            for name in ("goals", "ranges"):
                np.testing.assert_array_equal(apart[name][row], expected[name])
        assert envs.reset(seed=4)[0]["ranges"].shape == apart["ranges"].shape
    finally:
        workers.close()


def test_range_beams_and_maps_see_an_edited_file(here: Path) -> None:
    def seen(text: str) -> np.ndarray:
        (here / "cell.yaml").write_text(text)
        beams = BeamSettings(field_deg=(360.0, 45.0), reach_m=30.0, lost=0.0)
        settings: dict[str, Any] = {"world": "cell.yaml", "observations": ("ranges", "local_map"), "beams": beams}
        env = DroneEnv(Navigate(distance_m=(1.0, 3.0)), **settings)
        return np.asarray(env.reset(seed=0)[0]["ranges"])

    small, large = seen("size_m: [5, 5, 3]"), seen("size_m: [16, 16, 4]")
    assert large.max() > 8.0 > small.max() > 0.5  # the diagonals are 7.1 m and 22.6 m


def test_scenarios_of_explorations_are_of_the_file(here: Path) -> None:
    scenario = exploration_scenario("yard.yaml", 1)
    assert scenario.name == "explore-yard-v0"
    assert scenario.world == resolved_world(str(here / "yard.yaml"))


def test_the_folder_of_an_exploration_has_the_name_of_the_world(
    here: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    monkeypatch.chdir(elsewhere)
    words = ["--no-images", "--time-s", "1", "--goal", "6", "4", "1.5"]
    assert main(["explore", str(here / "yard.yaml"), *words]) == 0
    assert [path.name for path in (elsewhere / "runs").iterdir()] == ["explore-yard-0"]


@pytest.mark.slow
def test_a_run_in_a_file_is_recorded_with_its_name_and_hash(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--scenario", "short", "--world", "yard.yaml", "--world-seed", "3", "--plan.tour-s", "2"]
    assert main(["run", *arguments, "--out", "run", "--keep-recording", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["run"] == "run"
    stated = recorded_world(resolved_world("yard.yaml"))
    assert world_of(here / "run" / "recording") == (stated, 3)
    configuration = json.loads((here / "run" / "configuration.json").read_text())
    assert configuration["scenario"]["world"] == stated
    RayCaster(*world_of(here / "run" / "recording"))
    trajectory = ["--trajectory", "run/groundtruth.tum", "--duration-s", "1"]
    assert main(["refly", *trajectory, "--world", "yard.xml", "--out", "flown", "--json"]) == 0
    written = json.loads((here / "flown" / "scenario.json").read_text())["refly"]
    assert written["world"] == recorded_world(resolved_world("yard.xml"))


@pytest.mark.slow
def test_a_contact_sheet_is_drawn_by_workers(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("yard.yaml", "python:my_worlds:DIM_ROOM"):
        assert main(["worlds", "--world", name, "--sheet", "sheet.png", "--json"]) == 0
        assert (here / "sheet.png").stat().st_size > 100_000
