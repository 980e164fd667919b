"""``dronevio view``: open the recording of a run."""

import os
import socket
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated
from urllib.parse import quote

import tyro

from dronevio.cli.terminal import parse
from dronevio.models.errors import InputError

HOST = "127.0.0.1"  # a viewer shows its data to all who reach it: nobody but this machine shall
RECORDING = "run.rrd"
_MAGIC = b"RRF"


@dataclass(frozen=True)
class ViewCommand:
    """Open the recording of a run: what the drone saw and felt, its true and its estimated path, on one timeline.

    Opens a window where there is a display, else serves a viewer for your browser, for this machine only. From another
    machine, forward the two ports that it names: ssh -L 9090:127.0.0.1:9090 -L 9876:127.0.0.1:9876 HOST.

    For example:
      dronevio view runs/room
      dronevio view runs/room/run.rrd --web
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Folder that `dronevio run` wrote, or an .rrd file."""
    web: bool = False
    """Serve a viewer for the browser, even where there is a display."""
    port: int = 9090
    """Port of the web viewer; another one where it is taken."""


def main(arguments: Sequence[str]) -> int:
    """Run the command; this process becomes the viewer, so that whoever ends it ends the viewer."""
    command = parse(ViewCommand, arguments, "view")
    recording = find_recording(command.run)
    data_port = free_port(9876)
    viewer = [*viewer_program(), "--bind", HOST, "--port", str(data_port)]
    if command.web or not has_display(sys.platform, os.environ):
        web_port = free_port(command.port)
        viewer += ["--serve-web", "--web-viewer-port", str(web_port)]
        print(f"Open {viewer_url(web_port, data_port)} in a browser; Ctrl-C ends it.", flush=True)
    os.environ.setdefault("RUST_LOG", "warn")
    os.execv(viewer[0], [*viewer, str(recording)])


def find_recording(run: Path) -> Path:
    """Return the recording of a run folder, or the file itself.

    Raises:
        InputError: There is none, or it is no recording.
    """
    path = run / RECORDING if run.is_dir() else run
    expected = f"a folder that `dronevio run` wrote, with {RECORDING} in it, or an .rrd file"
    try:
        with path.open("rb") as file:
            magic = file.read(len(_MAGIC))
    except FileNotFoundError:
        raise InputError(path, "no such file", expected) from None
    except OSError as error:
        raise InputError(path, error.strerror or "unreadable", expected) from None
    if magic != _MAGIC:
        raise InputError(path, f"a file that starts with {magic!r}", f"a rerun recording, which starts with {_MAGIC!r}")
    return path


def has_display(platform: str, environment: Mapping[str, str]) -> bool:
    """Return whether a window can be opened."""
    if platform == "darwin":
        return "SSH_CONNECTION" not in environment
    return bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


def viewer_url(web_port: int, data_port: int) -> str:
    """Return the address of the web viewer, which says where the recording is served."""
    return f"http://{HOST}:{web_port}/?url={quote(f'rerun+http://{HOST}:{data_port}/proxy', safe='')}"


def free_port(wanted: int) -> int:
    """Return a port of this machine that nobody listens on: the wanted one if possible."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise AssertionError("unreachable: port 0 is always free")


def viewer_program() -> list[str]:
    """Return how to start rerun's viewer: its program itself, else the module that looks for it."""
    module = find_spec("rerun_cli")
    program = Path((module and module.origin) or "").with_name("rerun")
    return [str(program)] if program.is_file() else [sys.executable, "-m", "rerun_cli"]
