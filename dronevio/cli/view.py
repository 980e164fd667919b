"""``dronevio view``: open the recording of a run."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated
from urllib.parse import quote, urlsplit

import tyro

from dronevio.cli.terminal import parse
from dronevio.models.errors import DronevioError, InputError

HOST = "127.0.0.1"  # a viewer shows its data to all who reach it: nobody but this machine shall
RECORDING = "run.rrd"
_MAGIC = b"RRF"
_START_S = 30.0  # a viewer has so long to listen


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
    viewer, web_address, _ = viewer_command(command.web, command.port)
    if web_address:
        print(f"Open {web_address} in a browser; Ctrl-C ends it.", flush=True)
    os.environ.setdefault("RUST_LOG", "warn")
    os.execv(viewer[0], [*viewer, str(recording)])


def viewer_command(web: bool = False, port: int = 9090) -> tuple[list[str], str, str]:
    """Return how to start a viewer for this machine only.

    Args:
        web: Serve one for the browser, even where there is a display.
        port: Where to serve it; another port where it is taken.

    Returns:
        The command, the address for the browser (empty for a window), and the address for who sends a recording.
    """
    data_port = free_port(9876)
    viewer = [*viewer_program(), "--bind", HOST, "--port", str(data_port)]
    send_to = data_url(data_port)
    if not web and has_display(sys.platform, os.environ):
        return viewer, "", send_to
    web_port = free_port(port)
    return [*viewer, "--serve-web", "--web-viewer-port", str(web_port)], viewer_url(web_port, data_port), send_to


@contextmanager
def viewer_beside() -> Iterator[str]:
    """Show a viewer as long as the context lasts; gives the address to send a recording to.

    Raises:
        DronevioError: It does not start.
    """
    viewer, web_address, send_to = viewer_command()
    environment = {"RUST_LOG": "error", **os.environ}
    process = subprocess.Popen(viewer, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        _wait_for(process, send_to)
        if web_address:
            print(f"Watch it at {web_address}", file=sys.stderr, flush=True)
        yield send_to
    finally:
        process.terminate()
        process.wait()


def _wait_for(process: "subprocess.Popen[bytes]", address: str) -> None:
    """Wait until a viewer listens."""
    port = urlsplit(address).port
    deadline = time.monotonic() + _START_S
    while process.poll() is None and time.monotonic() < deadline:
        with suppress(OSError), socket.create_connection((HOST, port), timeout=1.0):
            return
        time.sleep(0.05)
    raise DronevioError("rerun's viewer does not start; run without watching, and `dronevio view` the result")


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
    return f"http://{HOST}:{web_port}/?url={quote(data_url(data_port), safe='')}"


def data_url(port: int) -> str:
    """Return the address at which a viewer takes recordings."""
    return f"rerun+http://{HOST}:{port}/proxy"


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
