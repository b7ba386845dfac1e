"""Tables of keys, presets and public names, generated from the code when the site is built.

A comment on a page requests a table: ``<!-- keys: module:Class -->``, ``<!-- presets -->``, ``<!-- names -->`` or
``<!-- primitives -->``.
"""

import ast
import dataclasses
import importlib
import inspect
import re
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

import retrim
from retrim.compile.expressions import EXPRESSIONS
from retrim.config.named_presets import PRESETS

KEYS = re.compile(r"<!-- keys: (?P<module>[\w.]+):(?P<name>\w+) -->")
ROLE = re.compile(r":(?:class|func|meth|mod|data|attr):<code>~?(?P<target>[\w.]+)</code>")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Insert the tables that a page requests."""
    markdown = KEYS.sub(lambda match: _keys(match["module"], match["name"]), markdown)
    if "<!-- presets -->" in markdown:
        markdown = markdown.replace("<!-- presets -->", _presets())
    if "<!-- names -->" in markdown:
        markdown = markdown.replace("<!-- names -->", _names())
    if "<!-- primitives -->" in markdown:
        markdown = markdown.replace("<!-- primitives -->", ", ".join(f"`{name}`" for name in sorted(EXPRESSIONS)))
    return markdown


def on_page_content(html: str, **_: Any) -> str:
    """Replace roles of docstrings, such as :class:`retrim.Plant`, by links."""
    return ROLE.sub(lambda match: _link(match["target"]), html)


def _link(target: str) -> str:
    name = target.removeprefix("retrim.")
    identifier = f"{getattr(retrim, name).__module__}.{name}" if name in retrim.__all__ else target
    return f'<autoref optional identifier="{identifier}"><code>{target}</code></autoref>'


def _keys(module: str, name: str) -> str:
    """Return a table of the keys of a configuration class: type, bounds, default and meaning."""
    cls = getattr(importlib.import_module(module), name)
    schema = TypeAdapter(cls).json_schema()["properties"]
    meaning = _meanings(cls)
    rows = ["| key | value | default | meaning |", "|---|---|---|---|"]
    for field in dataclasses.fields(cls):
        about = schema[field.name]
        rows.append(f"| `{field.name}` | {_value(about)} | {_default(field, about)} | {meaning.get(field.name, '')} |")
    return "\n".join(rows)


def _meanings(cls: type) -> dict[str, str]:
    """Return the docstring below each field of a class."""
    body = ast.parse(inspect.getsource(cls)).body[0]
    assert isinstance(body, ast.ClassDef)
    meanings = dict[str, str]()
    for above, below in zip(body.body, body.body[1:], strict=False):
        if (
            isinstance(above, ast.AnnAssign)
            and isinstance(above.target, ast.Name)
            and isinstance(below, ast.Expr)
            and isinstance(below.value, ast.Constant)
        ):
            meanings[above.target.id] = " ".join(str(below.value.value).split()).replace("|", "\\|")
    return meanings


def _value(about: dict[str, Any]) -> str:
    """Describe the type and bounds of a key."""
    if "$ref" in about:
        return "a table, see below"
    if "anyOf" in about:
        return " or ".join(_value(each) for each in about["anyOf"] if each.get("type") != "null")
    if "enum" in about:
        return ", ".join(f"`{each}`" for each in about["enum"])
    kinds = {"integer": "integer", "number": "number", "string": "text", "boolean": "true or false", "object": "table"}
    if about.get("type") == "array":
        items = about.get("prefixItems")
        inner = _value(items[0] if items else about["items"])
        return f"{len(items)} of: {inner}" if items else f"list of: {inner}"
    bounds = [
        f"{sign} {about[key]:g}"
        for key, sign in (("exclusiveMinimum", ">"), ("minimum", "≥"), ("exclusiveMaximum", "<"), ("maximum", "≤"))
        if key in about
    ]
    return " ".join([kinds.get(about.get("type", ""), "any"), ", ".join(bounds)]).strip()


def _default(field: Any, about: dict[str, Any]) -> str:
    if "default" not in about:
        return "the table's defaults" if "$ref" in about else ("empty" if about.get("type") == "object" else "required")
    default = about["default"]
    if default is None:
        return "none"
    if isinstance(default, dict):
        return "the table's defaults" if default else "empty"
    return f"`{default}`" if isinstance(default, str) else f"`{_toml(default)}`"


def _toml(value: Any) -> str:
    """Return a value in the syntax of TOML."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(each) for each in value)}]"
    return "none" if value is None else str(value)


def _presets() -> str:
    """Return tables of the keys in which the presets differ."""
    flat = {name: _flat(dataclasses.asdict(preset)) for name, preset in PRESETS.items()}
    keys = [key for key in dict.fromkeys(k for values in flat.values() for k in values) if key != "name"]
    parts = list[str]()
    for task in ("hover", "track", "vision"):
        names = [name for name in PRESETS if PRESETS[name].task == task]
        rows = [f"| key | {' | '.join(f'`{name}`' for name in names)} |", "|---" * (len(names) + 1) + "|"]
        for key in keys:
            values = [flat[name].get(key, "-") for name in names]
            if len({each.get(key, "-") for each in flat.values()}) > 1 and set(values) != {"-"}:
                rows.append(f"| `{key}` | {' | '.join(values)} |")
        parts.append(f"### {task}\n\n" + "\n".join(rows))
    return "\n\n".join(parts)


def _flat(tables: dict[str, Any], prefix: str = "") -> dict[str, str]:
    rows = dict[str, str]()
    for key, value in tables.items():
        if isinstance(value, dict):
            rows |= _flat(value, f"{prefix}{key}.")
        elif not (value is None and key in ("track", "vision")):
            rows[prefix + key] = _toml(value)
    return rows


def _names() -> str:
    """Return a table of the public names with links to their documentation."""
    stub = Path(retrim.__file__).with_suffix(".pyi").read_text()
    packages = {name: package for package, name in re.findall(r"^from \.(\w+) import \w+ as (\w+)$", stub, re.M)}
    rows = ["| name | package | description |", "|---|---|---|"]
    for name, package in sorted(packages.items(), key=lambda pair: (pair[1], pair[0])):
        entry = getattr(retrim, name)
        documented = inspect.getdoc(entry) if inspect.isclass(entry) or inspect.isroutine(entry) else None
        own = getattr(entry, "__module__", "").startswith("retrim")
        line = (documented or "").split("\n\n")[0].replace("\n", " ").replace("|", "\\|") if documented and own else ""
        if inspect.ismethod(entry):
            line = f"Add a {name.removeprefix('register_')} under a new name, so that commands and files can use it."
            target = ""
        else:
            target = f"{entry.__module__}.{name}" if hasattr(entry, "__module__") and own else ""
        link = f"[`{name}`][{target}]" if target else f"`{name}`"
        plain = re.sub(r":\w+:", "", line)
        rows.append(f"| {link} | {package} | {plain} |")
    return "\n".join(rows)
