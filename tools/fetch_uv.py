"""Download the uv binary from a Python package index with Python's standard library alone.

Usage: ``python3 fetch_uv.py VERSION DESTINATION``. The index is PyPI, or the one that ``UV_DEFAULT_INDEX``,
``UV_INDEX_URL`` or ``PIP_INDEX_URL`` names. Certificates come from ``PIP_CERT``, ``SSL_CERT_FILE`` or the system,
proxies from ``https_proxy``. The wheel's SHA-256 is checked against the one that the index gives (PEP 503).
"""

import hashlib
import io
import os
import platform
import ssl
import sys
import urllib.parse
import urllib.request
import zipfile
from html.parser import HTMLParser
from pathlib import Path

_TIMEOUT_S = 60.0


def index_url() -> str:
    """Return the address of the package index, with a slash at its end."""
    names = ("UV_DEFAULT_INDEX", "UV_INDEX_URL", "PIP_INDEX_URL")
    url = next((os.environ[name] for name in names if os.environ.get(name)), "https://pypi.org/simple")
    return url.rstrip("/") + "/"


def download(url: str) -> bytes:
    """Return the content at an address, which may contain a user name and a password."""
    parts = urllib.parse.urlsplit(url)
    bare = parts._replace(netloc=parts.netloc.rpartition("@")[2]).geturl()
    certificates = os.environ.get("PIP_CERT") or None
    handlers: list[urllib.request.BaseHandler] = [
        urllib.request.HTTPSHandler(context=ssl.create_default_context(cafile=certificates))
    ]
    if parts.username is not None:
        passwords = urllib.request.HTTPPasswordMgrWithPriorAuth()
        user, password = (urllib.parse.unquote(text or "") for text in (parts.username, parts.password))
        passwords.add_password(None, bare, user, password, is_authenticated=True)
        handlers.append(urllib.request.HTTPBasicAuthHandler(passwords))
    with urllib.request.build_opener(*handlers).open(bare, timeout=_TIMEOUT_S) as answer:
        return bytes(answer.read())


class Links(HTMLParser):
    """Collects the addresses of a page's links."""

    def __init__(self, page: str) -> None:
        """Parse a page."""
        super().__init__()
        self.addresses: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: "list[tuple[str, str | None]]") -> None:
        """Add the address of a link."""
        self.addresses += [value for name, value in attrs if tag == "a" and name == "href" and value]


def fits_this_machine(wheel: str) -> bool:
    """Return whether the name of a wheel states this system and processor."""
    machine = platform.machine().lower()
    if platform.system() == "Darwin":
        return "macosx" in wheel and wheel.endswith(f"_{machine}.whl")
    return "manylinux" in wheel and f"_{machine}." in wheel


def find_wheel(version: str) -> "tuple[str, str]":
    """Return the address and the SHA-256 of uv's wheel for this machine.

    Raises:
        LookupError: The index has no such wheel.
    """
    page_url = index_url() + "uv/"
    for address in Links(download(page_url).decode()).addresses:
        url, _, fragment = urllib.parse.urljoin(page_url, address).partition("#")
        name = url.rpartition("/")[2]
        if name.startswith(f"uv-{version}-") and name.endswith(".whl") and fits_this_machine(name):
            return url, fragment.partition("sha256=")[2]
    raise LookupError(f"{page_url}: no wheel of uv {version} for {platform.system()} on {platform.machine()}")


def fetch(version: str, destination: Path) -> None:
    """Write the uv binary to ``destination``.

    Raises:
        LookupError: The index has no wheel for this machine, or the hash of the wheel is wrong.
    """
    url, expected = find_wheel(version)
    wheel = download(url)
    found = hashlib.sha256(wheel).hexdigest()
    if found != expected:
        raise LookupError(f"{url}: SHA-256 {found}; expected {expected or 'that the index gives one'}")
    with zipfile.ZipFile(io.BytesIO(wheel)) as archive:
        binary = archive.read(f"uv-{version}.data/scripts/uv")
    destination.parent.mkdir(parents=True, exist_ok=True)
    unfinished = destination.with_suffix(".part")
    unfinished.write_bytes(binary)
    unfinished.chmod(0o755)
    unfinished.replace(destination)


if __name__ == "__main__":
    try:
        fetch(sys.argv[1], Path(sys.argv[2]))
    except (OSError, LookupError) as error:
        sys.exit(f"fetch_uv: {error}")
