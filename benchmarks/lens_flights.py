"""Fly one flight with each lens, and compare the errors of the odometry on its images.

The flight, its IMU samples and the scale of the images at their centre are the same for all lenses, so that the errors
should be similar. Each recording is rendered once, below FOLDER::

    python benchmarks/lens_flights.py FOLDER
    python benchmarks/lens_flights.py FOLDER --scenario room-medium --seed 3 --frames 300
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from measuring import table
from rendered_conditions import render

from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimators.driver import estimate_recording
from dronevio.eval.metrics.scores import score
from dronevio.models.camera import CameraModel
from dronevio.models.errors import EvaluationError
from dronevio.models.lenses.lens import LENSES, LensName
from dronevio.models.recordings import open_recording
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import rig_named
from dronevio.models.state import Health
from dronevio.sim.scenarios import scenario_named

SIZE_PX = (376, 240)
FOCAL_PX = 170.0
"""Focal length at the centre of the image [px]."""
COEFFICIENTS: Mapping[str, tuple[LensName, tuple[float, ...]]] = {
    "equidistant": ("equidistant", (-0.01, 0.004, -0.002, 0.0002)),
    "radtan": ("radtan", (-0.25, 0.06, 2e-4, -1e-4)),
    "radtan with k3": ("radtan", (-0.27, 0.09, 2e-4, -1e-4, -0.012)),
    "rational": ("radtan", (0.4, 0.05, 5e-4, -5e-4, 0.001, 0.7, 0.1, 0.002)),
    "fov": ("fov", (0.93,)),
    "ds": ("ds", (-0.172, 0.593)),
    "eucm": ("eucm", (0.63, 1.04)),
    "omni": ("omni", (1.6, -0.2, 0.1, 1e-3, -1e-3)),
}
"""Lenses and coefficients by name; those of ``ds`` and ``eucm`` are of TUM-VI's cameras."""


@dataclass(frozen=True)
class LensFlightsCommand:
    """Render a flight with each lens, run the odometry with one and two cameras, and print a table."""

    folder: tyro.conf.Positional[Path]
    """Folder of the recordings, which is made if it does not exist."""
    scenario: str = "room-medium"
    """Name of the scenario."""
    seed: int = 0
    """Seed of the flight."""
    frames: int = 240
    """Number of frames, from the first on."""
    lenses: tuple[str, ...] = tuple(COEFFICIENTS)
    """Names of the lenses."""


def rig_with(name: str) -> Rig:
    """Return a level stereo rig with a lens."""
    lens, coefficients = COEFFICIENTS[name]
    f = FOCAL_PX / LENSES[lens].central_scale(coefficients)
    width, height = SIZE_PX
    model = CameraModel(width, height, f, f, 0.5 * width - 2.0, 0.5 * height + 1.5, coefficients, lens)
    rig = rig_named("pinhole-stereo")
    return replace(rig, cameras=tuple(replace(camera, model=model) for camera in rig.cameras))


def row_of(name: str, folder: Path) -> tuple[str, ...]:
    """Return the row of a lens: field of view, errors and health with one and with two cameras."""
    recording = open_recording(folder)
    assert recording.ground_truth is not None
    cells = []
    for cameras in (1, 2):
        part = open_recording(folder, cameras=cameras)
        run = estimate_recording(part, VisualInertialOdometry(part.rig))
        tracking = sum(estimate.health is Health.TRACKING for estimate in run.estimates)
        try:
            scores = score(recording.ground_truth, run.trajectory, part.frame_times_ns)
            cells += [f"{1e3 * float(scores.ate_m.rmse):.1f}", f"{100.0 * tracking / len(run.trajectory):.0f}"]
        except EvaluationError:
            cells += ["–", "–"]
    return (name, *cells)


def main(command: LensFlightsCommand) -> int:
    """Render and estimate all lenses."""
    rows = []
    for name in command.lenses:
        folder = command.folder / f"{command.scenario}-{command.seed}-{name.replace(' ', '-')}"
        if not folder.exists():
            print(f"rendering {folder}", file=sys.stderr, flush=True)
            scenario = replace(scenario_named(command.scenario, command.seed), rig=rig_with(name))
            render(scenario, folder, command.frames)
        rows.append(row_of(name, folder))
        print("  ".join(rows[-1]), file=sys.stderr, flush=True)
    headings = ("lens", "ATE, one camera [mm]", "tracking [%]", "ATE, two cameras [mm]", "tracking [%]")
    print(table(headings, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(LensFlightsCommand, description=__doc__)))
