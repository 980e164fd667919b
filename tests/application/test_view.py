"""``dronevio view``: the file of a run, and a web viewer that serves this machine only."""

import os
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import psutil
import pytest
import rerun as rr

from dronevio.cli import main
from dronevio.cli.commands.view import find_recording, free_port, has_display, viewer_url


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """Folder of a run with a small rerun file."""
    folder = tmp_path / "run"
    folder.mkdir()
    stream = rr.RecordingStream("dronevio")
    stream.save(folder / "run.rrd")
    stream.log("world", rr.Points3D([[0.0, 0.0, 0.0]]), static=True)
    stream.disconnect()
    return folder


def test_run_folder_stands_for_its_file(run_folder: Path) -> None:
    assert find_recording(run_folder) == find_recording(run_folder / "run.rrd") == run_folder / "run.rrd"


@pytest.mark.parametrize("content", [None, b"", b"PNG...."])
def test_other_files_are_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "run.rrd").write_bytes(content)
    assert main(["view", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(tmp_path / "run.rrd") in error
    assert "expected" in error


def test_missing_folder_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(tmp_path / "nothing")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_a_page_opens_in_the_browser(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where there is a display; its address is printed anyway."""
    page, opened = tmp_path / "a report.html", list[str]()
    assert main(["view", str(page)]) == 2
    assert "no such file" in capsys.readouterr().err
    page.write_text("<html></html>", encoding="utf-8")
    monkeypatch.setattr("webbrowser.open", opened.append)
    for display, expected in (("", []), (":0", [page.as_uri()])):
        monkeypatch.setenv("DISPLAY", display)
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        assert main(["view", str(page)]) == 0
        assert page.as_uri() in capsys.readouterr().out
        assert opened == expected


def test_displays_are_detected() -> None:
    assert has_display("linux", {"DISPLAY": ":0"})
    assert has_display("linux", {"WAYLAND_DISPLAY": "wayland-0"})
    assert not has_display("linux", {"DISPLAY": ""})
    assert has_display("darwin", {})
    assert not has_display("darwin", {"SSH_CONNECTION": "10.0.0.1 22"})


def test_address_has_both_ports_of_this_machine() -> None:
    assert viewer_url(1, 2) == "http://127.0.0.1:1/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A2%2Fproxy"


def test_another_port_replaces_one_in_use() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert free_port(port) != port
    assert free_port(port) == port


def test_web_viewer_is_local_and_ends_with_the_command(run_folder: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    command = [sys.executable, "-m", "dronevio.cli", "view", str(run_folder), "--port", "0"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
    ) as viewer:
        assert viewer.stdout is not None
        try:
            address = viewer.stdout.readline().split()[1]
            assert address.startswith("http://127.0.0.1:")
            assert b"<html" in fetch(address)
            process = psutil.Process(viewer.pid)
            listening = [c.laddr for c in process.net_connections() if c.status == psutil.CONN_LISTEN]
            assert len(listening) == 2  # the viewer and the recording
            assert {at.ip for at in listening} == {"127.0.0.1"}
            assert process.children(recursive=True) == []
            viewer.terminate()
            viewer.wait(10)
        finally:
            viewer.kill()
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(address, timeout=2)


def fetch(address: str) -> bytes:
    """Return the page at an address, after retries while the server starts."""
    for _ in range(100):
        try:
            with urllib.request.urlopen(address, timeout=5) as response:
                content: bytes = response.read()
                return content
        except OSError:
            time.sleep(0.1)
    raise AssertionError(f"no server answers at {address}")
