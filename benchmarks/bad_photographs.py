"""Reconstruct photographs beside one bad file, and wrong folders, and print what the command says as a table.

A bad file must not end a reconstruction: `dronevio sfm` ends with exit code 0, a warning names the file unless it can
be used, and as many photographs are registered as without it. Wrong folders and arguments must end with exit code
2, one line on standard error, and no files left behind. Otherwise the script ends with exit code 1. It needs a few
photographs, of at most one megapixel to be quick::

    .venv/bin/python benchmarks/bad_photographs.py kermit
"""

import contextlib
import io
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before NumPy is imported

import cv2
import numpy as np
import tyro
from bad_inputs import png
from PIL import Image as PillowImage

from dronevio.cli import main as dronevio
from dronevio.models.arrays import Image

Change = Callable[[Path], None]
EXTRA_ARGUMENTS = ("--format", "ply", "--json", "--out", "out")


@dataclass(frozen=True)
class BadPhotographsCommand:
    """Reconstruct photographs beside bad files and print a Markdown table of exit codes and messages."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder with at least four photographs that are reconstructed without a calibration."""
    photographs: int = 5
    """How many of them are used."""


@dataclass(frozen=True)
class Case:
    """A bad file beside good photographs, or a wrong folder."""

    name: str
    """What is wrong."""
    change: Change
    """Changes the folder of photographs."""
    code: int = 0
    """Expected exit code."""
    arguments: tuple[str, ...] = ()
    """Further words of the command."""
    is_said: bool = True
    """Whether something must be said."""


def _bytes(name: str, data: bytes) -> Change:
    """Return the change that writes a file."""

    def change(folder: Path) -> None:
        (folder / name).write_bytes(data)

    return change


def _first(folder: Path) -> Path:
    """Return the first photograph."""
    return min(folder.iterdir())


def _pixels(folder: Path) -> Image:
    """Return the first photograph as an image (H, W, 3)."""
    with PillowImage.open(_first(folder)) as image:
        return np.asarray(image.convert("RGB"))


def _cut(folder: Path) -> None:
    data = _first(folder).read_bytes()
    (folder / "z.jpg").write_bytes(data[: len(data) // 3])


def _converted(name: str, mode: str) -> Change:
    """Return the change that replaces the first photograph by one of another mode of Pillow."""

    def change(folder: Path) -> None:
        image = PillowImage.fromarray(_pixels(folder)).convert(mode)
        _first(folder).unlink()
        image.save(folder / name)

    return change


def _twelve_bits(folder: Path) -> None:
    grey = cv2.cvtColor(_pixels(folder), cv2.COLOR_RGB2GRAY)
    _first(folder).unlink()
    cv2.imwrite(str(folder / "a.tif"), grey.astype(np.uint16) << 4)


def _turned(folder: Path) -> None:
    """Store the first photograph on its side, with the orientation that turns it upright."""
    image = PillowImage.fromarray(np.rot90(_pixels(folder)).copy())
    exif = image.getexif()
    exif[0x0112] = 6
    _first(folder).unlink()
    image.save(folder / "a.jpg", exif=exif, quality=95)


def _renamed(folder: Path) -> None:
    """Give the first photograph a name of other scripts."""
    _first(folder).rename(folder / "Ürgüp 写真.jpg")


def _emptied(folder: Path) -> None:
    for file in list(folder.iterdir()):
        file.unlink()


def _one_left(folder: Path) -> None:
    for file in sorted(folder.iterdir())[1:]:
        file.unlink()


def _blank(folder: Path) -> None:
    cv2.imwrite(str(folder / "z.png"), np.full_like(_pixels(folder), 128))


def _all_blank(folder: Path) -> None:
    blank = np.full_like(_pixels(folder), 128)
    for file in list(folder.iterdir()):
        file.unlink()
    for name in "abc":
        cv2.imwrite(str(folder / f"{name}.png"), blank)


CASES = (
    Case("JPEG cut off", _cut),
    Case("text named .jpg", _bytes("z.jpg", b"no image")),
    Case("empty file", _bytes("z.png", b"")),
    Case("ZIP archive named .png", _bytes("z.png", b"PK\x03\x04" + bytes(200))),
    Case("PNG that claims 60000 × 60000 px", _bytes("z.png", png(60_000, 60_000))),
    Case("damaged HEIC", _bytes("z.heic", b"\x00\x00\x00\x18ftypheic" + bytes(200))),
    Case("raw photograph", _bytes("z.dng", b"II*\x00" + bytes(200))),
    Case("folder named .jpg", lambda folder: (folder / "z.jpg").mkdir(), is_said=False),
    Case("link to nothing", lambda folder: (folder / "z.jpg").symlink_to("nowhere.jpg")),
    Case("one pixel", _bytes("z.png", cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes()), is_said=False),
    Case("blank image", _blank, is_said=False),
    Case("palette", _converted("a.png", "P"), is_said=False),
    Case("transparency", _converted("a.png", "RGBA"), is_said=False),
    Case("CMYK", _converted("a.jpg", "CMYK"), is_said=False),
    Case("12 bits in a TIFF of 16", _twelve_bits, is_said=False),
    Case("stored on its side, orientation 6", _turned, is_said=False),
    Case("name of other scripts", _renamed, is_said=False),
    Case("text named .jpg, --strict", _bytes("z.jpg", b"no image"), 2, ("--strict",)),
    Case("no such folder", shutil.rmtree, 2),
    Case("empty folder", _emptied, 2),
    Case("one photograph", _one_left, 2),
    Case("blank images only", _all_blank, 2),
    Case("rig.yaml without cameras", _bytes("rig.yaml", b"cameras: none\n"), 2, ("--cameras", "0")),
    Case("gcp.csv with words", _bytes("gcp.csv", b"name,latitude\nA,north\n"), 2),
    Case("no such calibration", lambda folder: None, 2, ("--calibration", "nothing.yaml")),
    Case("no such masks", lambda folder: None, 2, ("--masks", "nothing")),
    Case("format of another lens", lambda folder: None, 2, ("--format", "bundler", "--lens", "fisheye")),
    Case("--every for a folder", lambda folder: None, 2, ("--every", "2")),
    Case("format that does not exist", lambda folder: None, 2, ("--format", "obj")),
)
"""All cases."""


@dataclass(frozen=True)
class Answer:
    """What the command says."""

    code: int
    """Exit code."""
    message: str
    """Warnings, or the error."""
    registered: int
    """Number of registered photographs, 0 after an error."""
    left: tuple[str, ...]
    """Files that are left behind after an error."""


def answer(files: Sequence[Path], case: Case) -> Answer:
    """Return what the command says of copies of photographs that a case changes."""
    with tempfile.TemporaryDirectory(prefix="bad-photographs-") as place, contextlib.chdir(place):
        folder = Path("photographs")
        folder.mkdir()
        for file in files:
            shutil.copy(file, folder)
        case.change(folder)
        before = set(Path().rglob("*"))
        with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
            code = dronevio(["sfm", "photographs", *EXTRA_ARGUMENTS, *case.arguments])
        left = tuple(sorted(map(str, set(Path().rglob("*")) - before))) if code else ()
        registered = 0 if code else json.loads(out.getvalue())["registered_images"]
    said = [line.removeprefix("dronevio: ") for line in err.getvalue().splitlines() if line.startswith("dronevio: ")]
    return Answer(code, " ⏎ ".join(said), registered, left)


def main(command: BadPhotographsCommand) -> int:
    """Print the table and return the exit code: 1 if an answer is wrong."""
    found = sorted(file for file in command.folder.iterdir() if file.suffix.lower() in (".jpg", ".png"))
    files = found[: command.photographs]
    good = answer(files, Case("nothing", lambda folder: None))
    print("| wrong | exit code | registered | message |\n| --- | ---: | ---: | --- |")
    print(f"| nothing | {good.code} | {good.registered} of {len(files)} | {good.message} |", flush=True)
    wrong = 0
    for case in CASES:
        is_ = answer(files, case)
        right = is_.code == case.code and not is_.left and bool(is_.message) >= case.is_said
        right &= case.code == 2 or is_.registered == good.registered
        wrong += not right
        mark = "" if right else "**wrong** "
        count = "–" if is_.code else f"{is_.registered}"
        print(f"| {case.name} | {mark}{is_.code} | {count} | {is_.message[:400]} {' '.join(is_.left)} |", flush=True)
    print(f"\n{len(CASES)} cases, {wrong} with another answer than expected")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(BadPhotographsCommand, description=__doc__)))
