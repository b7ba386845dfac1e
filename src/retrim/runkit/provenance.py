"""Determines the provenance of results: the commit, versions, hardware and command line."""

import contextlib
import functools
import hashlib
import json
import os
import platform
import shlex
import subprocess
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax

PACKAGES = ("retrim", "jax", "jaxlib", "equinox", "optax", "numpy")
EXTRAS = ("rotorpy", "mujoco", "crazyflow", "foundation-policy")
"""Optional packages that some flights use."""
UNKNOWN_COMMIT = "unknown"
"""Placeholder for the commit if the package is not in a checkout."""
FOLDERS = ("retrim", "retrim_paper")
"""Folders of the distribution."""
PACKAGE = ("src", "pyproject.toml")
"""Paths of a checkout that belong to the package."""


@functools.cache
def commit() -> str:
    """Return the commit of this package's checkout, with ``-dirty`` if the package has local changes, or ``unknown``.

    Results and notes in the checkout do not count as changes to the package.
    """
    here = Path(__file__).resolve().parent

    def git(*words: str) -> str:
        return subprocess.run(
            ["git", "-C", str(here), *words], capture_output=True, text=True, check=True
        ).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")) / "src" / "retrim" != here.parent:
            return UNKNOWN_COMMIT
        changes = git("status", "--porcelain", "--", *(f":/{path}" for path in PACKAGE))
        return git("rev-parse", "--short=12", "HEAD") + ("-dirty" if changes else "")
    except (OSError, subprocess.CalledProcessError):
        return UNKNOWN_COMMIT


@functools.cache
def code() -> str:
    """Return a digest of this distribution's files; the digest does not depend on commits or the installation."""
    here, digest = Path(__file__).resolve().parents[2], hashlib.sha256()
    for path in sorted(path for folder in FOLDERS for path in (here / folder).rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            digest.update(f"{path.relative_to(here).as_posix()}\0{path.stat().st_size}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def describe_code() -> str:
    """Return the commit in words; for an installed package, which has no commit, return its version and code digest."""
    return (
        f"Commit {commit()}" if commit() != UNKNOWN_COMMIT else f"retrim {version('retrim')}, installed, code {code()}"
    )


def versions() -> dict[str, str]:
    """Return the versions of Python, the numerical packages and the installed extras."""
    return dict(_versions())


@functools.cache
def _versions() -> dict[str, str]:
    """Return the versions, cached: each look-up reads package files, and every flight in a sweep needs them."""
    result = {name: version(name) for name in PACKAGES}
    for name in EXTRAS:
        with contextlib.suppress(PackageNotFoundError):
            result[name] = version(name)
    return result | {"python": platform.python_version()}


def section_key(**what: Any) -> str:
    """Return a key that identifies a section: a digest of its inputs, the code and the versions.

    Args:
        **what: Inputs of the section: numbers, strings, and lists and dictionaries of them.
    """
    text = json.dumps({"code": code(), "versions": versions(), **what}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def describe_hardware() -> str:
    """Return the CPU cores and accelerators in words."""
    name = platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    accelerators = sorted({d.device_kind for d in jax.devices() if d.platform != "cpu"})
    return ", ".join([f"{cores()} CPU cores ({name})", *accelerators])


def cores() -> int:
    """Return the number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def command_line(words: Sequence[str]) -> str:
    """Return the command, quoted for a shell, with ``--out`` removed and absolute paths reduced to file names."""
    shown_words, words = list[str](), list(words)
    while words:
        option, sign, value = words.pop(0).partition("=")
        if option == "--out":
            words = words if sign else words[1:]
        elif sign:
            shown_words.append(f"{option}={Path(value).name if Path(value).is_absolute() else value}")
        else:
            shown_words.append(Path(option).name if Path(option).is_absolute() else option)
    return shlex.join(["retrim", *shown_words])
