import os
import signal
import subprocess
import sys
import time
import urllib.request

import psutil
import pytest
import rerun as rr

from dronevio.cli import main
from dronevio.cli.view import find_recording, free_port, has_display, viewer_url


@pytest.fixture
def run_folder(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    stream = rr.RecordingStream("dronevio")
    stream.save(folder / "run.rrd")
    stream.log("world", rr.Points3D([[0.0, 0.0, 0.0]]), static=True)
    stream.disconnect()
    return folder


def test_a_run_folder_and_its_recording_are_the_same(run_folder):
    assert find_recording(run_folder) == find_recording(run_folder / "run.rrd") == run_folder / "run.rrd"


@pytest.mark.parametrize("content", [None, b"", b"PNG...."])
def test_what_is_no_recording_is_refused_in_one_line(tmp_path, capsys, content):
    if content is not None:
        (tmp_path / "run.rrd").write_bytes(content)
    assert main(["view", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(tmp_path / "run.rrd") in error
    assert "expected" in error


def test_a_folder_that_is_not_there(tmp_path, capsys):
    assert main(["view", str(tmp_path / "nothing")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_where_there_is_a_display():
    assert has_display("linux", {"DISPLAY": ":0"})
    assert has_display("linux", {"WAYLAND_DISPLAY": "wayland-0"})
    assert not has_display("linux", {"DISPLAY": ""})
    assert has_display("darwin", {})
    assert not has_display("darwin", {"SSH_CONNECTION": "10.0.0.1 22"})


def test_the_address_names_both_ports_of_this_machine():
    assert viewer_url(1, 2) == "http://127.0.0.1:1/?url=rerun%2Bhttp%3A%2F%2F127.0.0.1%3A2%2Fproxy"


def test_a_taken_port_is_passed_over():
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert free_port(port) != port
    assert free_port(port) == port


def test_the_web_viewer_is_local_and_ends_with_the_command(run_folder):
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    viewer = subprocess.Popen(
        [sys.executable, "-m", "dronevio.cli", "view", str(run_folder), "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=environment,
    )
    try:
        address = viewer.stdout.readline().split()[1]
        assert address.startswith("http://127.0.0.1:")
        assert b"<html" in fetch(address)
        listening = [c.laddr for c in psutil.Process(viewer.pid).net_connections() if c.status == psutil.CONN_LISTEN]
        assert len(listening) == 2  # the viewer and the recording
        assert {at.ip for at in listening} == {"127.0.0.1"}
        assert psutil.Process(viewer.pid).children(recursive=True) == []
    finally:
        viewer.send_signal(signal.SIGTERM)
        viewer.wait(10)
        viewer.stdout.close()
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(address, timeout=2)


def fetch(address):
    for _ in range(100):
        try:
            with urllib.request.urlopen(address, timeout=5) as answer:
                return answer.read()
        except OSError:
            time.sleep(0.1)
    raise AssertionError(f"nobody answers at {address}")
