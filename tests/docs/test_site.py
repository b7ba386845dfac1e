"""The site links every page, and shows the content of the command line and the result pages."""

import importlib.util
import re
from pathlib import Path

import pytest

from retrim.cli.main import commands

DOCS = Path(__file__).parents[2] / "docs"
LINK = re.compile(r"\]\(([\w./-]+\.md)")


def load_hook(name):
    spec = importlib.util.spec_from_file_location(name, DOCS / "hooks" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(("index", "folder"), [("how-to/index.md", "how-to"), ("reference/index.md", "reference")])
def test_index_links_every_page_of_its_folder(index, folder):
    pages = {path.name for path in (DOCS / folder).glob("*.md")} - {"index.md", "commands.md"}
    assert pages <= set(LINK.findall((DOCS / index).read_text()))


def test_index_of_results_has_one_row_per_page_with_its_commit():
    rows = re.findall(
        r"^\| \[.*\]\((results/[^)]+)\) \|.*\| (?:code )?`(\w+)` \|$", (DOCS / "results.md").read_text(), re.M
    )
    pages = sorted(path.relative_to(DOCS).as_posix() for path in (DOCS / "results").rglob("*.md"))
    assert sorted(page for page, _ in rows) == pages
    for page, commit in rows:
        text, mark, provenance = (DOCS / page).read_text().partition("\n## Provenance\n")
        assert mark, page
        assert commit in provenance, page
        assert commit not in text, page


def test_navigation_is_short():
    nav = (DOCS.parent / "mkdocs.yml").read_text().partition("\nnav:\n")[2]
    assert len(re.findall(r"^ *- ", nav, re.M)) <= 45


def test_result_page_begins_with_answer_of_index():
    hook = load_hook("result_answers")
    rows = hook.read_index(DOCS)
    assert len(rows) == len(list((DOCS / "results").rglob("*.md")))
    row = rows["results/hover.md"]

    class Page:
        class file:
            src_uri = row.page

    class Config:
        docs_dir = str(DOCS)

    page = hook.on_page_markdown((DOCS / row.page).read_text(), page=Page, config=Config)
    assert page.index(row.question) < page.index(row.answer) < page.index("Made by")


def test_command_page_has_every_option():
    hook = load_hook("command_options")
    page = hook.describe_commands()
    for name in commands():
        assert f"\n## {name}\n" in page
        printed = set(re.findall(r"^│ (--[\w-]+)", hook.print_help(name), re.M))
        section = page.partition(f"\n## {name}\n")[2].partition("\n## ")[0]
        assert printed <= set(re.findall(r"^\| `(--[\w-]+)", section, re.M))


def test_options_have_default_and_meaning():
    parse = load_hook("command_options").parse_help
    text = (
        "usage: retrim x [-h] [OPTIONS] PATH\n\nDo it.\n\n"
        "╭─ positional arguments ─╮\n│ PATH  A file. (required) │\n╰─╯\n"
        "╭─ flight options ─╮\n│ Where. │\n│ ───── │\n│ -h, --help  show this help message and exit │\n"
        "│ --size {None}|INT │\n│        Size [m], │\n│        or a | b. (default: 3) │\n"
        "│ --name TEXT  Name (of it). │\n╰─╯\n"
    )
    assert parse(text) == (
        "Do it.",
        [
            ("PATH", "required", "A file."),
            ("--size {None}\\|INT", "`3`", "Size [m], or a \\| b."),
            ("--name TEXT", "", "Name (of it)."),
        ],
    )


@pytest.mark.parametrize("page", sorted((DOCS / "how-to").glob("[!i]*.md")), ids=lambda page: page.stem)
def test_each_page_states_its_test_environment(page):
    """The hook of the site shows badges from the first line of the front matter."""
    head = page.read_text().split("\n", 2)[1]
    assert re.fullmatch(r"tested: \[(simulation|firmware|vehicle)(, (firmware|vehicle))*\]", head)
