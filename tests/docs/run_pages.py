"""Run the Python blocks of pages as a reader would, with small, untrained policies and short flights; results as JSON.

Usage: ``python run_pages.py PAGE...`` in an empty folder. A block with a title is written to the file of that name.
"""

import json
import re
import sys
import traceback
from pathlib import Path

import retrim
from retrim.config import PRESETS

BLOCK = re.compile(r'^```(?P<language>python|toml)(?: title="(?P<title>[^"]+)")?\n(?P<code>.*?)^```', re.M | re.S)
SHORTER = {"ticks=1500": "ticks=4", "seconds=30": "seconds=1"}
SMALL = {
    "pretrain": {"hidden_sizes": (16, 16)},
    "adapt": {"num_updates": 2, "num_envs": 2, "fit_steps": 5, "window": 20},
}


def make_untrained(setup, seed=0):
    """Return an untrained policy, which replaces minutes of training."""
    from jax import random

    return setup.new_policy(random.key(seed))


def run(page: Path) -> str | None:
    """Run a page; return a traceback if a block fails, and an error if there is no block."""
    blocks = list(BLOCK.finditer(page.read_text()))
    for block in blocks:
        if block["title"]:
            Path(block["title"]).write_text(block["code"])
    expected = [block["code"] for block in blocks if block["language"] == "python" and not block["title"]]
    try:
        for code in expected:
            for long, short in SHORTER.items():
                code = code.replace(long, short)
            exec(compile(code, str(page), "exec"), {"__name__": "page"})
    except BaseException:
        return traceback.format_exc()
    return None if expected else "there is no Python block"


if __name__ == "__main__":
    sys.path.insert(0, str(Path.cwd()))
    retrim.Setup.pretrained = make_untrained
    PRESETS.update({name: retrim.changed(preset, **SMALL) for name, preset in PRESETS.items()})
    retrim.enable_compile_cache()
    result = {name: run(Path(name)) for name in sys.argv[1:]}
    Path("pages.json").write_text(json.dumps(result))
