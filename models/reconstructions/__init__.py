"""Reconstructions of scenes as files: models of COLMAP, Bundler and nerfstudio, and point clouds and meshes."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.models.reconstructions.bundler import read_bundler, write_bundler
    from dronevio.models.reconstructions.colmap import read_colmap, write_colmap
    from dronevio.models.reconstructions.colmap_rigs import RigFrames
    from dronevio.models.reconstructions.formats import (
        ReconstructionFormat,
        SurfaceFormat,
        read_reconstruction,
        write_reconstruction,
        write_surfaces,
    )
    from dronevio.models.reconstructions.nerfstudio import write_nerfstudio
    from dronevio.models.reconstructions.openmvs import write_openmvs
    from dronevio.models.reconstructions.ply import read_ply, write_ply

__all__ = [
    "ReconstructionFormat",
    "RigFrames",
    "SurfaceFormat",
    "read_bundler",
    "read_colmap",
    "read_ply",
    "read_reconstruction",
    "write_bundler",
    "write_colmap",
    "write_nerfstudio",
    "write_openmvs",
    "write_ply",
    "write_reconstruction",
    "write_surfaces",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.models.reconstructions.bundler": ("read_bundler", "write_bundler"),
        "dronevio.models.reconstructions.colmap": ("read_colmap", "write_colmap"),
        "dronevio.models.reconstructions.colmap_rigs": ("RigFrames",),
        "dronevio.models.reconstructions.formats": (
            "ReconstructionFormat",
            "SurfaceFormat",
            "read_reconstruction",
            "write_reconstruction",
            "write_surfaces",
        ),
        "dronevio.models.reconstructions.nerfstudio": ("write_nerfstudio",),
        "dronevio.models.reconstructions.openmvs": ("write_openmvs",),
        "dronevio.models.reconstructions.ply": ("read_ply", "write_ply"),
    },
)
