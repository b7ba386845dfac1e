"""The site shows what the command line states."""

import importlib.util
import re
from pathlib import Path

from retrim.cli.main import commands

DOCS = Path(__file__).parents[2] / "docs"


def load_hook(name):
    spec = importlib.util.spec_from_file_location(name, DOCS / "hooks" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_commands_has_every_option():
    hook = load_hook("command_options")
    page = hook.describe_commands()
    for name in commands():
        assert f"\n## {name}\n" in page
        printed = set(re.findall(r"^│ (--[\w-]+)", hook.print_help(name), re.M))
        section = page.partition(f"\n## {name}\n")[2].partition("\n## ")[0]
        assert printed <= set(re.findall(r"^\| `(--[\w-]+)", section, re.M))


def test_options_of_help_have_default_and_meaning():
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
