"""``dronevio view``: a viewer for the rerun file of a run."""

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
from typing import Annotated, NoReturn
from urllib.parse import quote, urlsplit

import tyro

from dronevio.cli.terminal import parse
from dronevio.models.errors import DronevioError, InputError
from dronevio.models.ranges import Range, Settings
from dronevio.models.recordings.files import check_regular_file

HOST = "127.0.0.1"  # the viewer has no access control
RECORDING = "run.rrd"
_MAGIC = b"RRF"
_START_S = 30.0  # time within which a viewer accepts connections


@dataclass(frozen=True)
class ViewCommand(Settings):
    """Open the rerun file of a run: images, IMU samples, true and estimated paths and errors on one timeline.

    A report, report.html, opens in the browser. If there is a display, a window opens for the others. Otherwise a web
    viewer is served to browsers on this machine. To use it from another machine, forward its two ports:
    ssh -L 9090:127.0.0.1:9090 -L 9876:127.0.0.1:9876 HOST.

    Examples:
      dronevio view runs/room-v0-0
      dronevio view runs/room-v0-0/run.rrd --web
      dronevio view runs/room-v0-0/report.html
    """

    run: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RUN")]
    """Folder that `dronevio run` wrote, a file with the suffix .rrd, or a page with the suffix .html."""
    web: bool = False
    """Serve the web viewer even if there is a display."""
    port: Annotated[int, Range(0, 65535)] = 9090
    """Port of the web viewer; 0 for any free port. If it is in use, a free port is chosen."""


def main(arguments: Sequence[str]) -> int:
    """Open a page, or replace this process by the viewer, so that a signal to it ends the viewer."""
    command = parse(ViewCommand, arguments, "view")
    if command.run.suffix == ".html":
        _open_page(command.run)
    else:
        _become_viewer(command)
    return 0


def _become_viewer(command: ViewCommand) -> NoReturn:
    """Replace this process by the viewer of a recording."""
    recording = find_recording(command.run)
    viewer, web_address, _ = viewer_command(command.web, command.port)
    if web_address:
        print(f"Open {web_address} in a browser. Ctrl-C ends the viewer.", flush=True)
    os.environ.setdefault("RUST_LOG", "warn")
    os.execv(viewer[0], [*viewer, str(recording)])


def _open_page(page: Path) -> None:
    """Open a page in the browser, and print its address for a browser that does not open by itself."""
    check_regular_file(page, "a page that a command wrote")
    if not page.exists():
        raise InputError(page, "no such file", "a page that a command wrote, such as report.html")
    address = page.resolve().as_uri()
    print(f"Open {address} in a browser.")
    if has_display(sys.platform, os.environ):
        import webbrowser

        webbrowser.open(address)


def viewer_command(web: bool = False, port: int = 9090) -> tuple[list[str], str, str]:
    """Return the command that starts a viewer which accepts connections from this machine only.

    Args:
        web: Whether to serve the web viewer even if there is a display.
        port: Port of the web viewer; a free port is chosen if it is in use.

    Returns:
        The command, the address for a browser (empty for a window), and the address that accepts recordings.
    """
    data_port = free_port(9876)
    viewer = [*viewer_program(), "--bind", HOST, "--port", str(data_port)]
    data_address = data_url(data_port)
    if not web and has_display(sys.platform, os.environ):
        return viewer, "", data_address
    web_port = free_port(port)
    return [*viewer, "--serve-web", "--web-viewer-port", str(web_port)], viewer_url(web_port, data_port), data_address


@contextmanager
def viewer_process() -> Iterator[str]:
    """Run a viewer until the context ends, and yield the address that accepts recordings.

    Raises:
        DronevioError: The viewer does not start.
    """
    viewer, web_address, data_address = viewer_command()
    environment = {"RUST_LOG": "error", **os.environ}
    process = subprocess.Popen(viewer, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        _wait_for(process, data_address)
        if web_address:
            print(f"Live view: {web_address}", file=sys.stderr, flush=True)
        yield data_address
    finally:
        process.terminate()
        process.wait()


def _wait_for(process: "subprocess.Popen[bytes]", address: str) -> None:
    """Wait until a viewer accepts connections."""
    port = urlsplit(address).port
    deadline = time.monotonic() + _START_S
    while process.poll() is None and time.monotonic() < deadline:
        with suppress(OSError), socket.create_connection((HOST, port), timeout=1.0):
            return
        time.sleep(0.05)
    raise DronevioError("the rerun viewer does not start; run without --live and open the result with `dronevio view`")


def find_recording(run: Path) -> Path:
    """Return the rerun file of a run's folder, or the file itself.

    Raises:
        InputError: There is no such file, or it is not a rerun file.
    """
    path = run / RECORDING if run.is_dir() else run
    expected = f"a folder that `dronevio run` wrote, with {RECORDING} in it, or an .rrd file"
    check_regular_file(path, expected)
    try:
        with path.open("rb") as file:
            magic = file.read(len(_MAGIC))
    except FileNotFoundError:
        raise InputError(path, "no such file", expected) from None
    except OSError as error:
        raise InputError(path, error.strerror or "unreadable", expected) from None
    if magic != _MAGIC:
        raise InputError(path, f"a file that starts with {magic!r}", f"a rerun file, which starts with {_MAGIC!r}")
    return path


def has_display(platform: str, environment: Mapping[str, str]) -> bool:
    """Return whether a window can be opened."""
    if platform == "darwin":
        return "SSH_CONNECTION" not in environment
    return bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


def viewer_url(web_port: int, data_port: int) -> str:
    """Return the address of the web viewer, which contains the address of the data."""
    return f"http://{HOST}:{web_port}/?url={quote(data_url(data_port), safe='')}"


def data_url(port: int) -> str:
    """Return the address at which a viewer accepts recordings."""
    return f"rerun+http://{HOST}:{port}/proxy"


def free_port(wanted: int) -> int:
    """Return a free port of this machine: the wanted one if possible."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise AssertionError("unreachable: port 0 is always free")


def viewer_program() -> list[str]:
    """Return the words that start the rerun viewer: its executable, or else the Python module that starts it."""
    module = find_spec("rerun_cli")
    program = Path((module and module.origin) or "").with_name("rerun")
    return [str(program)] if program.is_file() else [sys.executable, "-m", "rerun_cli"]
