"""The documentation site in a browser, where it has been built."""

import json
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.browser import Browser

SITE = Path(__file__).resolve().parents[2] / "build" / "site"


class Server(SimpleHTTPRequestHandler):
    """Serves the site, without texts in the index of the search, which a browser would read anew for every page."""

    def do_GET(self) -> None:
        """Send a file."""
        if self.path.endswith("/search_index.json"):
            self.send_response(200)
            self.end_headers()
            index = json.loads((SITE / "search" / "search_index.json").read_text(encoding="utf-8"))
            self.wfile.write(json.dumps(index | {"docs": []}).encode())
        else:
            super().do_GET()

    def log_message(self, *_: Any) -> None:
        """Print nothing."""


@pytest.fixture
def address() -> Iterator[str]:
    """Address of the site on a server of this machine."""
    if not SITE.is_dir():
        pytest.skip("the site is not built: `make docs`")
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Server, directory=str(SITE))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.mark.slow
@pytest.mark.timeout(900)  # seconds for each page where the processor is busy
def test_pages_in_a_browser(address: str, browser: Browser) -> None:
    """All pages but of the reference, whose pages are alike: every eighth."""
    pages = sorted(path.relative_to(SITE).as_posix().removesuffix("index.html") for path in SITE.rglob("*.html"))
    reference = [page for page in pages if page.startswith("reference/")]
    pages = [*(page for page in pages if page not in reference), *reference[::8]]
    assert "" in pages and len(pages) > 50
    faults = {page: browser.faults(f"{address}/{page}") for page in pages}
    assert {page: found for page, found in faults.items() if found} == {}
