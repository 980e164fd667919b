"""``dronevio inspect``: what a recording holds, and whether the odometry will work on it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dronevio.cli.options import Printing, PrintOptions, RecordingInput, RecordingOptions
from dronevio.cli.terminal import parse, print_json, print_table, progress_bars

if TYPE_CHECKING:
    from dronevio.inspection.model import Inspection


@dataclass(frozen=True)
class InspectCommand:
    """Tell what a recording holds, whether the odometry will work on it, and what to do if not.

    Images, IMU, clocks, calibration, motion and ground truth are checked without a run of the odometry: about 240
    frames in runs spread over the recording, and all IMU samples and time stamps. Each row of the table has
    a verdict, with what was found and what to do; the page has what is expected, and plots, beside. With --run, the
    odometry estimates the first 30 s as well.

    The exit code is 0 whatever is found. With --strict, it is 1 if a row is wrong.

    Examples:
      dronevio inspect V1_01_easy
      dronevio inspect flight.mcap --calibration camchain.yaml imu.yaml --out flight.html
      dronevio inspect recordings/room-v0-0 --run
      dronevio inspect recordings/room-v0-0 --json --strict
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """Folder of EuRoC, TUM-VI, DSO or KITTI, bag of ROS 1 or ROS 2, or GoPro video."""
    out: Path = Path("inspection.html")
    """Page to write, a single file."""
    run: bool = False
    """Run the odometry over the first 30 s, too."""
    strict: bool = False
    """End with exit code 1 if a row is wrong."""
    reading: RecordingInput = field(default_factory=RecordingOptions)
    """How the recording is read."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(InspectCommand, arguments, "inspect")

    from dronevio.inspection.inspection import inspect
    from dronevio.inspection.model import Verdict
    from dronevio.models.recordings.files import check_output_path, write_text

    check_output_path(command.out)
    recording = command.reading.open(command.recording, repair=True)
    with progress_bars(quiet=command.printing.json) as bars:
        inspection = inspect(recording, run=command.run, progress=bars.bar)
    write_text(command.out, inspection.page)
    if command.printing.json:
        print_json({**inspection.as_values(), "page": str(command.out)})
    else:
        _print(inspection, command)
    return int(command.strict and inspection.verdict is Verdict.WRONG)


def _print(inspection: "Inspection", command: InspectCommand) -> None:
    """Print the rows and the summary."""
    from dronevio.inspection.model import Verdict

    columns = ("topic", "property", "verdict", "found")
    rows = [
        (
            str(each.topic),
            each.name,
            str(each.verdict),
            f"{each.found}. To do: {each.advice}" if each.advice else each.found,
        )
        for each in inspection.findings
    ]
    print_table(f"Inspection of {inspection.name}", columns, rows, left=columns[1:])
    counts = {verdict: sum(f.verdict is verdict for f in inspection.findings) for verdict in Verdict}
    print(", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count))
    print(inspection.summary[0].upper() + inspection.summary[1:])
    print(f"wrote {command.out}")
