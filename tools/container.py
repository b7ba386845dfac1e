"""Build the image of the Containerfile, and fly a short demo in it as a user does.

``make container`` uses docker or podman if its daemon answers. Elsewhere this program runs the instructions itself. It
accepts the instructions that the file uses, and refuses all others. Each stage is a folder that becomes the root file
system. /usr and /etc of this machine, and the Python that runs this program, replace the base image; they are mounted
read-only. The commands start with an empty environment, except for proxies, certificates and the package index. The
mounts are in a mount namespace, which takes Linux and the rights of root.

The program cannot check the contents of the base image, and not the size of layers.
"""

import json
import os
import re
import shlex
import shutil
import string
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
DEMO = ("demo", "--seconds", "8", "--starts", "1", "--no-slow", "--out", "demo")
PICTURE = Path("demo", "hover_large.png")
BASE = re.compile(r"python:(?P<version>\d+\.\d+)-slim(?: AS (?P<name>\w+))?")
WORDS = ("FROM", "ENV", "WORKDIR", "COPY", "RUN", "USER", "ENTRYPOINT", "CMD")
NETWORK = re.compile(
    r"(https?|no)_proxy|(pip|uv)_(\w+_)?(index|index_url|cert)|ssl_cert_(file|dir)|\w+_ca_bundle", re.I
)
"""Variables by which a machine reaches the package index; they belong to the machine, and not to the image."""


class ContainerError(Exception):
    """The file cannot be built here; the message has one line."""


class Instruction(NamedTuple):
    """One instruction of the file."""

    word: str
    text: str


@dataclass
class Image:
    """A stage: its file system, and the settings of its processes."""

    root: Path
    environment: dict[str, str]
    folder: str = "/"
    user: str = "0:0"
    words: dict[str, list[str]] = field(default_factory=dict)
    """Words of ENTRYPOINT and CMD."""

    def locate(self, path: str) -> Path:
        """Return where a path of the image lies on this machine; the path may be relative to the stage's folder."""
        inside = PurePosixPath(os.path.normpath(PurePosixPath(self.folder, path)))
        return self.root / inside.relative_to("/")

    def execute(self, words: Sequence[str], network: Mapping[str, str]) -> None:
        """Run a command in the image.

        Args:
            words: The command.
            network: Variables in addition to those of the image.

        Raises:
            ContainerError: The command fails.
        """
        variables = [f"{name}={value}" for name, value in {**network, **self.environment}.items()]
        change = ["chroot", f"--userspec={self.user}", "--groups=", str(self.root)]
        clean = ["/usr/bin/env", "-i", f"--chdir={self.folder}", *variables]
        status = subprocess.run([*change, *clean, *words], stdin=subprocess.DEVNULL, check=False).returncode
        if status:
            raise ContainerError(f"exit status {status} of: {shlex.join(words)}")


def parse_instructions(text: str) -> list[Instruction]:
    """Return the instructions of a container file with this content.

    Raises:
        ContainerError: An instruction is not one of those that this program runs.
    """
    lines = re.sub(r"\\\n", "", re.sub(r"^[ \t]*#.*\n", "", text, flags=re.M)).splitlines()
    parts = [line.split(maxsplit=1) for line in lines if line.strip()]
    result = [Instruction(word, "".join(rest).rstrip()) for word, *rest in parts]
    for instruction in result:
        if instruction.word not in WORDS:
            raise ContainerError(f"tools/container.py runs {', '.join(WORDS)}, and not {instruction.word}")
    return result


def is_ignored(path: str, patterns: Sequence[str]) -> bool:
    """Return whether a file is left out of the build; the last pattern that matches it or its parent decides.

    Args:
        path: Path of the file in the context.
        patterns: Lines of .dockerignore.
    """
    result, place = False, PurePosixPath("/", path)
    for line in patterns:
        pattern = line.removeprefix("!")
        pattern = pattern.removeprefix("**/") if pattern.startswith("**/") else f"/{pattern}"
        if any(each.match(pattern) for each in (place, *place.parents)):
            result = not line.startswith("!")
    return result


def copy_files(text: str, image: Image, stages: Mapping[str, Image], context: Path) -> None:
    """Execute COPY.

    Args:
        text: Sources and destination, after an optional ``--from=STAGE``.
        image: Stage that receives the files.
        stages: Earlier stages by name.
        context: Folder of the build.

    Raises:
        ContainerError: A source does not exist, or .dockerignore leaves it out.
    """
    *sources, target = text.split()
    lines = map(str.strip, (context / ".dockerignore").read_text().splitlines())
    patterns, origin = [line for line in lines if line and not line.startswith("#")], context
    if sources[0].startswith("--from="):
        patterns, origin = [], stages[sources.pop(0).removeprefix("--from=")].root
    place = image.locate(target)
    for name in sources:
        source = origin / name.lstrip("/")
        if not source.exists() or is_ignored(name, patterns):
            raise ContainerError(f"COPY {name}: the build has no such file; does .dockerignore leave it out?")

        def leave_out(folder: str, names: list[str]) -> list[str]:
            inside = Path(folder).relative_to(origin)
            return [each for each in names if is_ignored((inside / each).as_posix(), patterns)]

        if source.is_dir():  # its content, not the folder itself
            shutil.copytree(source, place, symlinks=True, dirs_exist_ok=True, ignore=leave_out)
        else:
            final = place / source.name if target.endswith("/") or place.is_dir() else place
            final.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, final)


def mount(source: Path, target: Path, *options: str) -> None:
    """Mount a folder or file of this machine at another place.

    Args:
        source: What to mount.
        target: Where; it is made if necessary.
        options: Options of mount(8), as ``ro``.
    """
    if source.is_dir():
        target.mkdir(parents=True, exist_ok=True)
    else:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.touch()
    subprocess.run(["mount", "--bind", *(f"--options={each}" for each in options), source, target], check=True)


def make_base(root: Path) -> None:
    """Fill an empty folder with the files that replace the base image."""
    for name in ("bin", "sbin", "lib", "lib32", "lib64", "libx32"):
        if (link := Path("/", name)).is_symlink():
            (root / name).symlink_to(link.readlink())
        elif link.is_dir():
            mount(link, root / name, "ro")
    for name in ("usr", "etc"):
        mount(Path("/", name), root / name, "ro")
    for name in ("proc", "dev"):
        mount(Path("/", name), root / name)
    (root / "tmp").mkdir()
    (root / "tmp").chmod(0o1777)
    (root / "root").mkdir()
    if not (python := Path(sys.base_prefix)).is_relative_to("/usr"):
        mount(python, root / python.relative_to("/"), "ro")


def begin_stage(text: str, place: Path, stages: dict[str, Image]) -> Image:
    """Execute FROM.

    Args:
        text: Name of the base image, and optionally of the stage.
        place: Folder for the file systems.
        stages: Receives the stage.

    Raises:
        ContainerError: The base image is not the Python that runs this program.
    """
    base, version = BASE.fullmatch(text), f"{sys.version_info[0]}.{sys.version_info[1]}"
    if base is None or base["version"] != version:
        raise ContainerError(f"FROM {text}: only python:{version}-slim can be replaced here; run this with its Python")
    root = place / f"stage-{len(stages)}"
    root.mkdir(mode=0o755)
    make_base(root)
    path = f"{sys.base_prefix}/bin:/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
    image = stages[base["name"] or str(len(stages))] = Image(root, {"PATH": path, "HOME": "/root"})
    return image


def build_here(context: Path, place: Path, network: Mapping[str, str]) -> Image:
    """Run the instructions of the container file; return the last stage.

    Args:
        context: Folder of the build.
        place: Empty folder for the file systems.
        network: Variables that the commands need to reach the package index.

    Raises:
        ContainerError: An instruction fails.
    """
    instructions, stages = parse_instructions((context / "Containerfile").read_text()), dict[str, Image]()
    for instruction in instructions:
        word, text = instruction
        print(f"{word} {text}", flush=True)
        start = time.monotonic()
        if word == "FROM":
            image = begin_stage(text, place, stages)
        elif word == "RUN":
            image.execute(["/bin/sh", "-c", text], network)
            print(f"  {time.monotonic() - start:.1f} s", flush=True)
        elif word == "COPY":
            copy_files(text, image, stages, context)
        elif word == "ENV":
            for entry in shlex.split(text):
                name, _, value = entry.partition("=")
                image.environment[name] = string.Template(value).substitute(image.environment)
        elif word == "WORKDIR":
            image.folder = os.path.normpath(PurePosixPath(image.folder, text))
            image.locate(".").mkdir(parents=True, exist_ok=True)
        elif word == "USER":
            image.user = text
        else:
            image.words[word] = json.loads(text)
    return image


def fly_here(place: Path, results: Path) -> None:
    """Build the image, and fly the demo in it; the caller has made a mount namespace.

    Args:
        place: Empty folder for the file systems.
        results: Folder to mount at /runs.
    """
    network = {name: value for name, value in os.environ.items() if NETWORK.fullmatch(name)}
    image = build_here(ROOT, place, network)
    if re.fullmatch(r"[1-9]\d*:[1-9]\d*", image.user) is None:
        raise ContainerError(f"USER {image.user}: the numbers of a user and a group without rights are required")
    os.chown(results, *map(int, image.user.split(":")))
    mount(results, image.root / "runs")
    image.execute([*image.words["ENTRYPOINT"], *DEMO], {})


def find_builder() -> str | None:
    """Return the name of a program whose daemon builds images, or None."""
    for name in ("docker", "podman"):
        if shutil.which(name) and not subprocess.run([name, "info"], capture_output=True, check=False).returncode:
            return name
    return None


def main() -> int:
    """Build the image, fly the demo, and check that its picture is in the mounted folder."""
    if sys.argv[1:2] == ["--inside"]:
        fly_here(*map(Path, sys.argv[2:]))
        return 0
    builder = find_builder()
    with tempfile.TemporaryDirectory() as folder:
        place, results = Path(folder, "stages"), Path(folder, "runs")
        Path(folder).chmod(0o755)
        place.mkdir()
        results.mkdir()
        if builder:
            subprocess.run([builder, "build", "--file", "Containerfile", "--tag", "retrim", "."], cwd=ROOT, check=True)
            user = ["--user", f"{os.getuid()}:{os.getgid()}"] + ["--userns=keep-id"] * (builder == "podman")
            words = [builder, "run", "--rm", *user, "--volume", f"{results}:/runs", "retrim", *DEMO]
        elif sys.platform == "linux" and not os.getuid():
            words = ["unshare", "--mount", sys.executable, __file__, "--inside", str(place), str(results)]
        else:
            raise ContainerError("docker, podman, or the rights of root on Linux are required")
        status = subprocess.run(words, check=False).returncode
        picture = results / PICTURE
        if not status and not (picture.is_file() and picture.stat().st_size):
            raise ContainerError(f"the demo wrote no {PICTURE} into the mounted folder")
        for stage in sorted(place.iterdir()):
            size = subprocess.run(["du", "-sm", stage], capture_output=True, text=True, check=True).stdout.split()[0]
            print(f"{stage.name}: {size} MB of its own")
        return status


if __name__ == "__main__":
    try:
        sys.exit(main())
    except ContainerError as error:
        sys.exit(f"container: {error}")
