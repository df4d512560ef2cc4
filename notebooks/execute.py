"""Run every chapter from top to bottom and store its outputs: ``python notebooks/execute.py [NOTEBOOK ...]``.

What differs from run to run without meaning anything (times, the kernel's version) is stripped, so that a chapter
changes in git only when its content does, and so are widgets, which are dead without a kernel. Pictures are stored with
at most 256 colours, a third of their weight. A chapter that fails is left as it was. The picture and the film of the
tracker at work, which the README and the first page show, are taken from their chapter.
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
WIDGET = "application/vnd.jupyter.widget-view+json"


def lighter(png: str) -> str:
    """Return a picture with at most 256 colours, or as it is if that is smaller; both as base64."""
    picture = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    file = io.BytesIO()
    picture.quantize(256).save(file, "png", optimize=True)
    return min(png, base64.b64encode(file.getvalue()).decode(), key=len)


def tidy(cell) -> None:
    """Take dead widgets from a cell's outputs, and make its pictures lighter."""
    cell.outputs = [each for each in cell.outputs if WIDGET not in each.get("data", {})]
    for output in cell.outputs:
        if "image/png" in output.get("data", {}):
            output.data["image/png"] = lighter(output.data["image/png"])


def keep_for_first_page(cell, film: bool) -> None:
    """Copy the picture of the tracker at work, and its film, to where the first page finds them."""
    picture = cell.metadata.get("mystnb", {}).get("figure", {}).get("name") == PICTURE
    for data in (output.get("data", {}) for output in cell.outputs):
        if picture and "image/png" in data:
            (STATIC / "tracker.png").write_bytes(base64.b64decode(data["image/png"]))
        if film and "<video" in data.get("text/html", ""):
            for kind, name in (("video/mp4", "tracker.mp4"), ("image/jpeg", "tracker.jpg")):
                content = re.search(rf'"data:{kind};base64,([^"]*)"', data["text/html"])[1]
                (STATIC / name).write_bytes(base64.b64decode(content))


def execute(path: Path) -> None:
    """Run one notebook in place."""
    notebook = nbformat.read(path, as_version=4)
    settings = {"timeout": 600, "record_timing": False, "coalesce_streams": True}
    here = {"metadata": {"path": str(HERE)}}
    NotebookClient(notebook, resources=here, **settings).execute()
    notebook.metadata.pop("widgets", None)
    notebook.metadata["language_info"] = {"name": "python"}
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number:03d}"
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    for cell in code:
        tidy(cell)
    nbformat.validate(notebook)
    with replacing(path) as temporary:
        nbformat.write(notebook, temporary)
    for cell in code:
        keep_for_first_page(cell, film=path.stem == FILM)


if __name__ == "__main__":
    paths = [Path(name) for name in sys.argv[1:]] or sorted(HERE.glob("[0-9]*.ipynb"))
    for path in (progress := tqdm(paths, unit="chapter")):
        progress.set_description(path.name)
        execute(path)
