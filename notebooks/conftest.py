"""Skip chapters whose footage cannot be had, each with its reason.

With ``PFTRACK_REQUIRE_DATA=1`` (as in continuous integration) nothing may be skipped: the chapter fails instead.
"""

import json
import os
from functools import cache
from pathlib import Path

import pytest

from pftrack import datasets


@cache
def missing_footage(notebook: Path) -> str | None:
    """Return why a chapter cannot run, or None if all it needs is here (after downloading what can be downloaded)."""
    for id in (
        json.loads(notebook.read_text(encoding="utf-8"))["metadata"]
        .get("pftrack", {})
        .get("datasets", [])
    ):
        try:
            datasets.load(id, progress=False)
        except (FileNotFoundError, ValueError) as error:
            return f"{notebook.name} needs {id}: {error}"
    return None


def pytest_collection_modifyitems(items):
    """Mark the cells of chapters without footage."""
    if os.environ.get("PFTRACK_REQUIRE_DATA") == "1":
        return
    for item in items:
        if item.path.suffix == ".ipynb" and (reason := missing_footage(item.path)):
            item.add_marker(pytest.mark.skip(reason=reason))
