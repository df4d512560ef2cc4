"""The check of the built book finds what it is for."""

import importlib.util
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def check(monkeypatch):
    """Return the module ``book/check.py``, run from the root as the Makefile does."""
    monkeypatch.chdir(ROOT)
    spec = importlib.util.spec_from_file_location("check", ROOT / "book" / "check.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def site(tmp_path):
    """Write an empty page for every entry of the contents."""
    names = re.findall(r"(?:file|root): (\S+)", (ROOT / "_toc.yml").read_text(encoding="utf-8"))
    for name in names:
        page = tmp_path / f"{name}.html"
        page.parent.mkdir(exist_ok=True)
        page.write_text("<html></html>")
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
        '<img src="http://example.org/a.png" alt="">',
    ],
)
def test_a_page_that_fetches_from_another_host_is_named(check, site, fetch):
    (site / "book" / "index.html").write_text(fetch)
    (problem,) = check.problems(site)
    assert problem.startswith("book/index.html fetches")


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
            if any("image/png" in output.get("data", {}) for output in cell["outputs"]):
                assert cell["metadata"]["mystnb"]["image"]["alt"], f"{path.name}, cell {number}: no alt text"
