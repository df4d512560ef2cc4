"""Check a built book: what the contents promise is there, leads somewhere, has words, and is light enough.

``python book/check.py _build/html``

Every page of the contents and every figure and table of the three papers is there; no page fetches anything from
another host; links and references within the site lead to a place; pictures have alt texts; and neither a page, a
notebook nor the whole site is too heavy.
"""

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import yaml

FETCHES = {"script": "src", "img": "src", "iframe": "src", "video": "src", "source": "src", "link": "href"}
HARMLESS_LINKS = {"canonical", "alternate", "next", "prev", "search", "index", "author"}

FIGURES = {
    "owczarek-2015": ["1", "2", "3", "4", "5", "6a", "6b"],
    "li-2012": [str(n) for n in range(1, 21)],
    "li-2016": [str(n) for n in range(1, 21)],
}
TABLES = {"owczarek-2015": range(1, 3), "li-2012": range(1, 4), "li-2016": range(1, 6)}
ANCHORS = [
    *(f"{paper}-fig-{figure}" for paper, figures in FIGURES.items() for figure in figures),
    *(f"{paper}-table-{table}" for paper, tables in TABLES.items() for table in tables),
    "li-2016-alg-1",
]
"""Every figure and table of the papers, and the one algorithm, by the anchor it has in some page."""

MEGABYTE = 1_000_000
PAGE, NOTEBOOK, SITE = 3 * MEGABYTE, 2 * MEGABYTE, 40 * MEGABYTE
"""Most bytes of a page with its pictures, of a notebook, and of the site without MathJax."""


class Page(HTMLParser):
    """What the check asks of a page: its anchors, links, fetches and pictures."""

    def __init__(self, path: Path):
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.pictures: list[str] = []
        self.without_words: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        """Look at one element."""
        attributes = dict(attrs)
        if "id" in attributes:
            self.anchors.add(attributes["id"])
        if tag == "a" and attributes.get("href"):
            self.links.append(attributes["href"])
        if tag == "img" and not attributes.get("alt", "").strip():
            self.without_words.append(attributes.get("src", "")[:80])
        if tag == "link" and set((attributes.get("rel") or "").split()) & HARMLESS_LINKS:
            return
        if address := attributes.get(FETCHES.get(tag, "")):
            self.fetched.append(address)
            self.pictures += [address] * (tag in ("img", "video", "source"))


def external(address: str) -> bool:
    """Tell whether an address is on another host."""
    return bool(re.match(r"(https?:)?//", address))


def local(page: Path, address: str) -> Path | None:
    """Return the file of the site that an address on a page stands for; None if it is none of the site's."""
    parts = urlsplit(address)
    if parts.scheme or parts.netloc:
        return None
    return (page.parent / unquote(parts.path)).resolve() if parts.path else page.resolve()


def problems(site: Path) -> list[str]:
    """List what is wrong with the site; empty if nothing is."""
    contents = yaml.safe_load(Path("_toc.yml").read_text(encoding="utf-8"))
    chapters = [chapter for part in contents["parts"] for chapter in part["chapters"]]
    entries = [entry for chapter in chapters for entry in (chapter, *chapter.get("sections", []))]
    names = [contents["root"], *(entry["file"] for entry in entries)]
    found = [f"{name}.html is missing" for name in names if not (site / f"{name}.html").is_file()]
    pages = {path.resolve(): Page(path) for path in site.rglob("*.html") if "_static" not in path.parts}
    anchors = set().union(*(page.anchors for page in pages.values()))
    found += [f"no page has {anchor}" for anchor in ANCHORS if anchor not in anchors]
    for path, page in pages.items():
        name = path.relative_to(site.resolve())
        found += [f"{name} fetches {address}" for address in page.fetched if external(address)]
        found += [f"{name} has a picture without alt text: {source}" for source in page.without_words]
        for link in page.links:
            to, anchor = local(path, link), unquote(urlsplit(link).fragment)
            lost = to in pages and anchor and anchor not in pages[to].anchors
            if to is not None and (lost or not to.exists()):
                found.append(f"{name} links to {link}, which is not there")
        files = {path, *(local(path, address) for address in page.pictures)} - {None}
        weight = sum(file.stat().st_size for file in files if file.is_file())
        if weight > PAGE:
            found.append(f"{name} weighs {weight:,} bytes with its pictures")
    found += [
        f"{style.relative_to(site)} imports {address}"
        for style in site.rglob("*.css")
        for address in re.findall(r"@import\s+(?:url\()?[\"']?(https?:[^\"')]+)", style.read_text(encoding="utf-8"))
    ]
    weights = {path: path.stat().st_size for path in Path("notebooks").glob("*.ipynb")}
    found += [f"{path} weighs {weight:,} bytes" for path, weight in weights.items() if weight > NOTEBOOK]
    whole = sum(path.stat().st_size for path in site.rglob("*") if path.is_file() and "mathjax" not in path.parts)
    if whole > SITE:
        found.append(f"the site weighs {whole:,} bytes without MathJax")
    return found


if __name__ == "__main__":
    wrong = problems(Path(sys.argv[1]))
    for line in wrong:
        print(line, file=sys.stderr)
    sys.exit(1 if wrong else 0)
