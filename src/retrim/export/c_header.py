"""Export a policy as a C99 header in single precision, without allocation and with a self-test.

The generated code tests the bits of numbers. With -ffast-math, a compiler would remove comparisons that fail only for
NaN.
"""

import re
from itertools import pairwise
from pathlib import Path

from ..io.files import write_whole
from .c_literals import array, bits, number
from .c_selftest import self_test, test_vectors
from .portable import Portable
from .runner import LARGEST

STEEPEST = 80.0  # largest exponent of the sigmoid: exp(89) is infinite in single precision, and -ffast-math mistakes it


def write_c(path: Path, policy: Portable) -> list[Path]:
    """Write a header and return its path; all names in the header begin with the file name."""
    write_whole(path, _header(name_of(path), policy))
    return [path]


def name_of(path: Path) -> str:
    """Return the prefix of all names in the header file at ``path``: its name, which must begin with a letter in C."""
    name = re.sub(r"\W", "_", path.stem, flags=re.ASCII)
    return name if re.match("[A-Za-z]", name) else f"policy_{name}"


def remark(text: object) -> str:
    """Return the text in a form that cannot end a comment, continue a line or begin a new comment."""
    return re.sub(r"[^\w./+ -]|/(?![\w.])", "_", str(text)[:64], flags=re.ASCII)


def _header(name: str, policy: Portable) -> str:
    sizes, guard = policy.sizes, f"{name.upper()}_H"
    shape = "-".join(map(str, sizes))
    lines = [
        f"/* Policy {shape}, preset {remark(policy.about['preset'])}, a command every {policy.about['dt']:g} s.",
        "   World ENU, body forward-left-up. Command: collective thrust, mass-normalised [m/s^2], body rates [rad/s].",
        f"   Fly only if {name}_selftest(), or its alias retrim_selftest(), returns 0. */",
        f"#ifndef {guard}",
        f"#define {guard}",
        "#include <float.h>",
        "#include <math.h>",
        "#include <stdint.h>",
        "#include <string.h>",
        "",
        f"#define {name.upper()}_OBSERVATION {sizes[0]}",
        f"#define {name.upper()}_DT {number(policy.about['dt'])}",
        "",
    ]
    for i, (w, b) in enumerate(policy.layers):
        lines += array(f"{name}_w{i}", w) + array(f"{name}_b{i}", b)
    for what in ("low", "high", "y0"):
        lines += array(f"{name}_{what}", getattr(policy, what))
    lines += test_vectors(name, policy)
    parts = (
        _finite(name), _layer(name), _bound(name), _command(name, sizes), _step(name, policy), self_test(name, policy)
    )  # fmt: skip
    return "\n".join([*lines, *(line for part in parts for line in part), f"#endif /* {guard} */", ""])


def _finite(name: str) -> list[str]:
    return [
        f"/* Whether all numbers are finite and smaller than {LARGEST:g}; by their bits, which -ffast-math leaves. */",
        f"static inline int {name}_finite(const float *x, int n)",
        "{",
        "    for (int i = 0; i < n; ++i) {",
        "        uint32_t bits;",
        "        memcpy(&bits, x + i, sizeof bits);",
        f"        if ((bits & 0x7fffffffu) >= {bits(LARGEST)}) return 0;",
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


def _bound(name: str) -> list[str]:
    return [
        "/* The command of a network output. Returns 1; or 0, and leaves the command as it is, if it is not finite.",
        "   The exponent is limited: -ffast-math may turn the reciprocal of an infinite number into NaN. */",
        f"static inline int {name}_bound(const float y[4], float command[4])",
        "{",
        "    float u[4];",
        "    for (int j = 0; j < 4; ++j) {",
        f"        float exponent = -(y[j] + {name}_y0[j]);",
        "        uint32_t bits;",
        "        memcpy(&bits, &exponent, sizeof bits);",
        "        if ((bits & 0x7fffffffu) > 0x7f800000u) return 0;",
        f"        if (exponent > {number(STEEPEST)}) exponent = {number(STEEPEST)};",
        f"        u[j] = {name}_low[j] + ({name}_high[j] - {name}_low[j]) / (1.0f + expf(exponent));",
        "    }",
        f"    if (!{name}_finite(u, 4)) return 0;",
        "    memcpy(command, u, sizeof u);",
        "    return 1;",
        "}",
        "",
    ]


def _command(name: str, sizes: tuple[int, ...]) -> list[str]:
    widest = max(sizes[1:])
    lines = [
        "/* Returns 1; or 0, and leaves the command as it is, if observation or command are not finite. */",
        f"static inline int {name}_command(const float observation[{sizes[0]}], float command[4])",
        "{",
        f"    float a[{widest}], b[{widest}];",
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
        f"    return {name}_bound({source}, command);",
        "}",
        "",
    ]


def _step(name: str, policy: Portable) -> list[str]:
    """Return the code for the observation and a step from state to command, for policies that observe the state."""
    if policy.observation is None:
        return []
    observation, past = policy.observation, 4 * policy.observation["history"]
    gravity, size = number(observation["gravity"]), policy.sizes[0]
    shift = [
        f"    for (int i = 0; i < {past - 4}; ++i) next.past[i] = next.past[i + 4];",
        f"    next.past[{past - 4}] = next.last[0] / {gravity} - 1.0f;",
        *(
            f"    next.past[{past - 4 + i}] = next.last[{i}] / {number(w)};"
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
        *(f"    observation[{i}] = (p[{i}] - {number(x)}) / {number(observation['position_scale'])};"
          for i, x in enumerate(observation["origin"])),
        "    memcpy(observation + 3, r, 9 * sizeof(float));",
        f"    for (int i = 0; i < 3; ++i) observation[12 + i] = v[i] / {number(observation['velocity_scale'])};",
        *(shift if past else []),
        f"    if (!{name}_command(observation, command)) return 0;",
        "    memcpy(next.last, command, sizeof next.last);",
        "    *memory = next;",
        "    return 1;",
        "}",
        "",
    ]  # fmt: skip
