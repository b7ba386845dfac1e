"""The instructions of the Containerfile, and the program that executes them without a daemon."""

import importlib.util
import json
import re
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def container():
    spec = importlib.util.spec_from_file_location("container", ROOT / "tools" / "container.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses search their module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


@pytest.fixture
def instructions(container):
    return container.parse_instructions((ROOT / "Containerfile").read_text())


def test_comments_and_line_breaks_are_removed_from_instructions(container):
    text = "# a\nFROM x AS y\n\nRUN one \\\n  # between\n    && two\n  WORKDIR /z\n"
    assert container.parse_instructions(text) == [("FROM", "x AS y"), ("RUN", "one     && two"), ("WORKDIR", "/z")]


def test_unsupported_instruction_is_refused(container):
    with pytest.raises(container.ContainerError, match="and not VOLUME"):
        container.parse_instructions("FROM x\nVOLUME /runs\n")


def test_image_starts_retrim_as_user_in_mounted_folder(container, instructions):
    last = dict(instructions)
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", last["USER"])
    assert last["WORKDIR"] == "/runs"
    assert json.loads(last["ENTRYPOINT"]) == ["retrim"]
    (oldest,) = re.findall(
        r">=([\d.]+)", tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    )
    assert {container.BASE.fullmatch(text)["version"] for word, text in instructions if word == "FROM"} == {oldest}


def test_every_installation_is_pinned(instructions):
    commands = " ".join(text for word, text in instructions if word == "RUN").split("&&")
    for command in (each for each in commands if " install " in each and "/" in each.split()[0]):
        assert re.search(r"--require-hashes|--constraints constraints\.txt|--no-deps", command), command


def test_last_matching_pattern_decides(container):
    patterns = ["*", "!src", "!tools/uv.txt", "**/__pycache__", "*.md", "!README.md"]
    included = ["src", "src/a/b.py", "tools/uv.txt", "README.md"]
    excluded = ["docs", "tools", "tools/mutants.py", "src/a/__pycache__", "src/a/__pycache__/b.pyc", "OTHER.md"]
    assert [path for path in included + excluded if not container.is_ignored(path, patterns)] == included


def test_copies_have_same_places_as_in_docker(container, tmp_path):
    context, root = tmp_path / "context", tmp_path / "root"
    for path in ("a.txt", "folder/b.txt", "folder/__pycache__/b.pyc", "secret"):
        (context / path).parent.mkdir(parents=True, exist_ok=True)
        (context / path).write_text(path)
    (context / ".dockerignore").write_text("# patterns\n*\n!a.txt\n!folder\n**/__pycache__\n")
    image = container.Image(root, {}, "/data")
    for text in ("a.txt ./", "a.txt /c.txt", "folder other", "folder/b.txt a.txt deep/er/"):
        container.copy_files(text, image, {}, context)
    result = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    assert result == {"data/a.txt", "c.txt", "data/other/b.txt", "data/deep/er/b.txt", "data/deep/er/a.txt"}
    second = container.Image(tmp_path / "second", {})
    container.copy_files("--from=first /data/other /x", second, {"first": image}, context)
    assert (tmp_path / "second/x/b.txt").read_text() == "folder/b.txt"
    for missing in ("secret /", "nowhere /"):
        with pytest.raises(container.ContainerError, match="no such file"):
            container.copy_files(missing, image, {}, context)


def test_other_base_image_is_refused(container, tmp_path):
    with pytest.raises(container.ContainerError, match="only python:"):
        container.begin_stage("python:2.7-slim", tmp_path, {})
