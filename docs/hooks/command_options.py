"""The options of each command, from the help that the command line prints when the site is built.

A page asks for them by the comment ``<!-- commands -->``.
"""

import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from retrim.cli.main import commands, main

MARK = "<!-- commands -->"
GROUP = re.compile(r"^╭─[^\n]*╮\n(?P<body>.*?)^╰─", re.M | re.S)
DIVIDER = re.compile(r"^.*│ ─+ │\n", re.M | re.S)
NOTE = re.compile(r" ?\((?:default: (?P<value>[^()]*)|(?P<word>required|repeatable))\)$")
WIDE = "4000"
"""Columns of the terminal; the help then breaks few lines."""


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Fill in the options of all commands where a page asks for them."""
    return markdown.replace(MARK, describe_commands()) if MARK in markdown else markdown


def describe_commands() -> str:
    """Return a table of all commands, and a section with the options of each, as Markdown."""
    known = commands()
    lines = ["| command | purpose |", "|---|---|"]
    lines += [f"| [`{name}`](#{name}) | {_cell(about)} |" for name, (about, _) in known.items()]
    sections = [_section(name, module) for name, (_, module) in known.items()]
    return "\n\n".join(["\n".join(lines), *sections])


def _section(name: str, module: str) -> str:
    """Return the section of one command; a command with subcommands has a section below it for each."""
    subcommands = getattr(import_module(module), "COMMANDS", None)
    if subcommands is None:
        return f"## {name}\n\n{describe_options(name)}"
    about, _ = parse_help(print_help(name))
    parts = [f"### {name} {each}\n\n{describe_options(name, each)}" for each in subcommands]
    return "\n\n".join([f"## {name}", _cell(about), *parts])


def describe_options(*words: str) -> str:
    """Return the help of a command as Markdown: its purpose, and a table with a row for each option."""
    about, rows = parse_help(print_help(*words))
    if not rows:
        return f"{_cell(about)}\n\nThis command has no options."
    lines = ["| option | default | meaning |", "|---|---|---|"]
    lines += [f"| `{option}` | {default} | {meaning} |" for option, default, meaning in rows]
    return "\n".join([_cell(about), "", *lines])


def print_help(*words: str) -> str:
    """Return the text that a command prints for ``--help`` on a wide terminal."""
    text = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")  # an encoding with the frames of the groups
    with _restored_process(), contextlib.redirect_stdout(text), contextlib.suppress(SystemExit):
        os.environ["COLUMNS"] = WIDE
        main([*words, "--help"])
    text.seek(0)
    return text.read()


def parse_help(text: str) -> tuple[str, list[tuple[str, str, str]]]:
    """Return the purpose of a command, and the name, default and meaning of each option, as cells of a table."""
    about = " ".join(text[: text.index("╭")].partition("\n\n")[2].split())
    rows = list[tuple[str, str, str]]()
    for group in GROUP.finditer(text):
        entries = DIVIDER.sub("", group["body"])  # a description of the group, and a line below it
        for entry in re.split(r"^│ (?=\S)", entries, flags=re.M)[1:]:
            first, *more = [line.strip("│ ") for line in entry.splitlines()]
            option, _, meaning = first.partition("  ")
            if option != "-h, --help":
                rows.append((option.replace("|", "\\|"), *_default_of(" ".join([meaning.strip(), *more]).strip())))
    return about, rows


def _default_of(meaning: str) -> tuple[str, str]:
    """Return the default of an option and its meaning without the default."""
    found = NOTE.search(meaning)
    if found is None:
        return "", _cell(meaning)
    given = found["value"]
    default = found["word"] or ("" if given in ("", "None") else f"`{given}`")
    return _cell(default), _cell(meaning[: found.start()])


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")


@contextlib.contextmanager
def _restored_process() -> Iterator[None]:
    """Restore the arguments and the environment of this process, which a command may change."""
    arguments, environment = sys.argv, dict(os.environ)
    try:
        yield
    finally:
        sys.argv = arguments
        os.environ.clear()
        os.environ.update(environment)
