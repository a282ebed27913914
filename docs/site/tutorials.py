"""Execute the tutorials, and turn them and their output into pages of the site."""

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
"""Seconds after which a cell fails. The limit is high enough for a busy machine."""

_PREPARE = """
%config InlineBackend.figure_formats = ["png"]
%config InlineBackend.print_figure_kwargs = {"dpi": 110}
import warnings
warnings.filterwarnings("ignore", "IProgress not found")  # from tqdm, as Pooch requests a progress bar for notebooks
"""


def tutorials(folder: Path, prose: Callable[[str, str], str], *, run: bool = True) -> dict[str, str]:
    """Convert the tutorials to Markdown, and write their figures and the executed notebooks.

    Args:
        folder: folder of the pages, for the figures and notebooks.
        prose: converts text of a file in the repository for the site.
        run: execute the tutorials, two at a time; otherwise the pages have no output.

    Returns:
        The Markdown of every tutorial by its name.
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
    """Read a Python file as a notebook. Cells begin with `# %%`."""
    return jupytext.read(source, fmt="py:percent")


def execute(source: Path) -> Any:
    """Execute a tutorial as a notebook, in a separate process and a temporary folder.

    Args:
        source: the Python file.

    Returns:
        The notebook with its outputs.

    Raises:
        ValueError: a cell wrote to stderr, for example a warning.
        nbclient.exceptions.CellExecutionError: a cell failed.
    """
    notebook = read(source)
    notebook.cells.insert(0, nbformat.v4.new_code_cell(_PREPARE))
    with TemporaryDirectory() as folder:
        client = NotebookClient(
            notebook,
            timeout=LIMIT,
            kernel_name="python3",
            extra_arguments=["--log-level=ERROR"],  # hides a warning about unencrypted messages between the processes
            resources={"metadata": {"path": folder}},
        )
        path = os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])
        client.execute(env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"})  # two run at a time
    del notebook.cells[0]
    for cell, output in outputs(notebook):
        if output.get("name") == "stderr":
            raise ValueError(
                f"{source.name}: expected nothing on stderr, got {output['text']!r} from the cell\n{cell.source}"
            )
    return notebook


def outputs(notebook: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every cell with each of its outputs."""
    for cell in notebook.cells:
        yield from ((cell, output) for output in cell.get("outputs", []))


def page(notebook: Any, name: str, folder: Path) -> str:
    """Convert a notebook to Markdown, and write its figures to files.

    Args:
        notebook: the executed notebook.
        name: name of the tutorial.
        folder: folder for the figures.

    Returns:
        The Markdown.

    Raises:
        ValueError: a cell with a figure has no alternative text (`alt`).
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
                    raise ValueError(
                        f'{name}: expected alt="…" on the line of the cell that draws a figure, got none\n{cell.source}'
                    )
                picture = folder / f"{name}-{number}.png"
                picture.write_bytes(base64.b64decode(data["image/png"]))
                parts.append(f"![{cell.metadata['alt']}]({picture.name})")
            elif "text/html" in data:
                parts.append(re.sub(r"<table[^>]*>", "<table>", data["text/html"]))  # the site's tables have no class
            else:
                parts.append(f"```text\n{output.get('text') or data['text/plain']}\n```")
    head = parts[1:2] + parts[:1] + parts[2:]  # the title first
    return "\n\n".join(head) + "\n"
