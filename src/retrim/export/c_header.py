"""C: one header of C99, single precision, without allocation, with test vectors inside."""

import re
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..io.files import write_whole
from .portable import Portable

WIDTH = 8  # numbers in a line


def write_c(path: Path, policy: Portable) -> list[Path]:
    """Write a header; names in it begin with that of the file. Returns its path."""
    write_whole(path, _header(name_of(path), policy))
    return [path]


def name_of(path: Path) -> str:
    """Return what all names in the header of a file begin with."""
    name = re.sub(r"\W", "_", path.stem)
    return f"_{name}" if name[0].isdigit() else name


def _header(name: str, policy: Portable) -> str:
    sizes, guard = policy.sizes, f"{name.upper()}_H"
    shape = "-".join(map(str, sizes))
    lines = [
        f"/* Policy {shape}, preset {policy.about['preset']}, a command every {policy.about['dt']:g} s.",
        "   World ENU, body forward-left-up. Command: collective thrust, mass-normalised [m/s^2], body rates [rad/s].",
        f"   {name}_check() computes the test vectors below; fly only if it returns less than 1e-5. */",
        f"#ifndef {guard}",
        f"#define {guard}",
        "#include <math.h>",
        "",
        f"#define {name.upper()}_OBSERVATION {sizes[0]}",
        f"#define {name.upper()}_DT {_number(policy.about['dt'])}",
        "",
    ]
    for i, (w, b) in enumerate(policy.layers):
        lines += _array(f"{name}_w{i}", w) + _array(f"{name}_b{i}", b)
    for what in ("low", "high", "y0", "test_observations", "test_commands"):
        lines += _array(f"{name}_{what}", getattr(policy, what))
    return "\n".join([*lines, *_layer(name), *_command(name, sizes), *_check(name, policy), *_step(name, policy),
                      f"#endif /* {guard} */", ""])  # fmt: skip


def _layer(name: str) -> list[str]:
    return [
        "/* y = x W + b; inputs that a ReLU has set to zero cost nothing. */",
        f"static inline void {name}_layer(",
        "    const float *w, const float *b, const float *x, int inputs, float *y, int outputs)",
        "{",
        "    for (int j = 0; j < outputs; ++j) y[j] = b[j];",
        "    for (int i = 0; i < inputs; ++i) {",
        "        const float xi = x[i];",
        "        if (xi == 0.0f) continue;",
        "        for (int j = 0; j < outputs; ++j) y[j] += xi * w[i * outputs + j];",
        "    }",
        "}",
        "",
    ]


def _command(name: str, sizes: tuple[int, ...]) -> list[str]:
    widest = max(sizes[1:])
    lines = [
        f"static inline void {name}_command(const float observation[{sizes[0]}], float command[4])",
        "{",
        f"    float a[{widest}], b[{widest}];",
    ]
    source, target = "observation", "a"
    for i, (inputs, outputs) in enumerate(pairwise(sizes)):
        lines.append(f"    {name}_layer({name}_w{i}, {name}_b{i}, {source}, {inputs}, {target}, {outputs});")
        if i < len(sizes) - 2:
            lines.append(f"    for (int j = 0; j < {outputs}; ++j) if ({target}[j] < 0.0f) {target}[j] = 0.0f;")
        source, target = target, "b" if target == "a" else "a"
    return [
        *lines,
        "    for (int j = 0; j < 4; ++j)",
        f"        command[j] = {name}_low[j] + ({name}_high[j] - {name}_low[j]) "
        f"/ (1.0f + expf(-({source}[j] + {name}_y0[j])));",
        "}",
        "",
    ]


def _check(name: str, policy: Portable) -> list[str]:
    n, size = policy.test_observations.shape
    return [
        "/* Largest error at the test vectors, as a share of the range of commands. */",
        f"static inline float {name}_check(void)",
        "{",
        "    float worst = 0.0f, command[4];",
        f"    for (int k = 0; k < {n}; ++k) {{",
        f"        {name}_command({name}_test_observations + {size} * k, command);",
        "        for (int j = 0; j < 4; ++j) {",
        f"            const float missed = fabsf(command[j] - {name}_test_commands[4 * k + j]) "
        f"/ ({name}_high[j] - {name}_low[j]);",
        "            if (!(missed <= worst)) worst = missed;",
        "        }",
        "    }",
        "    return worst;",
        "}",
        "",
    ]


def _step(name: str, policy: Portable) -> list[str]:
    """The observation of a state, and a step from state to command, where the policy sees the state alone."""
    if policy.observation is None:
        return []
    seen, past = policy.observation, 4 * policy.observation["history"]
    gravity, size = _number(seen["gravity"]), policy.sizes[0]
    shift = [
        f"    for (int i = 0; i < {past - 4}; ++i) memory->past[i] = memory->past[i + 4];",
        f"    memory->past[{past - 4}] = memory->last[0] / {gravity} - 1.0f;",
        *(
            f"    memory->past[{past - 4 + i}] = memory->last[{i}] / {_number(w)};"
            for i, w in enumerate(seen["rates_max"], 1)
        ),
        f"    for (int i = 0; i < {past}; ++i) observation[15 + i] = memory->past[i];",
    ]
    return [
        f"typedef struct {{ float last[4], past[{max(past, 1)}]; }} {name}_memory;",
        "",
        f"static inline void {name}_reset({name}_memory *memory)",
        "{",
        f"    for (int i = 0; i < {max(past, 1)}; ++i) memory->past[i] = 0.0f;",
        f"    for (int i = 0; i < 4; ++i) memory->last[i] = i == 0 ? {gravity} : 0.0f;",
        "}",
        "",
        "/* Once per control tick: p, v in the world, r the attitude, body to world, row by row. */",
        f"static inline void {name}_step({name}_memory *memory, const float p[3], const float r[9], const float v[3], "
        "float command[4])",
        "{",
        f"    float observation[{size}];",
        *(f"    observation[{i}] = (p[{i}] - {_number(x)}) / {_number(seen['position_scale'])};"
          for i, x in enumerate(seen["origin"])),
        "    for (int i = 0; i < 9; ++i) observation[3 + i] = r[i];",
        f"    for (int i = 0; i < 3; ++i) observation[12 + i] = v[i] / {_number(seen['velocity_scale'])};",
        *(shift if past else []),
        f"    {name}_command(observation, command);",
        "    for (int i = 0; i < 4; ++i) memory->last[i] = command[i];",
        "}",
        "",
    ]  # fmt: skip


def _array(name: str, values: np.ndarray) -> list[str]:
    flat = [_number(x) for x in values.ravel().tolist()]
    rows = [", ".join(flat[i : i + WIDTH]) for i in range(0, len(flat), WIDTH)]
    return [f"static const float {name}[{len(flat)}] = {{", ",\n".join(rows), "};"]


def _number(value: float) -> str:
    """Return a number that single precision reads back exactly."""
    text = f"{np.float32(value):.9g}"
    return f"{text}f" if any(sign in text for sign in ".e") else f"{text}.0f"
