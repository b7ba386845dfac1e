"""Notebooks that run when the site is built, as Markdown with the outputs of their cells.

A page asks for a notebook by a comment: ``<!-- notebook: examples/first_flight.ipynb -->``. An error in a cell is an
error of the build.
"""

import functools
import re
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from mkdocs.exceptions import PluginError
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbformat import NotebookNode
from traitlets.config import Config

MARK = re.compile(r"<!-- notebook: (?P<path>[\w./-]+\.ipynb) -->")
SECONDS = 600  # limit for one cell


def on_page_markdown(markdown: str, *, config: Any, **_: Any) -> str:
    """Fill in the notebook that a page asks for."""
    root = Path(config.config_file_path).parent
    return MARK.sub(lambda match: render_notebook(run_notebook((root / match["path"]).read_text())), markdown)


@functools.cache
def run_notebook(text: str) -> NotebookNode:
    """Run all cells in an empty folder, with a new kernel; a site that is served runs them again after a change only.

    Args:
        text: Content of the file.

    Returns:
        The notebook with its outputs.

    Raises:
        PluginError: A cell raises an error.
    """
    notebook: NotebookNode = nbformat.reads(text, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        (place := Path(folder, "empty")).mkdir()
        # Sockets that only this user can open, instead of ports of the machine.
        local = Config(KernelManager=Config(transport="ipc", ip=f"{folder}/socket"))
        resources = {"metadata": {"path": str(place)}}
        client = NotebookClient(notebook, timeout=SECONDS, resources=resources, config=local)
        try:
            client.execute()
        except CellExecutionError as error:
            raise PluginError(f"a cell of a notebook does not run:\n{error}") from None
    return notebook


def render_notebook(notebook: NotebookNode) -> str:
    """Return a notebook as Markdown, without its title, which is that of the page.

    Args:
        notebook: The notebook with its outputs.
    """
    parts = list[str]()
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
        else:
            parts.append(_fence("python", cell.source))
            parts += [_render_output(output, cell.source) for output in cell.outputs]
    return re.sub(r"\A# .*\n+", "", "\n\n".join(part for part in parts if part))


def _render_output(output: NotebookNode, source: str) -> str:
    """Return an output as Markdown; the first comment of its cell describes an image."""
    if output.output_type == "stream":
        return _fence("text", output.text)
    if "image/png" in output.data:
        comment = re.match(r"# (.*)", source)
        return f"![{comment[1] if comment else ''}](data:image/png;base64,{output.data['image/png'].strip()})"
    if "text/html" in output.data:  # a progress bar, which is empty at its end
        return str(output.data["text/html"])
    return _fence("text", output.data["text/plain"])


def _fence(language: str, text: str) -> str:
    return f"```{language}\n{text.rstrip()}\n```"
