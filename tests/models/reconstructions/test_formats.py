"""The entry points for all formats, and the recognition of files."""

from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models import read_reconstruction, write_reconstruction
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import ReconstructionFormat

Make = Callable[..., Reconstruction]

CENTRED = CameraModel(640, 480, 500.0, 500.0, 319.5, 239.5, (-0.1, 0.02, 0.0, 0.0))


WRITTEN_ONLY = ("nerfstudio", "openmvs")


@pytest.mark.parametrize("form", [form for form in get_args(ReconstructionFormat) if form not in WRITTEN_ONLY])
@pytest.mark.parametrize("name", ["model", "bundle.out"])
def test_what_is_written_is_recognized(tmp_path: Path, scene: Make, form: ReconstructionFormat, name: str) -> None:
    before = scene(CENTRED)
    write_reconstruction(before, str(tmp_path / name), form)
    after = read_reconstruction(str(tmp_path / name))
    np.testing.assert_array_equal(after.points, before.points)
    if form != "ply":
        errors = np.sort(before.reprojection_errors_px())
        np.testing.assert_allclose(np.sort(after.reprojection_errors_px()), errors, atol=1e-9)


def test_a_folder_with_a_file_of_bundler(tmp_path: Path, scene: Make) -> None:
    write_reconstruction(scene(CENTRED), tmp_path / "bundle.out", "bundler")
    assert read_reconstruction(tmp_path).image_names == scene().image_names


def test_other_paths_and_formats_are_refused(tmp_path: Path, scene: Make) -> None:
    (tmp_path / "notes.txt").write_text("no reconstruction")
    for path in (tmp_path, tmp_path / "missing", tmp_path / "notes.txt", tmp_path / "a\0b"):
        with pytest.raises(InputError, match="expected a folder of a COLMAP model, a file of Bundler"):
            read_reconstruction(path)
    with pytest.raises(ConfigError, match="format 'nvm'; expected one of colmap-text, colmap-binary, bundler, ply"):
        write_reconstruction(scene(), tmp_path / "a", "nvm")  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"notes\.txt"):
        write_reconstruction(scene(), tmp_path / "notes.txt", "colmap-text")


@settings(max_examples=200, deadline=None)
@given(st.sampled_from([b"", b"ply\n", b"ply\nformat ascii 1.0\n", b"# Bundle file v0.3\n"]), st.binary(max_size=300))
def test_arbitrary_bytes_raise_only_input_errors(
    tmp_path_factory: pytest.TempPathFactory, start: bytes, content: bytes
) -> None:
    path = tmp_path_factory.getbasetemp() / "arbitrary"
    path.write_bytes(start + content)
    try:
        read_reconstruction(path)
    except InputError as error:
        assert str(path) in str(error)
