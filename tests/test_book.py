"""The check of the built book finds what it is for."""

import base64
import importlib.util
import json
import re
from pathlib import Path

import cv2
import nbformat
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]


def script(path):
    """Return a Python file of the book, which is no module of a package, as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def check(monkeypatch):
    """Return the module ``book/check.py``, run from the root as the Makefile does."""
    monkeypatch.chdir(ROOT)
    return script(ROOT / "book" / "check.py")


@pytest.fixture
def site(check, tmp_path):
    """Write an empty page for every entry of the contents, and all anchors into one of them."""
    names = re.findall(r"(?:file|root): (\S+)", (ROOT / "_toc.yml").read_text(encoding="utf-8"))
    for name in names:
        page = tmp_path / f"{name}.html"
        page.parent.mkdir(exist_ok=True)
        page.write_text("<html></html>")
    (tmp_path / "notebooks" / "01_bayesian_filtering.html").write_text(
        "".join(f'<p id="{anchor}"></p>' for anchor in check.ANCHORS)
    )
    return tmp_path


def test_a_whole_site_has_no_problems(check, site):
    assert check.problems(site) == []


def test_a_missing_page_is_named(check, site):
    (site / "book" / "errata.html").unlink()
    assert check.problems(site) == ["book/errata.html is missing"]


@pytest.mark.parametrize(
    "fetch",
    [
        '<script src="https://example.org/a.js"></script>',
        '<link rel="stylesheet" href="//example.org/a.css">',
        '<img src="http://example.org/a.png" alt="A picture.">',
    ],
)
def test_a_page_that_fetches_from_another_host_is_named(check, site, fetch):
    (site / "book" / "index.html").write_text(fetch)
    (problem,) = check.problems(site)
    assert problem.startswith("book/index.html fetches")


def test_every_figure_and_table_of_the_papers_has_to_be_there(check, site):
    page = site / "notebooks" / "01_bayesian_filtering.html"
    page.write_text(page.read_text().replace('id="li-2012-fig-17"', "").replace('id="li-2016-table-4"', ""))
    assert check.problems(site) == ["no page has li-2012-fig-17", "no page has li-2016-table-4"]
    assert len(check.ANCHORS) == 7 + 20 + 20 + 2 + 3 + 5 + 1


@pytest.mark.parametrize(
    ("link", "there"),
    [
        ("errata.html", True),
        ("../notebooks/01_bayesian_filtering.html#li-2012-fig-17", True),
        ("#here", True),
        ("mailto:somebody", True),
        ("eratta.html", False),
        ("errata.html#nowhere", False),
        ("#nowhere", False),
        ("../_sources/book/index.md", False),
    ],
)
def test_a_link_within_the_site_has_to_lead_somewhere(check, site, link, there):
    (site / "book" / "index.html").write_text(f'<p id="here"></p><a href="{link}">there</a>')
    expected = [] if there else [f"book/index.html links to {link}, which is not there"]
    assert check.problems(site) == expected


@pytest.mark.parametrize("alt", ["", 'alt=""', 'alt="  "'])
def test_a_picture_without_words_is_named(check, site, alt):
    (site / "book" / "index.html").write_text(f'<img src="data:image/png;base64,AAAA" {alt}>')
    assert check.problems(site) == ["book/index.html has a picture without alt text: data:image/png;base64,AAAA"]


@pytest.mark.parametrize("kind", ["PAGE", "SITE", "NOTEBOOK"])
def test_what_is_too_heavy_is_named(check, site, monkeypatch, kind):
    (site / "book" / "large.png").write_bytes(bytes(5000))
    (site / "book" / "index.html").write_text('<img src="large.png" alt="Nothing.">')
    limit = {"PAGE": 5000, "SITE": 5100, "NOTEBOOK": 1_000}[kind]
    monkeypatch.setattr(check, kind, limit)
    problems = check.problems(site)
    assert all("weighs" in problem for problem in problems)
    assert {"PAGE": "book/index.html", "SITE": "the site", "NOTEBOOK": "notebooks/01"}[kind] in str(problems)


def test_links_to_follow_are_no_fetches(check, site):
    page = '<a href="https://example.org">there</a><link rel="canonical" href="https://example.org/">'
    (site / "book" / "index.html").write_text(page)
    assert check.problems(site) == []


def test_every_chapter_is_in_the_contents_and_has_outputs_and_alt_texts():
    contents = (ROOT / "_toc.yml").read_text(encoding="utf-8")
    for path in sorted((ROOT / "notebooks").glob("[0-9]*.ipynb")):
        assert f"notebooks/{path.stem}" in contents
        for number, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
            if cell["cell_type"] != "code":
                continue
            assert cell["execution_count"], f"{path.name}, cell {number} was never run"
            if any("text/html" in output.get("data", {}) for output in cell["outputs"]):
                tags = cell["metadata"].get("tags", [])
                assert "nbval-ignore-output" in tags, f"{path.name}, cell {number}: nbval would compare HTML"
            if any("image/png" in output.get("data", {}) for output in cell["outputs"]):
                assert cell["metadata"]["mystnb"]["image"]["alt"], f"{path.name}, cell {number}: no alt text"


def test_stored_pictures_are_lighter_and_hardly_different_and_dead_widgets_are_gone():
    execute = script(ROOT / "notebooks" / "execute.py")
    picture = np.full((200, 300, 3), 255, dtype=np.uint8)
    picture[40:160, 50:250] = np.random.default_rng(0).integers(0, 40, (120, 200, 3), dtype=np.uint8)
    png = base64.b64encode(cv2.imencode(".png", picture)[1]).decode()
    outputs = [{"data": {"image/png": png}}, {"data": {execute.WIDGET: {}}}, {"text": "said"}]
    cell = nbformat.from_dict({"outputs": outputs})
    execute.tidy(cell)
    drawn, said = cell.outputs
    lighter = base64.b64decode(drawn.data["image/png"])
    assert said.text == "said"
    assert len(lighter) < 0.6 * len(base64.b64decode(png))
    shown = cv2.imdecode(np.frombuffer(lighter, np.uint8), cv2.IMREAD_COLOR)
    assert (shown[:40] == 255).all()
    assert np.abs(shown.astype(int) - picture).mean() < 5
