"""Notebooks are committed without outputs, are short, and become pages with their outputs."""

import ast
import re

import nbformat
import pytest
from test_site import DOCS, load_hook

NOTEBOOKS = sorted(DOCS.parent.glob("examples/*.ipynb"))
PLACE = re.compile(r"/(?:home|root|work|tmp|Users|opt|mnt)/|[A-Z]:\\\\|file://")


@pytest.fixture(scope="module")
def hook():
    return load_hook("notebooks")


def test_each_notebook_is_shown_by_one_page(hook):
    shown = [match["path"] for page in DOCS.rglob("*.md") for match in hook.MARK.finditer(page.read_text())]
    assert sorted(shown) == [path.relative_to(DOCS.parent).as_posix() for path in NOTEBOOKS]
    assert shown


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_has_no_outputs_and_no_places_of_a_machine(path):
    text = path.read_text()
    notebook = nbformat.reads(text, as_version=4)
    nbformat.validate(notebook)
    assert not PLACE.search(text)
    assert len(notebook.cells) <= 12
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert notebook.metadata.language_info == {"name": "python"}
    for cell in notebook.cells:
        assert not cell.metadata
        if cell.cell_type == "code":
            assert cell.outputs == []
            assert cell.execution_count is None
            ast.parse(cell.source)


def make_notebook(*outputs):
    new = nbformat.v4
    code = new.new_code_cell("# A square.\nx", outputs=list(outputs))
    return new.new_notebook(cells=[new.new_markdown_cell("# Title\n\nText."), code])


def test_a_page_shows_text_cells_code_and_outputs(hook):
    output = nbformat.v4.new_output
    page = hook.render_notebook(
        make_notebook(
            output("stream", text="one\ntwo\n"),
            output("display_data", {"text/html": "", "text/plain": "<a bar>"}),
            output("display_data", {"image/png": "QUJD\n", "text/plain": "<a figure>"}),
            output("execute_result", {"text/plain": "3"}),
        )
    )
    assert page == (
        "Text.\n\n```python\n# A square.\nx\n```\n\n```text\none\ntwo\n```\n\n"
        "![A square.](data:image/png;base64,QUJD)\n\n```text\n3\n```"
    )


@pytest.mark.documentation
def test_an_error_in_a_cell_is_an_error_of_the_build(hook):
    notebook = make_notebook()
    with pytest.raises(hook.PluginError, match="NameError"):
        hook.run_notebook(nbformat.writes(notebook))
