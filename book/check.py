"""Check a built book: every page of the contents is there, and none fetches anything from another host.

``python book/check.py _build/html``
"""

import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import yaml

FETCHES = {"script": "src", "img": "src", "iframe": "src", "video": "src", "source": "src", "link": "href"}
HARMLESS_LINKS = {"canonical", "alternate", "next", "prev", "search", "index", "author"}


class Fetches(HTMLParser):
    """Collect the addresses on other hosts that a browser would fetch to show a page."""

    def __init__(self):
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag, attrs):
        """Look at one element."""
        attributes = dict(attrs)
        address = attributes.get(FETCHES.get(tag, ""), "") or ""
        if tag == "link" and set((attributes.get("rel") or "").split()) & HARMLESS_LINKS:
            return
        if re.match(r"(https?:)?//", address):
            self.found.append(address)


def problems(site: Path) -> list[str]:
    """List what is wrong with the site; empty if nothing is."""
    contents = yaml.safe_load(Path("_toc.yml").read_text(encoding="utf-8"))
    chapters = [chapter for part in contents["parts"] for chapter in part["chapters"]]
    pages = [page for chapter in chapters for page in (chapter, *chapter.get("sections", []))]
    names = [contents["root"], *(page["file"] for page in pages)]
    found = [f"{name}.html is missing" for name in names if not (site / f"{name}.html").is_file()]
    for page in site.rglob("*.html"):
        parser = Fetches()
        parser.feed(page.read_text(encoding="utf-8"))
        found += [f"{page.relative_to(site)} fetches {address}" for address in parser.found]
    found += [
        f"{style.relative_to(site)} imports {address}"
        for style in site.rglob("*.css")
        for address in re.findall(r"@import\s+(?:url\()?[\"']?(https?:[^\"')]+)", style.read_text(encoding="utf-8"))
    ]
    return found


if __name__ == "__main__":
    wrong = problems(Path(sys.argv[1]))
    for line in wrong:
        print(line, file=sys.stderr)
    sys.exit(1 if wrong else 0)
