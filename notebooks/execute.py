"""Run every chapter from top to bottom and store its outputs: ``python notebooks/execute.py [NOTEBOOK ...]``.

What differs from run to run without meaning anything (times, the kernel's version) is stripped, so that a chapter
changes in git only when its content does. Pictures are stored with at most 256 colours, a third of their weight. A
chapter that fails is left as it was. The picture and the film of the tracker at work, which the README and the first page
show, are taken from their chapter.
"""

import base64
import io
import re
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image
from tqdm import tqdm

from pftrack.files import replacing

HERE = Path(__file__).parent
STATIC = HERE.parent / "book" / "_static"
PICTURE = "owczarek-2015-fig-4"
FILM = "05_color_particle_filter"


def lighter(png: str) -> str:
    """Return a picture with at most 256 colours, or as it is if that is smaller; both as base64."""
    picture, file = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB"), io.BytesIO()
    picture.quantize(256).save(file, "png", optimize=True)
    return min(png, base64.b64encode(file.getvalue()).decode(), key=len)


def execute(path: Path) -> None:
    """Run one notebook in place."""
    notebook = nbformat.read(path, as_version=4)
    settings = {"timeout": 600, "record_timing": False, "coalesce_streams": True}
    NotebookClient(notebook, resources={"metadata": {"path": str(HERE)}}, **settings).execute()
    notebook.metadata.pop("widgets", None)
    notebook.metadata["language_info"] = {"name": "python"}
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number:03d}"
        for output in cell.get("outputs", []):
            if "image/png" in output.get("data", {}):
                output.data["image/png"] = lighter(output.data["image/png"])
    nbformat.validate(notebook)
    with replacing(path) as temporary:
        nbformat.write(notebook, temporary)
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if cell.metadata.get("mystnb", {}).get("figure", {}).get("name") == PICTURE and "image/png" in data:
                (STATIC / "tracker.png").write_bytes(base64.b64decode(data["image/png"]))
            if path.stem == FILM and "<video" in data.get("text/html", ""):
                for kind, name in (("video/mp4", "tracker.mp4"), ("image/jpeg", "tracker.jpg")):
                    content = re.search(rf'"data:{kind};base64,([^"]*)"', data["text/html"])[1]
                    (STATIC / name).write_bytes(base64.b64decode(content))


if __name__ == "__main__":
    paths = [Path(name) for name in sys.argv[1:]] or sorted(HERE.glob("[0-9]*.ipynb"))
    for path in (progress := tqdm(paths, unit="chapter")):
        progress.set_description(path.name)
        execute(path)
