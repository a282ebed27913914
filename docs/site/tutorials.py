"""Execute the tutorials, and turn them with all that they print and draw into pages of the site."""

import base64
import os
import re
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jupytext
import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "docs" / "tutorials").glob("*.py"))
LIMIT = 300
"""Seconds that a cell may take, on a busy machine too."""

_PREPARE = """
%config InlineBackend.figure_formats = ["png"]
%config InlineBackend.print_figure_kwargs = {"dpi": 110}
import warnings
warnings.filterwarnings("ignore", "IProgress not found")  # of tqdm, which Pooch asks for a bar that fits notebooks
"""


def tutorials(folder: Path, prose: Callable[[str, str], str], *, run: bool = True) -> dict[str, str]:
    """Markdown of every tutorial by its name; pictures and executed notebooks are written to `folder`.

    Args:
        folder: of the pages.
        prose: makes text of a file in the repository fit for the site.
        run: execute them, two at a time; otherwise their pages have code and text alone.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(2) as pool:
        notebooks = list(pool.map(execute if run else read, SOURCES))
    for source, notebook in zip(SOURCES, notebooks, strict=True):
        nbformat.write(notebook, folder / f"{source.stem}.ipynb")
    found = {}
    for source, notebook in zip(SOURCES, notebooks, strict=True):
        for cell in notebook.cells:
            if cell.cell_type == "markdown":
                cell.source = prose(cell.source, source.relative_to(ROOT).as_posix())
        found[source.stem] = page(notebook, source.stem, folder)
    return found


def read(source: Path) -> Any:
    """The notebook that a text stands for; `# %%` begins a cell."""
    return jupytext.read(source, fmt="py:percent")


def execute(source: Path) -> Any:
    """The notebook with its outputs, executed in a process and a folder of its own.

    Raises:
        ValueError: it wrote to stderr, where warnings go.
        nbclient.exceptions.CellExecutionError: a cell failed.
    """
    notebook = read(source)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(_PREPARE))
    with TemporaryDirectory() as folder:
        client = NotebookClient(
            notebook,
            timeout=LIMIT,
            kernel_name="python3",
            extra_arguments=["--log-level=ERROR"],  # it warns that its messages to this process are not encrypted
            resources={"metadata": {"path": folder}},
        )
        path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        client.execute(env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"})  # two run at a time
    del notebook.cells[0]
    for cell, output in outputs(notebook):
        if output.get("name") == "stderr":
            raise ValueError(f"{source.name} says on stderr {output['text']!r}, in the cell\n{cell.source}")
    return notebook


def outputs(notebook: Any) -> Iterator[tuple[Any, Any]]:
    """What every cell printed or drew, beside the cell."""
    for cell in notebook.cells:
        yield from ((cell, output) for output in cell.get("outputs", []))


def page(notebook: Any, name: str, folder: Path) -> str:
    """Markdown of a notebook; its pictures become files.

    Raises:
        ValueError: a picture has no `alt`, in words for who cannot see it.
    """
    parts = [f"[Notebook]({name}.ipynb){{: .md-button download={name}.ipynb }}"]
    for number, cell in enumerate(notebook.cells):
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                if "alt" not in cell.metadata:
                    raise ValueError(f"{name}: the picture of this cell has no alt text\n{cell.source}")
                picture = folder / f"{name}-{number}.png"
                picture.write_bytes(base64.b64decode(data["image/png"]))
                parts.append(f"![{cell.metadata['alt']}]({picture.name})")
            elif "text/html" in data:
                parts.append(re.sub(r"<table[^>]*>", "<table>", data["text/html"]))  # the site's tables have no class
            else:
                parts.append(f"```text\n{output.get('text') or data['text/plain']}\n```")
    head = parts[1:2] + parts[:1] + parts[2:]  # the title first
    return "\n\n".join(head) + "\n"
