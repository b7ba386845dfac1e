"""Put the question and the answer of a result page at its top; docs/results.md has both, in one row for each page."""

import functools
import posixpath
import re
from pathlib import Path
from typing import Any, NamedTuple

INDEX = "results.md"
ROW = re.compile(
    r"^\| \[(?P<name>[^]]+)\]\((?P<page>results/[^)]+)\) \| (?P<question>.+) \| (?P<answer>.+) \| .+ \|$", re.M
)


class Entry(NamedTuple):
    """One row of the index of result pages."""

    name: str
    page: str
    question: str
    answer: str


@functools.cache
def read_index(docs: Path) -> dict[str, Entry]:
    """Return the rows of the index by the path of their page.

    Args:
        docs: Folder of the documentation.
    """
    rows = [Entry(**row.groupdict()) for row in ROW.finditer((docs / INDEX).read_text())]
    return {row.page: row for row in rows}


def on_page_markdown(markdown: str, *, page: Any, config: Any, **_: Any) -> str:
    """Replace the title of a result page by its name in the index, and add the question and the answer."""
    path = page.file.src_uri
    entry = read_index(Path(config.docs_dir)).get(path)
    if entry is None:
        return markdown
    index = posixpath.relpath(INDEX, posixpath.dirname(path))
    head = f'# {entry.name}\n\n!!! abstract "{entry.question}"\n\n    {entry.answer}\n\n    [All results]({index})\n'
    return re.sub(r"\A# .*\n", lambda _: head, markdown)
