"""Call the command line with wrong arguments and damaged files, and print a Markdown table of what it answers.

Every call must end with exit code 2 and one line on standard error that begins with ``dronevio:``, print nothing on
standard output, and leave no file behind; otherwise the script ends with exit code 1::

    python benchmarks/bad_inputs.py                        # flies the scenario "short" first
    python benchmarks/bad_inputs.py --recording RECORDING  # an EuRoC folder of dronevio
    python benchmarks/bad_inputs.py --only png evaluate    # those whose names contain one of the words
"""

import contextlib
import io
import shutil
import sys
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from dronevio.cli import main as dronevio

Change = Callable[[Path], None]
OPTIONS = (
    "--estimator.smoother.max-keyframes 0",
    "--estimator.smoother.max-keyframes 1",
    "--estimator.smoother.max-keyframes nine",
    "--set estimator.smoother.iterations=1000000000",
    "--estimator.tracker.corners.cell-px 0",
    "--estimator.tracker.window-px 0",
    "--estimator.tracker.window-px 4",
    "--estimator.tracker.window-px 100000",
    "--estimator.tracker.pyramid-levels -1",
    "--set estimator.tracker.min-tracked-ratio=nan",
    "--estimator.health.max-inertial-sigma-m -1",
    "--estimator.preintegration.accel-noise-inflation -1",
    "--set estimator.calibration.gravity.sigma=0",
    "--set estimator.initialization.dynamic.max-frames=1",
    "--set estimator.smoother.max-keyframe=9",
    "--set estimator.smoother.max-keyframes",
    "--set estimator.smoother=9",
    "--settings missing.toml",
    "--estimator.gravity-m-s2 inf",
    "--cameras 9",
    "--cameras left",
    "--keyframes 9",
    "--imu none",
)
"""Wrong options of ``dronevio estimate``."""
COMMANDS = (
    "sing",
    "estimate",
    "estimate nothing",
    "fly --scenario nowhere",
    "fly --world mars",
    "fly --rig none",
    "fly --imu none",
    "fly --vehicle blimp",
    "fly --seed -1",
    "fly --plan.shape knot",
    "fly --plan.laps 0",
    "fly --plan.limits.speed-m-s nan",
    "fly --wind.mean-m-s 1 2 900",
    "fly --faults.dropped-frames 1",
    "fly --imaging.exposure-s 0",
    "run --policy nothing.safetensors",
    "run --loop.frame-latency-s -1",
    "benchmark --seeds 0",
    "benchmark --suite nothing",
    "benchmark --scenarios hover --estimators nobody",
    "benchmark --recordings nothing",
    "compare nothing nobody",
    "gate nothing --baseline nobody",
    "report nothing",
    "report nothing --format pdf",
    "view nothing",
    "view nothing --port 99999",
    "sfm nothing",
    "sfm . --every 0",
    "dense nothing",
    "convert nothing nowhere",
    "log nothing nobody",
    "refly --trajectory nothing",
    "policy evaluate nothing",
    "worlds --world mars",
    "speed gym --runs 0",
    "book imu --duration-s 1",
)
"""Whole wrong commands."""


@dataclass(frozen=True)
class Case:
    """A wrong input."""

    name: str
    """What is wrong, for the table."""
    arguments: tuple[str, ...]
    """The words after ``dronevio``, in a folder with ``recording`` and, if it is damaged, ``damaged``."""
    damage: Change | None = None
    """Damages the folder ``damaged``, a copy of the recording."""


@dataclass(frozen=True)
class Answer:
    """What the command line answers to a wrong input."""

    case: Case
    """The input that was given."""
    code: int
    """Exit code of the command."""
    out: str
    """Text on standard output."""
    err: str
    """Text on standard error."""
    left: tuple[str, ...]
    """Files that the command left behind."""

    @property
    def is_right(self) -> bool:
        """Whether the answer is one line and exit code 2, and nothing is left behind."""
        one_line = self.err.startswith("dronevio: ") and self.err.count("\n") == 1 and self.err.endswith("\n")
        return self.code == 2 and one_line and not self.out and not self.left


@dataclass(frozen=True)
class BadInputsCommand:
    """Call the command line with wrong inputs and print a Markdown table of exit codes and messages."""

    recording: Path | None = None
    """EuRoC folder with images of 752 × 480 px; by default the scenario "short" is flown."""
    only: tuple[str, ...] = ()
    """Words; only cases are tried whose names contain one of them."""


def cases() -> list[Case]:
    """Return all wrong inputs."""
    options = [Case(f"estimate … {words}", ("estimate", "recording", *words.split())) for words in OPTIONS]
    commands = [Case(words, tuple(words.split())) for words in COMMANDS]
    sensor, imu = "mav0/cam0/sensor.yaml", "mav0/imu0/data.csv"
    noise, late = "gyroscope_noise_density: ", "9e8 0 0 0 0 0 0 1\n9.1e8 0 0 0 0 0 0 1\n"
    damaged = [
        Case(f"{command}: {name}", tuple(command.split()), damage)
        for name, command, damage in (
            ("PNG of 60000 × 60000 px", "estimate damaged", lambda folder: _first_image(folder, png(60_000, 60_000))),
            ("PNG cut off", "estimate damaged --strict", lambda folder: _first_image(folder, png(752, 480)[:-9])),
            ("IMU file empty", "estimate damaged", _replaced(imu, "")),
            ("IMU file with words", "estimate damaged", _replaced(imu, "#t\n1,a,b,c,d,e,f\n")),
            ("IMU file with NaN", "estimate damaged --strict", _nan_sample),
            ("IMU file with float stamps", "estimate damaged", _replaced(imu, "0.005,0,0,0,0,0,9.8\n")),
            ("no sensor.yaml", "estimate damaged", lambda folder: (folder / sensor).unlink()),
            ("five intrinsics", "estimate damaged", _edited(sensor, "intrinsics: [", "intrinsics: [-1.0, ")),
            ("noise density 0", "estimate damaged", _edited("mav0/imu0/sensor.yaml", noise, f"{noise}0 # ")),
            ("file is no bag", "estimate damaged/flight.mcap", _replaced("flight.mcap", "no bag")),
            ("ROS 1 bag", "estimate damaged/flight.bag", _replaced("flight.bag", "#ROSBAG V2.0\n")),
            ("estimate with words", "evaluate recording damaged/e.tum", _replaced("e.tum", "0.0 a b c 0 0 0 1\n")),
            ("estimate with NaN", "evaluate recording damaged/e.tum", _replaced("e.tum", "0.0 nan 0 0 0 0 0 1\n")),
            ("estimate of another time", "evaluate recording damaged/e.tum", _replaced("e.tum", late)),
            ("lengths of 0 m", "evaluate recording damaged/e.tum --lengths-m 0", _replaced("e.tum", late)),
            ("damaged policy", "policy show damaged/p.safetensors", _replaced("p.safetensors", "no policy")),
            ("damaged photograph", "sfm damaged/photos", _replaced("photos/a.jpg", "no image")),
        )
    ]
    return [*options, *commands, *damaged]


def png(width: int, height: int) -> bytes:
    """Return a grey PNG whose pixels are missing beyond the first rows."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    rows = zlib.compress(bytes(width + 1))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def answers(recording: Path, chosen: Sequence[Case]) -> Iterator[Answer]:
    """Yield the answers to wrong inputs.

    Args:
        recording: An EuRoC folder.
        chosen: The inputs.
    """
    for case in chosen:
        with tempfile.TemporaryDirectory(prefix="bad-inputs-") as place, contextlib.chdir(place):
            Path("recording").symlink_to(recording.absolute(), target_is_directory=True)
            if case.damage is not None:
                shutil.copytree(recording, "damaged")
                case.damage(Path("damaged"))
            before = _files()
            with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
                code = dronevio(case.arguments)
            left = tuple(sorted(_files() - before))
        yield Answer(case, code, out.getvalue(), err.getvalue(), left)


def _files() -> set[str]:
    """Return the names of all files and folders in the current folder."""
    return {str(path) for path in Path().rglob("*")}


def _first_image(folder: Path, data: bytes) -> None:
    """Replace the first image of the first camera."""
    sorted((folder / "mav0/cam0/data").glob("*.png"))[0].write_bytes(data)


def _replaced(file: str, text: str) -> Change:
    """Return the change that writes a text to a file."""

    def change(folder: Path) -> None:
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_text(text, encoding="utf-8")

    return change


def _edited(file: str, old: str, new: str) -> Change:
    """Return the change that replaces a part of a file."""

    def change(folder: Path) -> None:
        text = (folder / file).read_text(encoding="utf-8")
        if old not in text:
            raise ValueError(f"no {old!r} in {file}")
        (folder / file).write_text(text.replace(old, new, 1), encoding="utf-8")

    return change


def _nan_sample(folder: Path) -> None:
    """Replace the angular velocity of the tenth IMU sample."""
    file = folder / "mav0/imu0/data.csv"
    lines = file.read_text(encoding="utf-8").splitlines()
    stamp, _, rest = lines[10].split(",", 2)
    lines[10] = f"{stamp},nan,{rest}"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def main(command: BadInputsCommand) -> int:
    """Print the table and return the exit code: 1 if an answer is wrong."""
    chosen = [case for case in cases() if not command.only or any(word in case.name for word in command.only)]
    with tempfile.TemporaryDirectory(prefix="bad-inputs-flight-") as place:
        recording = command.recording
        if recording is None:
            recording = Path(place) / "flight"
            with contextlib.redirect_stdout(io.StringIO()):
                dronevio(["fly", "--scenario", "short", "--out", str(recording)])
        print("| wrong input | exit code | message |\n| --- | ---: | --- |")
        wrong = 0
        for answer in answers(recording, chosen):
            message = " ⏎ ".join(answer.err.splitlines()).removeprefix("dronevio: ").replace("|", "\\|")
            left = f" (left behind: {', '.join(answer.left)})" if answer.left else ""
            mark = "" if answer.is_right else "**wrong** "
            print(f"| `{answer.case.name}` | {mark}{answer.code} | {message[:300]}{left} |", flush=True)
            wrong += not answer.is_right
    print(f"\n{len(chosen)} wrong inputs, {wrong} of them with another answer than one line and exit code 2")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(BadInputsCommand)))
