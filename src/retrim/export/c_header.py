"""Export a policy as a C99 header in single precision, without allocation and with built-in test vectors.

The generated code tests the bits of numbers. With -ffast-math, a compiler would remove comparisons that fail only for
NaN.
"""

import math
import re
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..control.finite_controller import LARGEST
from ..io.files import write_whole
from .portable import Portable

WIDTH = 8  # numbers per line
BAD = (math.nan, math.inf, -math.inf, LARGEST)  # test vectors contain each of them at each index


def write_c(path: Path, policy: Portable) -> list[Path]:
    """Write a header and return its path; all names in the header begin with the file name."""
    write_whole(path, _header(name_of(path), policy))
    return [path]


def name_of(path: Path) -> str:
    """Return the prefix of all names in the header file at ``path``."""
    name = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    return f"_{name}" if name[0].isdigit() else name


def remark(text: object) -> str:
    """Return the text in a form that cannot end a comment, continue a line or begin a new comment."""
    return re.sub(r"[^\w./+ -]|/(?![\w.])", "_", str(text)[:64], flags=re.ASCII)


def _header(name: str, policy: Portable) -> str:
    sizes, guard = policy.sizes, f"{name.upper()}_H"
    shape = "-".join(map(str, sizes))
    lines = [
        f"/* Policy {shape}, preset {remark(policy.about['preset'])}, a command every {policy.about['dt']:g} s.",
        "   World ENU, body forward-left-up. Command: collective thrust, mass-normalised [m/s^2], body rates [rad/s].",
        f"   {name}_check() computes the test vectors below; fly only if it returns less than 1e-5. */",
        f"#ifndef {guard}",
        f"#define {guard}",
        "#include <math.h>",
        "#include <stdint.h>",
        "#include <string.h>",
        "",
        f"#define {name.upper()}_OBSERVATION {sizes[0]}",
        f"#define {name.upper()}_DT {_number(policy.about['dt'])}",
        "",
    ]
    for i, (w, b) in enumerate(policy.layers):
        lines += _array(f"{name}_w{i}", w) + _array(f"{name}_b{i}", b)
    for what in ("low", "high", "y0", "test_observations", "test_commands"):
        lines += _array(f"{name}_{what}", getattr(policy, what))
    lines += [f"static const uint32_t {name}_test_bits[{len(BAD)}] = {{{', '.join(map(_bits, BAD))}}};", ""]
    parts = (_finite(name), _layer(name), _command(name, sizes), _step(name, policy), _check(name, policy))
    return "\n".join([*lines, *(line for part in parts for line in part), f"#endif /* {guard} */", ""])


def _finite(name: str) -> list[str]:
    return [
        f"/* Whether all numbers are finite and smaller than {LARGEST:g}; by their bits, which -ffast-math leaves. */",
        f"static inline int {name}_finite(const float *x, int n)",
        "{",
        "    for (int i = 0; i < n; ++i) {",
        "        uint32_t bits;",
        "        memcpy(&bits, x + i, sizeof bits);",
        f"        if ((bits & 0x7fffffffu) >= {_bits(LARGEST)}) return 0;",
        "    }",
        "    return 1;",
        "}",
        "",
    ]


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
        "/* Returns 1; or 0, and leaves the command as it is, if observation or command are not finite. */",
        f"static inline int {name}_command(const float observation[{sizes[0]}], float command[4])",
        "{",
        f"    float a[{widest}], b[{widest}], u[4];",
        f"    if (!{name}_finite(observation, {sizes[0]})) return 0;",
    ]
    source, target = "observation", "a"
    for i, (inputs, outputs) in enumerate(pairwise(sizes)):
        lines.append(f"    {name}_layer({name}_w{i}, {name}_b{i}, {source}, {inputs}, {target}, {outputs});")
        if i < len(sizes) - 2:
            lines.append(f"    for (int j = 0; j < {outputs}; ++j) if ({target}[j] < 0.0f) {target}[j] = 0.0f;")
        source, target = target, "b" if target == "a" else "a"
    return [
        *lines,
        *(["    (void)b;"] if len(sizes) == 2 else []),
        "    for (int j = 0; j < 4; ++j)",
        f"        u[j] = {name}_low[j] + ({name}_high[j] - {name}_low[j]) "
        f"/ (1.0f + expf(-({source}[j] + {name}_y0[j])));",
        f"    if (!{name}_finite(u, 4)) return 0;",
        "    memcpy(command, u, sizeof u);",
        "    return 1;",
        "}",
        "",
    ]


def _check(name: str, policy: Portable) -> list[str]:
    n, size = policy.test_observations.shape
    return [
        "/* Largest error at the test vectors, as a share of the range of commands; 1 if a number that is not finite",
        "   changes anything. */",
        f"static inline float {name}_check(void)",
        "{",
        "    float worst = 0.0f, command[4];",
        f"    for (int k = 0; k < {n}; ++k) {{",
        f"        if (!{name}_command({name}_test_observations + {size} * k, command)) return 1.0f;",
        "        for (int j = 0; j < 4; ++j) {",
        f"            const float missed = fabsf(command[j] - {name}_test_commands[4 * k + j]) "
        f"/ ({name}_high[j] - {name}_low[j]);",
        "            if (!(missed <= worst)) worst = missed;",
        "        }",
        "    }",
        f"    for (int k = 0; k < {len(BAD)} * {size}; ++k) {{",
        f"        float spoilt[{size}], before[4];",
        f"        memcpy(spoilt, {name}_test_observations, sizeof spoilt);",
        f"        memcpy(spoilt + k % {size}, {name}_test_bits + k / {size}, sizeof(float));",
        "        memcpy(before, command, sizeof before);",
        f"        if ({name}_command(spoilt, command) || memcmp(before, command, sizeof before)) return 1.0f;",
        "    }",
        *([] if policy.observation is None else _check_steps(name)),
        "    return worst;",
        "}",
        "",
    ]


def _check_steps(name: str) -> list[str]:
    return [
        f"    {name}_memory memory, undisturbed;",
        "    float other[4], x[15] = {0.1f, 0.2f, 0.3f, 1.0f, 0.0f, 0.0f, 0.0f, 1.0f, 0.0f, 0.0f, 0.0f, 1.0f};",
        f"    {name}_reset(&memory);",
        f"    {name}_reset(&undisturbed);",
        "    for (int tick = 0; tick < 3; ++tick) {",
        "        x[0] += 0.5f;",
        f"        if (!{name}_step(&memory, x, x + 3, x + 12, command)) return 1.0f;",
        f"        if (!{name}_step(&undisturbed, x, x + 3, x + 12, other)) return 1.0f;",
        "        if (memcmp(command, other, sizeof other)) return 1.0f;",
        f"        for (int k = 0; k < {len(BAD)} * 15; ++k) {{",
        "            float spoilt[15];",
        "            memcpy(spoilt, x, sizeof spoilt);",
        f"            memcpy(spoilt + k % 15, {name}_test_bits + k / 15, sizeof(float));",
        f"            if ({name}_step(&memory, spoilt, spoilt + 3, spoilt + 12, other)) return 1.0f;",
        "            if (memcmp(command, other, sizeof other)) return 1.0f;",
        "        }",
        "    }",
    ]


def _step(name: str, policy: Portable) -> list[str]:
    """Return the code for the observation and a step from state to command, for policies that observe the state."""
    if policy.observation is None:
        return []
    observation, past = policy.observation, 4 * policy.observation["history"]
    gravity, size = _number(observation["gravity"]), policy.sizes[0]
    shift = [
        f"    for (int i = 0; i < {past - 4}; ++i) next.past[i] = next.past[i + 4];",
        f"    next.past[{past - 4}] = next.last[0] / {gravity} - 1.0f;",
        *(
            f"    next.past[{past - 4 + i}] = next.last[{i}] / {_number(w)};"
            for i, w in enumerate(observation["rates_max"], 1)
        ),
        f"    memcpy(observation + 15, next.past, {past} * sizeof(float));",
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
        "/* Once per control tick: p, v in the world, r the attitude, body to world, row by row. Returns 1; or 0 if",
        "   measurement or command are not finite: the command is then the last one, and the memory stays as it is. */",
        f"static inline int {name}_step({name}_memory *memory, const float p[3], const float r[9], const float v[3], "
        "float command[4])",
        "{",
        f"    {name}_memory next = *memory;",
        f"    float observation[{size}];",
        "    memcpy(command, memory->last, sizeof memory->last);",
        f"    if (!{name}_finite(p, 3) || !{name}_finite(r, 9) || !{name}_finite(v, 3)) return 0;",
        *(f"    observation[{i}] = (p[{i}] - {_number(x)}) / {_number(observation['position_scale'])};"
          for i, x in enumerate(observation["origin"])),
        "    memcpy(observation + 3, r, 9 * sizeof(float));",
        f"    for (int i = 0; i < 3; ++i) observation[12 + i] = v[i] / {_number(observation['velocity_scale'])};",
        *(shift if past else []),
        f"    if (!{name}_command(observation, command)) return 0;",
        "    memcpy(next.last, command, sizeof next.last);",
        "    *memory = next;",
        "    return 1;",
        "}",
        "",
    ]  # fmt: skip


def _array(name: str, values: np.ndarray) -> list[str]:
    flat = [_number(x) for x in values.ravel().tolist()]
    rows = [", ".join(flat[i : i + WIDTH]) for i in range(0, len(flat), WIDTH)]
    return [f"static const float {name}[{len(flat)}] = {{", ",\n".join(rows), "};"]


def _number(value: float) -> str:
    """Return the C literal of a number, exact in single precision."""
    text = f"{np.float32(value):.9g}"
    return f"{text}f" if any(sign in text for sign in ".e") else f"{text}.0f"


def _bits(value: float) -> str:
    """Return the bits of a number in single precision, as a C literal."""
    return f"0x{np.float32(value).view(np.uint32):08x}u"
