"""Time and memory of structure from motion as the number of images grows, beside COLMAP.

The first n moving frames of a recording with ground truth, at a fixed interval, are reconstructed from one camera with
its calibration, by each program in a process of its own. Neighbours in the sequence and similar images are matched; by
COLMAP (pycolmap) the neighbours of its sequential matcher alone, since its vocabulary tree is a file to download. The
error is the root mean square distance of the camera positions from the true ones after a similarity transformation.
Memory is the largest resident size of the process::

    .venv/bin/python benchmarks/many_images.py RECORDING --counts 100 250 500 1000 --colmap 250 1000
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before NumPy is imported

import multiprocessing
import resource
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from measuring import opened, print_as_made
from sfm_accuracy import Outcome, colmap, moving_frames, ours, true_positions

from dronevio.models.image_sets import image_recording

Program = Literal["dronevio", "COLMAP", "COLMAP, global mapper"]


@dataclass(frozen=True)
class ManyImagesCommand:
    """Measure time and memory of structure from motion for numbers of images."""

    recording: Annotated[Path, tyro.conf.Positional]
    """Recording with ground truth and velocities."""
    counts: tuple[int, ...] = (100, 250, 500, 1000)
    """Numbers of images for this project."""
    colmap: tuple[int, ...] = (100, 1000)
    """Numbers of images for COLMAP."""
    colmap_global: tuple[int, ...] = (1000,)
    """Numbers of images for COLMAP with its global mapper (GLOMAP)."""


def reconstructed(program: Program, recording: Path, count: int, most: int) -> tuple[Outcome, float]:
    """Return the reconstruction of the first of some frames and the largest resident memory of this process [MB].

    Args:
        program: The program.
        recording: Recording with ground truth.
        count: Number of frames.
        most: Number of frames that are spread over the whole recording, which determines their interval.
    """
    opened_recording, truth = opened(recording)
    frames = moving_frames(opened_recording, most)[:count].tolist()
    images = image_recording(opened_recording, frames=frames)
    true, _ = true_positions(truth, images)
    if program == "dronevio":
        outcome = ours(images, true)
    else:
        with tempfile.TemporaryDirectory() as folder:
            [outcome] = colmap(images, true, None, Path(folder) / "colmap", 1, is_global=program != "COLMAP")
    return outcome, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def rows(command: ManyImagesCommand) -> Iterator[dict[str, str]]:
    """Yield a row for each program and number of images."""
    counts: dict[Program, tuple[int, ...]] = {
        "dronevio": command.counts,
        "COLMAP": command.colmap,
        "COLMAP, global mapper": command.colmap_global,
    }
    most = max(map(max, filter(None, counts.values())))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, max_tasks_per_child=1) as pool:
        for program, count in [(program, n) for program, numbers in counts.items() for n in numbers]:
            outcome, memory_mb = pool.submit(reconstructed, program, command.recording, count, most).result()
            yield {
                "program": program,
                "images": str(count),
                "registered": str(outcome.registered),
                "RMSE [mm]": f"{outcome.rmse_mm:.1f}",
                **{f"{stage} [s]": f"{outcome.times_s[stage]:.0f}" for stage in ("features", "matching", "mapping")},
                "processor [s]": f"{outcome.cpu_s:.0f}",
                "an image [s]": f"{outcome.cpu_s / count:.3f}",
                "memory [MB]": f"{memory_mb:.0f}",
            }


if __name__ == "__main__":
    print_as_made(rows(tyro.cli(ManyImagesCommand, description=__doc__)))
