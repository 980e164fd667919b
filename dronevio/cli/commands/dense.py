"""``dronevio dense``: the surfaces of a scene from the images and the result of ``dronevio sfm``."""

import shlex
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dronevio.cli.options import Output, OutputOptions
from dronevio.cli.settings.changes import SettingsInput, SettingsOptions
from dronevio.cli.settings.option_tables import DENSE, options_from
from dronevio.cli.terminal import command_line, parse, print_json, print_values, progress_bars
from dronevio.estimator.dense.config import DenseConfig
from dronevio.models.ranges import Range, Settings

if TYPE_CHECKING:
    from dronevio.estimator.dense.pipeline import DenseResult
    from dronevio.models.image_sets import ImageSet
    from dronevio.models.progress import Progress
    from dronevio.models.reconstruction import Reconstruction

Format = Literal["ply", "glb", "obj", "las", "laz", "geotiff"]

SOURCE = "images.json"
"""File of a result of ``dronevio sfm`` that says where its images are."""

TEXTURED: frozenset[Format] = frozenset({"glb", "obj"})
"""Formats of a mesh with a texture."""

DEPTHS = "depths"
"""Folder of a result with the depth maps of the images."""


@dataclass(frozen=True)
class DenseCommand(Settings):
    """Compute the surfaces of a scene from images with known cameras (multi-view stereo).

    SCENE is a folder that `dronevio sfm photographs --out house` wrote, or a COLMAP model or Bundler file of another
    program. The result is a folder with the points as dense.ply, a mesh as mesh.ply, or the files of other formats, a
    report with pictures and a rerun file.

    An interrupted computation continues with the finished depth maps when the same command is repeated. For a scene to
    which images are added later, --keep-depths keeps them, and --add-to uses them again.

    Examples:
      dronevio dense house
      dronevio dense house --views.max-side-px 1600 --mesh.voxel 0.02
      dronevio dense survey --format ply glb laz geotiff
      dronevio dense colmap/sparse/0 --images colmap/images --out surfaces
      dronevio dense house-2 --add-to house/dense
    """

    scene: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE")]
    """Folder that `dronevio sfm` wrote, COLMAP model, or Bundler file."""
    images: Path | None = None
    """Folder of images, video or recording, if SCENE does not say where its images are or they were moved."""
    masks: Path | None = None
    """With --images: folder of masks, or one mask for all images; black parts have no depth."""
    component: Annotated[int, Range(low=0)] = 0
    """Which component of the reconstruction to use, counted from 0; the first has the most images."""
    out: Path | None = None
    """Folder to make; SCENE/dense by default."""
    format: tuple[Format, ...] = ("ply",)
    """Formats of the surfaces: points and mesh as PLY; the mesh with a texture as GLB or OBJ; the points as LAS or LAZ
    (which needs the extra las); orthophoto and height map as GeoTIFF (the extra geo), for scenes in metres whose z
    points up."""
    add_to: Path | None = None
    """Result of an earlier `dronevio dense --keep-depths` of some of the images, whose depth maps are used again where
    the cameras have moved by less than a quarter of a pixel."""
    keep_depths: bool = False
    """Keep the depth maps of the images in the folder depths of the result, for --add-to; 3 MB for each image."""
    output: Output = field(default_factory=OutputOptions)
    """How the result is written and printed."""
    dense: Annotated[DenseConfig, tyro.conf.arg(name="")] = field(
        default_factory=DenseConfig, metadata=options_from(DENSE)
    )
    """Settings of multi-view stereo."""
    changes: SettingsInput = field(default_factory=SettingsOptions)
    """Changes of settings."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(DenseCommand, arguments, "dense")

    from dronevio.cli.output_files import atomic_folder, require_free, resumable
    from dronevio.estimator.array_store import ArrayStore
    from dronevio.estimator.dense.finished import read_finished
    from dronevio.estimator.dense.pipeline import densify
    from dronevio.exports import check_surface_formats
    from dronevio.models.errors import InputError
    from dronevio.models.reconstructions import read_reconstruction

    target = command.out or (command.scene if command.scene.is_dir() else command.scene.parent) / "dense"
    require_free(target, command.output.overwrite)  # before the images are read
    check_surface_formats(command.format, command.scene)
    finished = {} if command.add_to is None else read_finished(command.add_to / DEPTHS)
    reconstruction = read_reconstruction(find_model(command.scene, command.component))
    images = _open(command)
    work = target.absolute().with_name(f".{target.name}.work")
    with resumable(work, "depth maps"), progress_bars(quiet=command.output.json) as bars:
        result = densify(
            images,
            reconstruction,
            command.dense,
            bars.bar,
            ArrayStore(work),
            finished,
            with_texture=not TEXTURED.isdisjoint(command.format),
        )
    if not len(result.cloud):
        shutil.rmtree(work, ignore_errors=True)
        raise InputError(
            command.scene,
            f"{len(reconstruction.image_names)} images without a depth that another image confirms",
            "textured surfaces in three or more images from different positions",
        )
    with atomic_folder(target, command.output.overwrite, mark="report.json") as folder:
        with progress_bars(quiet=command.output.json) as bars:
            _write(folder, target, command, arguments, images, reconstruction, result, bars.bar("writing"))
        if command.keep_depths:
            shutil.copytree(work, folder / DEPTHS)
    shutil.rmtree(work, ignore_errors=True)
    if command.output.json:
        print_json(_summary(target, result))
        return 0
    _print(target, command, result)
    return 0


def find_model(scene: Path, component: int) -> Path:
    """Return the path of the reconstruction of a component in the result of ``dronevio sfm``, or a model itself.

    Raises:
        InputError: There is no such component.
    """
    from dronevio.models.errors import InputError

    if not (scene / "report.json").is_file():
        return scene
    names = (f"colmap-binary/{component}", f"colmap-text/{component}", f"bundle-{component}.out")
    reconstruction = next((scene / name for name in names if (scene / name).exists()), None)
    if reconstruction is None:
        raise InputError(scene, f"no reconstruction of component {component}", f"one of {', '.join(names)}")
    return reconstruction


def _open(command: DenseCommand) -> "ImageSet":
    """Return the images of the scene."""
    from dronevio.models.errors import ConfigError, InputError
    from dronevio.models.image_sets.open import open_images
    from dronevio.models.image_sets.source import read_image_source

    if command.images is not None:
        return open_images(command.images, masks=command.masks)
    if command.masks is not None:
        raise ConfigError("--masks without --images; expected both, or none for the masks of the reconstruction")
    if not (command.scene / SOURCE).is_file():
        raise InputError(command.scene, f"no {SOURCE}", "a folder that `dronevio sfm` wrote, or --images")
    return read_image_source(command.scene / SOURCE).open()


def _write(
    folder: Path,
    target: Path,
    command: DenseCommand,
    arguments: Sequence[str],
    images: "ImageSet",
    reconstruction: "Reconstruction",
    result: "DenseResult",
    progress: "Progress",
) -> None:
    """Write the surfaces, their report and their rerun file."""
    from dronevio import __version__
    from dronevio.estimator.dense.views import ViewLoader
    from dronevio.eval.provenance import RunInfo
    from dronevio.eval.report.dense import DenseResults, write_dense_report
    from dronevio.eval.rerun.dense import write_dense_rerun
    from dronevio.exports import write_surface_files
    from dronevio.models.serialization import to_jsonable
    from dronevio.sfm_inputs import read_world

    origin = read_world(command.scene / "report.json").origin if command.component == 0 else None
    total = len(command.format) + 2
    for done, kind in enumerate(command.format):
        progress(done, total)
        write_surface_files(folder, kind, result, origin)
    info = RunInfo(
        title=f"Surfaces: {command.scene.name}",
        command=shlex.join(["dronevio", "dense", *arguments]),
        open_command=command_line("view", target),
        configuration={"dronevio": __version__, "dense": to_jsonable(command.dense)},
    )
    views = ViewLoader(images, reconstruction, command.dense.views)
    results = DenseResults(
        reconstruction=reconstruction,
        cloud=result.cloud,
        mesh=result.mesh,
        inverse_depths=[depth.inverse_depth for depth in result.depths],
        read_image=lambda i: views(i).colours,
        point_size=result.spacing,
        times_s=result.times_s,
    )
    progress(total - 2, total)
    write_dense_report(folder, info, results)
    progress(total - 1, total)
    rerun = folder / "run.rrd"
    write_dense_rerun(reconstruction, result.cloud, result.mesh, rerun, point_size=result.spacing, name=target.name)
    progress(total, total)


def _summary(target: Path, result: "DenseResult") -> dict[str, Any]:
    return {
        "out": str(target),
        "images": len(result.depths),
        "reused": result.reused,
        "points": len(result.cloud),
        "vertices": len(result.mesh.vertices),
        "triangles": len(result.mesh.triangles),
        "times_s": result.times_s,
    }


_FILES: dict[Format, dict[str, str]] = {
    "ply": {"points": "dense.ply", "mesh": "mesh.ply"},
    "glb": {"mesh": "mesh.glb"},
    "obj": {"mesh": "mesh.obj"},
    "las": {"points": "dense.las"},
    "laz": {"points": "dense.laz"},
    "geotiff": {"map": "orthophoto.tif", "heights": "height.tif"},
}


def _print(target: Path, command: DenseCommand, result: "DenseResult") -> None:
    print_values(
        "Surfaces",
        (
            ("images", f"{len(result.depths)}", ""),
            *((("depth maps reused", f"{result.reused}", ""),) if command.add_to else ()),
            ("points", f"{len(result.cloud)}", ""),
            ("triangles of the mesh", f"{len(result.mesh.triangles)}", ""),
            *((stage, f"{seconds:.1f}", "s") for stage, seconds in result.times_s.items()),
        ),
    )
    for kind in command.format:
        for what, name in _FILES[kind].items():
            print(f"{what + ':':<9} {target}/{name}")
    print(f"report:   {target}/report.html")
    print(f"open it:  {command_line('view', target)}")
