"""The commands of the pages run as they are typed, in the order of their page, and so do those that commands print."""

import fnmatch
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
HOW_TO = CHECKOUT / "docs" / "how-to"

pytestmark = pytest.mark.skipif(not (CHECKOUT / "docs").is_dir(), reason="not a checkout")

PAGES = {
    path.relative_to(CHECKOUT).as_posix(): path.read_text(encoding="utf-8")
    for path in (CHECKOUT / "README.md", *sorted((CHECKOUT / "docs").glob("*.md")), *sorted(HOW_TO.glob("*.md")))
}
QUICK = ("docs/how-to/own-recording.md", "docs/how-to/rerun.md")
"""Pages whose commands take some seconds; those of `SLOW` are run by slow tests."""
SLOW = (
    *("README.md", "docs/dense.md", "docs/getting-started.md", "docs/map.md"),
    *(f"docs/how-to/{name}.md" for name in ("inspect", "other-programs", "own-metric", "own-scenario")),
    *("docs/how-to/own-vehicle.md", "docs/how-to/tune.md"),
)
"""Pages whose commands take a minute or two. Those of other pages take longer, and are parsed only."""

NOT_RUN = {
    "make *": "tests of the checkout run its targets",
    "*tools/uv *": "installs packages",
    "pip install *": "installs packages",
    "dronevio estimate d435i.bag *": "gyroscope and accelerometer apart: tests/models/test_bag_imu.py reads some",
    "dronevio estimate GOPR0001.MP4 *": "a video with telemetry: tests/models/test_gopro.py reads one",
    "dronevio estimate 2011_09_26/*": "a drive of KITTI: tests/models/test_folders.py reads one",
    "dronevio sfm dataset/sequences/07 *": "a sequence of KITTI: tests/models/test_folders.py reads one",
    "dronevio estimate dataset-room1_512_16/dso *": "a folder of DSO: tests/models/test_folders.py reads one",
    "ns-train *": "another program",
    "*dronevio explore*": "minutes a flight: tests/application/test_explore.py runs short ones",
}
"""Lines that are not run, as patterns of the shell, with the reason."""

SHORTENED = {
    r"^\.venv/bin/": "",
    r"^dronevio run$": "dronevio run short --out runs/room-v0-0",
    r"^dronevio fly (?:[a-z]\S+|(?=--plan|--faults))": "dronevio fly short ",
    r"--scenario [a-z]\S+": "--scenario short",
    r" --seeds \d+": "",
    r"--scenarios(?: [a-z]\S+)+": "--scenarios short --seeds 1",
    r"--suite (\w+)": r"--scenarios short --seeds 1 --out benchmarks/\1",
    r" /cam1/image_raw": "",
}
"""Regular expressions of what is replaced in a command, one after the other, to make it shorter."""

INPUTS = {
    "README.md": ("MH_01_easy",),
    "docs/how-to/inspect.md": ("MH_01_easy", "flight.mcap", "camchain.yaml", "imu.yaml", "recordings/room-v0-0"),
    "docs/how-to/other-programs.md": ("photographs",),
    "docs/how-to/own-metric.md": ("MH_01_easy", "estimate.tum"),
    "docs/how-to/own-recording.md": (
        *("MH_01_easy", "dataset-room1_512_16", "tumvi_512_calib.json", "MH_01_easy.bag"),
        *("flight.mcap", "camchain.yaml", "imu.yaml"),
    ),
    "docs/how-to/rerun.md": ("runs/room-v0-0/run.rrd", "recordings/room-v0-3", "estimate.tum", "other.tum"),
    "docs/how-to/tune.md": ("V1_01_easy",),
    "docs/dense.md": ("photographs",),
    "docs/map.md": ("MH_01_easy",),
}
"""Files and folders of the reader that the commands of a page need."""

BEFORE = {
    "dronevio evaluate hall.mcap *": "dronevio estimate hall.mcap --out openvins.tum; cp openvins.tum basalt.tum",
    "dronevio sfm * --add-to house *": "mkdir -p more; cp photographs/*-1.jpg photographs/new-$RANDOM.jpg;"
    " cp photographs/*-2.jpg more/other.jpg",
    "dronevio dense colmap/*": "mkdir -p colmap/sparse; cp -r house/colmap-binary/0 colmap/sparse/0;"
    " cp -r photographs colmap/images",
}
"""What readers or other programs do before a command, by patterns of the shell."""

HINT = re.compile(r"^(?:open|evaluate|estimate) (?:it|one): +(dronevio .*)$", re.MULTILINE)
"""A command that a command prints."""


def lines_of(page: str) -> list[str]:
    """Return the commands in the shell blocks of a page; a block that begins with ``#!`` is a file."""
    blocks = re.findall(r"^```(?:sh|console)\n(.*?)^```$", PAGES[page], re.MULTILINE | re.DOTALL)
    text = "".join(block for block in blocks if not block.startswith("#!")).replace("\\\n", " ")
    return [found[0] for found in re.finditer(r"[^\n]*<<'(\w+)'\n.*?^\1$|[^\n]+", text, re.MULTILINE | re.DOTALL)]


def reason_not_to_run(line: str) -> str | None:
    """Return why a line is not run; None if it is."""
    return next((reason for pattern, reason in NOT_RUN.items() if fnmatch.fnmatchcase(line, pattern)), None)


def shortened(line: str) -> str:
    """Return a command that takes less time."""
    for pattern, replacement in SHORTENED.items():
        line = re.sub(pattern, replacement, line)
    return line


@dataclass(frozen=True)
class Shell:
    """A shell in a folder, in which ``dronevio`` is that of the checkout."""

    folder: Path
    """Current folder."""
    bin: Path
    """Folder of the programs."""

    def run(self, line: str) -> str:
        """Run a line, check that it succeeds, and return what it prints."""
        done = subprocess.run(
            ["bash", "-ec", line],
            cwd=self.folder,
            env=os.environ
            | {"PATH": f"{self.bin}:{Path(sys.executable).parent}:{os.environ['PATH']}", "DISPLAY": ""}
            | {"XDG_CACHE_HOME": str(self.bin.parent / "cache"), "DRONEVIO_WORLD_FILES": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        return done.stdout


@pytest.fixture(scope="session")
def shell_in(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], Shell]:
    """Makes shells, in which a viewer ends at once."""
    programs = tmp_path_factory.mktemp("typed") / "bin"
    programs.mkdir()
    ended = "import os, runpy; os.execv = lambda *words: os._exit(0)"
    program = programs / "dronevio"
    start = f"{ended}; runpy.run_module('dronevio.cli', run_name='__main__')"
    program.write_text(f'#!/bin/sh\nexec {shlex.join([sys.executable, "-c", start])} "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    return lambda folder: Shell(folder, programs)


@pytest.fixture(scope="session")
def inputs(
    shell_in: Callable[[Path], Shell], flown: Any, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    """Gives what stands for an input of the reader, a file or folder that is made when it is first needed."""
    shell = shell_in(tmp_path_factory.mktemp("inputs"))
    truth = flown.folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    flight = shlex.quote(str(flown.folder))
    commands = {
        "flight.mcap": f"dronevio convert {flight} flight.mcap --images raw",
        "camchain.yaml": f"dronevio convert {flight} kalibr --to kalibr && cp kalibr/camchain.yaml .",
        "imu.yaml": f"dronevio convert {flight} kalibr-2 --to kalibr && cp kalibr-2/imu.yaml .",
        "MH_01_easy.bag": f"dronevio convert {flight} bag --to bag; rosbags-convert --src bag --dst MH_01_easy.bag",
        "tumvi_512_calib.json": f"dronevio convert {flight} b --to basalt; mv b/calib.json tumvi_512_calib.json",
        "V1_01_easy": "dronevio fly short --rig euroc-stereo --out V1_01_easy",
        "estimate.tum": f"dronevio estimate {flight} --out estimate.tum",
        "run.rrd": f"dronevio log {flight} {shlex.quote(str(truth))} -o run.rrd",
    }
    given = {
        "examples": CHECKOUT / "examples",
        "measurements": CHECKOUT / "docs" / "measurements",
        "photographs": Path(gtsam.findExampleDataFile("Balbianello/BalbianelloMedium-1.jpg")).parent,
        "groundtruth.csv": truth,
        "imu0.csv": flown.folder / "mav0" / "imu0" / "data.csv",
    }
    alike = {"other.tum": "estimate.tum", "path.tum": "estimate.tum"}

    def give(name: str) -> Path:
        name = alike.get(name, name)
        if name not in commands:
            return Path(given.get(name, flown.folder))
        if not (shell.folder / name).exists():
            shell.run(commands[name])
        return shell.folder / name

    return give


def prepared(page: str, folder: Path, inputs: Callable[[str], Path]) -> None:
    """Put the files that a page shows, and its inputs, into a folder."""
    for name, text in re.findall(r"The file\s`([\w-]+\.\w+)`:\n\n```\w+\n(.*?)^```$", PAGES[page], re.M | re.S):
        (folder / name).write_text(text, encoding="utf-8")
    for name in INPUTS.get(page, ()):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        source = inputs(Path(name).name)
        shutil.copytree(source, folder / name) if source.is_dir() else shutil.copy(source, folder / name)


@pytest.mark.parametrize(
    "page", [*QUICK, *(pytest.param(page, marks=(pytest.mark.slow, pytest.mark.timeout(900))) for page in SLOW)]
)
def test_commands_of_a_page_run(
    page: str, tmp_path: Path, inputs: Callable[[str], Path], shell_in: Callable[[Path], Shell]
) -> None:
    lines = [shortened(line) for line in lines_of(page) if reason_not_to_run(line) is None]
    prepared(page, tmp_path, inputs)
    shell = shell_in(tmp_path)
    for line in lines:
        for pattern, before in BEFORE.items():
            if fnmatch.fnmatchcase(line, pattern):
                shell.run(before)
        for hint in HINT.findall(shell.run(line)):
            words = shlex.split(hint)
            assert [word for word in words[2:] if not (tmp_path / word).exists()] == [], hint
            if words[1] == "view":
                shell.run(hint)


def test_tables_of_what_is_not_typed_have_no_stale_entries() -> None:
    lines = [line for page in (*QUICK, *SLOW) for line in lines_of(page)]
    stale = [pattern for pattern in NOT_RUN if not fnmatch.filter(lines, pattern)]
    run = [line for line in lines if reason_not_to_run(line) is None]
    stale += [pattern for pattern in SHORTENED if not any(re.search(pattern, line) for line in run)]
    stale += [pattern for pattern in BEFORE if not fnmatch.filter(map(shortened, run), pattern)]
    stale += [
        name
        for page, names in INPUTS.items()
        for name in names
        if page not in (*QUICK, *SLOW) or name.partition("/run.rrd")[0] not in PAGES[page]
    ]
    assert stale == []


def test_reasons_name_tests_that_exist() -> None:
    named = [path for reason in NOT_RUN.values() for path in re.findall(r"tests/\S+\.py", reason)]
    assert named and [path for path in named if not (CHECKOUT / path).is_file()] == []


@pytest.mark.parametrize(
    "lines",
    [
        (
            "dronevio estimate 'a flight' --out 'an estimate.tum'",
            "dronevio log 'a flight' 'an estimate.tum' -o 'a log.rrd'",
        ),
        pytest.param(("dronevio book sfm --out 'a villa'",), marks=pytest.mark.slow),
        pytest.param(("dronevio fly short --out 'another flight'",), marks=pytest.mark.slow),
        pytest.param(
            ("dronevio refly --trajectory 'a flight' --out 'a refly' --duration-s 5",), marks=pytest.mark.slow
        ),
        pytest.param(("dronevio run short --out 'a run'",), marks=pytest.mark.slow),
        pytest.param(("dronevio map 'a flight' --out 'a map'",), marks=pytest.mark.slow),
        pytest.param(("dronevio sfm photographs --out 'a house'", "dronevio dense 'a house'"), marks=pytest.mark.slow),
    ],
    ids=lambda lines: lines[-1].split()[1],
)
def test_printed_commands_run_where_names_have_spaces(
    lines: tuple[str, ...],
    tmp_path: Path,
    flown: Any,
    inputs: Callable[[str], Path],
    shell_in: Callable[[Path], Shell],
) -> None:
    (tmp_path / "a flight").symlink_to(flown.folder)
    (tmp_path / "photographs").symlink_to(inputs("photographs"))
    shell = shell_in(tmp_path)
    for line in lines:
        [hint] = HINT.findall(shell.run(line))
        shell.run(hint)
