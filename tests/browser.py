"""Pages in headless Chromium, driven by the DevTools protocol over a pipe."""

import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
WIDTHS_PX = (420, 1280)
HEIGHT_PX = 900
TIMEOUT_S = 60.0
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--no-first-run",
    "--no-proxy-server",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
    "--remote-debugging-pipe",
)
WIDER = """(() => {
  const root = document.documentElement;
  if (root.scrollWidth <= innerWidth) return null;
  const all = [...document.querySelectorAll("body *")];
  const wide = all.filter((x) => x.getBoundingClientRect().right > innerWidth + 0.5);
  const names = wide.slice(0, 5).map((x) => `<${x.tagName.toLowerCase()} class="${x.getAttribute("class") ?? ""}">`);
  return `${root.scrollWidth} px: ${names.join(", ")}`;
})()"""
OPEN_ALL = "document.querySelectorAll('details').forEach((x) => { x.open = true; })"
LAID_OUT = """new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => {
  document.getAnimations().forEach((x) => { if (x.effect.getComputedTiming().endTime < Infinity) x.finish(); });
  done(0);
})))"""
COLOURS = "[getComputedStyle(document.body).color, getComputedStyle(document.body).backgroundColor]"


def chromium() -> str | None:
    """Return the path of Chromium, or `None` where it is not installed."""
    return next(filter(None, map(shutil.which, PROGRAMS)), None)


class Browser:
    """A browser with one page.

    Args:
        program: Path of Chromium.
        profile: Folder for its files.
    """

    messages: list[str]
    """Messages of the page in the console, and exceptions of its scripts, since it was opened."""
    requests: list[str]
    """Addresses that the page requested since it was opened."""

    def __init__(self, program: str, profile: Path) -> None:
        # The protocol uses the file descriptors 3 and 4.
        words = ["sh", "-c", 'exec "$0" "$@" 3<&0 4>&1 </dev/null >/dev/null', program, f"--user-data-dir={profile}"]
        self._process = subprocess.Popen(
            [*words, *FLAGS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        self._received, self._count, self._session = b"", 0, {}
        self.messages, self.requests, self._loaded = [], [], False
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = {"sessionId": self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]}
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")

    def open(self, address: str) -> None:
        """Open a page and wait until it is loaded."""
        self._loaded = False
        self._call("Page.navigate", url="about:blank")
        self._wait_for_load()
        self.messages, self.requests, self._loaded = [], [], False
        answer = self._call("Page.navigate", url=address)
        assert "errorText" not in answer, f"{address}: {answer['errorText']}"
        self._wait_for_load()

    def show(self, width_px: int, *, dark: bool = False) -> None:
        """Set the width of the window and the colour scheme, and wait until the page is laid out."""
        size = {"width": width_px, "height": HEIGHT_PX, "deviceScaleFactor": 1, "mobile": False}
        self._call("Emulation.setDeviceMetricsOverride", **size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._call("Emulation.setEmulatedMedia", features=[scheme])
        self.evaluate(LAID_OUT)

    def evaluate(self, expression: str) -> Any:
        """Return the value of an expression of JavaScript, or of its promise."""
        answer = self._call("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def press(self, key: str) -> None:
        """Press and release a key, such as ``ArrowLeft``."""
        for kind in ("keyDown", "keyUp"):
            self._call("Input.dispatchKeyEvent", type=kind, key=key)

    def drag(self, selector: str, by_px: tuple[int, int]) -> None:
        """Press the left mouse button in the middle of an element, move the mouse, and release it."""
        middle = "(r => [r.x + r.width / 2, r.y + r.height / 2])(x.getBoundingClientRect())"
        self.evaluate(f"document.querySelector('{selector}').scrollIntoView({{block: 'center'}})")
        x, y = self.evaluate(f"(x => {middle})(document.querySelector('{selector}'))")
        held = {"button": "left", "buttons": 1, "clickCount": 1}
        self._call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **held)
        for step in range(1, 6):
            at = {"x": x + by_px[0] * step / 5, "y": y + by_px[1] * step / 5}
            self._call("Input.dispatchMouseEvent", type="mouseMoved", **at, **held)
        self._call("Input.dispatchMouseEvent", type="mouseReleased", **at, **(held | {"buttons": 0}))

    def faults(self, address: str) -> list[str]:
        """Open a page and return what is wrong with it, at both widths and in both colour schemes.

        The page writes no message to the console, requests nothing from elsewhere, is not wider than the window with
        all details open, and has other colours in the dark.
        """
        self.show(WIDTHS_PX[0])
        self.open(address)
        self.evaluate(OPEN_ALL)
        found, colours = [], []
        for dark in (False, True):
            for width_px in WIDTHS_PX:
                self.show(width_px, dark=dark)
                wider = self.evaluate(WIDER)
                found += [f"wider than {width_px} px: {wider}"] if wider else []
            colours.append(self.evaluate(COLOURS))
        origin = "/".join(address.split("/")[:3])
        away = [at for at in self.requests if not at.startswith((origin, "data:", "blob:"))]
        same = any(light == dark for light, dark in zip(*colours, strict=True))
        found += ["text or background has the same colour in the dark"] if same else []
        return [*found, *(f"console: {text}" for text in self.messages), *(f"request: {at}" for at in away)]

    def close(self) -> None:
        """End the browser."""
        try:
            self._call("Browser.close")
            self._process.wait(10)
        finally:
            self._process.kill()
            self._process.communicate()

    def _wait_for_load(self) -> None:
        while not self._loaded:
            self._handle(self._receive())

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its answer."""
        self._count += 1
        request = {"id": self._count, "method": method, "params": parameters, **self._session}
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(request).encode() + b"\0")
        self._process.stdin.flush()
        while (answer := self._receive()).get("id") != self._count:
            self._handle(answer)
        assert "error" not in answer, f"{method}: {answer['error']}"
        result: dict[str, Any] = answer["result"]
        return result

    def _receive(self) -> dict[str, Any]:
        """Return the next message of the browser."""
        assert self._process.stdout is not None
        deadline = time.monotonic() + TIMEOUT_S
        while b"\0" not in self._received:
            ready, _, _ = select.select([self._process.stdout], [], [], max(0.0, deadline - time.monotonic()))
            part = os.read(self._process.stdout.fileno(), 1 << 20) if ready else b""
            assert part, "the browser ended" if ready else f"the browser has not answered in {TIMEOUT_S} s"
            self._received += part
        message, _, self._received = self._received.partition(b"\0")
        parsed: dict[str, Any] = json.loads(message)
        return parsed

    def _handle(self, event: dict[str, Any]) -> None:
        """Note what an event tells of the page."""
        values = event.get("params", {})
        match event.get("method"):
            case "Page.loadEventFired":
                self._loaded = True
            case "Runtime.consoleAPICalled":
                self.messages.append(
                    " ".join(str(each.get("value", each.get("description"))) for each in values["args"])
                )
            case "Runtime.exceptionThrown":
                details = values["exceptionDetails"]
                self.messages.append(details.get("exception", {}).get("description", details["text"]))
            case "Log.entryAdded":
                self.messages.append(f"{values['entry']['text']} {values['entry'].get('url', '')}".strip())
            case "Network.requestWillBeSent":
                self.requests.append(values["request"]["url"])
