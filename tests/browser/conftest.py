"""A headless Chromium, and the built book served on loopback.

A machine without a browser, or without a built book, skips these tests with the reason. With
``PFTRACK_REQUIRE_BROWSER=1`` (as in continuous integration) nothing may be skipped.
"""

import functools
import http.server
import os
import shutil
import threading
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SITE = ROOT / "_build" / "html"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]


def unavailable(reason: str) -> None:
    """Skip the test, or fail it where nothing may be skipped."""
    if os.environ.get("PFTRACK_REQUIRE_BROWSER") == "1":
        pytest.fail(reason)
    pytest.skip(reason)


@pytest.fixture(scope="session")
def chromium():
    """Start a browser once for all tests."""
    executable = next(filter(None, map(shutil.which, BROWSERS)), None)
    if executable is None:
        unavailable(f"no browser here; tried {', '.join(BROWSERS)}")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=ARGUMENTS)
        yield browser
        browser.close()


class Quiet(http.server.SimpleHTTPRequestHandler):
    """A server that says nothing on standard error."""

    def log_message(self, *arguments):
        """Log nothing."""


@pytest.fixture(scope="session")
def site():
    """Serve the built book, and return its address."""
    if not (SITE / "index.html").is_file():
        unavailable("the book is not built; make book builds it")
    handler = functools.partial(Quiet, directory=SITE)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()
