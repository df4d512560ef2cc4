"""The notebooks in JupyterLab, driven as a student would: sliders with a kernel, and a box drawn with the mouse."""

import os
import re
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).parents[2]
SLIDERS = '''
import numpy as np
from pftrack import Slider, explore


def square(level):
    """A square of one grey."""
    return np.full((64, 64, 3), level, dtype=np.uint8)


squares = explore(square, level=Slider([0, 100, 200], "level"))
squares
'''


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Start JupyterLab in an empty folder, and return the folder and the server's address."""
    folder = tmp_path_factory.mktemp("lab")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    homes = ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR", "JUPYTERLAB_SETTINGS_DIR")
    environment = os.environ | {home: str(folder / home.lower()) for home in homes}
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", f"--port={port}"]
    settings = ["--IdentityProvider.token=", f"--ServerApp.root_dir={folder}", "--LabApp.news_url="]
    address = f"http://127.0.0.1:{port}"
    with (folder / "log.txt").open("w") as log:
        server = subprocess.Popen([*command, *settings], env=environment, stdout=log, stderr=log)
        try:
            wait_for(f"{address}/api", server)
            yield folder, address
        finally:
            server.terminate()
            server.wait(30)


def wait_for(address, server, seconds=90):
    """Wait until a server answers."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        assert server.poll() is None, "JupyterLab did not start"
        try:
            urllib.request.urlopen(address, timeout=5).close()
        except OSError:
            time.sleep(0.5)
        else:
            return
    pytest.fail("JupyterLab does not answer")


@pytest.fixture
def open_notebook(chromium, lab):
    """Return a function that opens a notebook with the given cells, runs them all, and returns the page."""
    folder, address = lab
    context = chromium.new_context(viewport={"width": 1280, "height": 1400})

    def open_cells(cells, name):
        notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source) for source in cells])
        notebook.metadata["kernelspec"] = {"display_name": "Python 3", "language": "python", "name": "python3"}
        nbformat.write(notebook, folder / name)
        page = context.new_page()
        page.set_default_timeout(90_000)
        page.goto(f"{address}/lab/tree/{name}?reset")
        page.locator(".jp-Notebook .jp-CodeCell").first.click()
        page.locator('.jp-Notebook-ExecutionIndicator[data-status="idle"]').wait_for(state="attached")
        page.get_by_role("menuitem", name="Run", exact=True).click()
        page.get_by_role("menuitem", name="Run All Cells", exact=True).click()
        return page

    yield open_cells
    context.close()


def test_the_stack_and_the_live_slider_move(open_notebook):
    page = open_notebook([SLIDERS, "squares.live()"], "sliders.ipynb")
    stack = page.locator("figure.pftrack-explore")
    stack.locator("input").press("ArrowRight")
    assert stack.locator("img").get_attribute("alt") == "A square of one grey. Level 100."
    live = page.locator(".widget-interact")
    live.locator("img").wait_for()
    handle = live.get_by_role("slider")
    for _ in range(3):
        handle.press("ArrowRight")
    live.get_by_alt_text("A square of one grey. Level 3.", exact=True).wait_for()
    track = live.locator(".noUi-target").bounding_box()
    page.mouse.click(track["x"] + track["width"] / 2, track["y"] + track["height"] / 2)
    picture = live.get_by_alt_text(re.compile("Level (9[5-9]|10[0-5])"))
    picture.wait_for()
    assert picture.evaluate("picture => picture.decode().then(() => picture.naturalWidth)") == 64


def test_a_box_is_drawn_with_the_mouse(open_notebook):
    """The first cells of the chapter, with the mouse between them."""
    from playwright.sync_api import expect

    chapter = nbformat.read(ROOT / "notebooks" / "13_your_video.ipynb", as_version=4)
    cells = [cell["source"] for cell in chapter.cells if cell["cell_type"] == "code"]
    last = next(n for n, source in enumerate(cells) if source.startswith("box ="))
    page = open_notebook(cells[: last + 1], "video.ipynb")
    before = page.locator(".jp-OutputArea-output pre", has_text="x, y, width, height")
    before.wait_for()
    drawn, wanted = page.get_by_alt_text("annotate me").bounding_box(), [200.0, 50.0, 60.0, 150.0]
    x, y, w, h = (drawn["width"] / 320 * side for side in wanted)
    page.mouse.move(drawn["x"] + x, drawn["y"] + y)
    page.mouse.down()
    page.mouse.move(drawn["x"] + x + w / 2, drawn["y"] + y + h / 2, steps=5)
    page.mouse.move(drawn["x"] + x + w, drawn["y"] + y + h, steps=5)
    page.mouse.up()
    old = before.inner_text()
    page.locator(".jp-CodeCell").nth(last).click()
    page.keyboard.press("Control+Enter")
    expect(before).not_to_have_text(old, timeout=30_000)
    found = [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", before.inner_text())]
    assert found == pytest.approx(wanted, abs=3)
