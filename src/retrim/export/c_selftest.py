"""Generate the self-test of an exported C header, which compares stored commands of the policy with computed ones.

The test reads stored numbers through a volatile pointer, so that it examines the memory of the target and a compiler
cannot compute the result in advance. It uses a separate memory, and leaves the memory of a flight unchanged.
"""

import math

import numpy as np

from .c_literals import array, bits
from .portable import Portable
from .runner import LARGEST

TOLERANCE = 1e-5  # largest deviation of a computed command from the stored one, as a fraction of the command range
INVALID = (math.nan, math.inf, -math.inf, LARGEST)  # the test puts each of them at each index
FORMAT, DAMAGE, LIMITS, OBSERVATION, STATE = 1, 2, 3, 4, 5
"""Numbers of the cases that are not test vectors."""
VECTORS, TICKS = 100, 200
"""Number of the first test vector, and of the first tick of the test flight."""
START, PRIME = 2166136261, 16777619  # of the 32-bit FNV-1a hash, here of words instead of bytes


def test_vectors(name: str, policy: Portable) -> list[str]:
    """Return the definitions of the stored inputs and outputs, and of their checksum."""
    lines = array(f"{name}_test_observations", policy.test_observations) + array(
        f"{name}_test_commands", policy.test_commands
    )
    if policy.observation is not None:
        lines += array(f"{name}_test_states", policy.test_states)
        lines += array(f"{name}_test_flight", policy.test_flight)
    total = START
    for _, values in _constants(policy):
        total = _checksum(total, values)
    return [
        *lines,
        f"static const uint32_t {name}_test_bits[{len(INVALID)}] = {{{', '.join(map(bits, INVALID))}}};",
        f"#define {name.upper()}_CHECKSUM 0x{total:08x}u",
        f"#define {name.upper()}_TOLERANCE {TOLERANCE:g}f /* of a command, as a fraction of its range */",
        "",
    ]


def self_test(name: str, policy: Portable) -> list[str]:
    """Return the functions of the self-test."""
    n, size = policy.test_observations.shape
    stored = [f"    sum = {name}_hash(sum, {name}_{part}, {values.size});" for part, values in _constants(policy)]
    has_step = policy.observation is not None
    return [
        *_hash(name),
        *_deviation(name),
        "/* Runs all cases; returns 0 or the number of the first that fails, and writes the largest deviation. */",
        f"static inline int {name}_run_cases(float *worst)",
        "{",
        "    const volatile float one = 1.0f;",
        "    const float copy = one;",
        "    float command[4], before[4] = {0};",
        f"    uint32_t bits, sum = {START}u;",
        "    int first = 0;",
        "    *worst = 1.0f;",
        "    memcpy(&bits, &copy, sizeof bits);",
        f"    if (sizeof(float) != sizeof bits || FLT_RADIX != 2 || FLT_MANT_DIG != 24 || FLT_MAX_EXP != 128) "
        f"return {FORMAT};",
        f"    if (bits != {bits(1.0)}) return {FORMAT};",
        *stored,
        f"    if (sum != {name.upper()}_CHECKSUM) return {DAMAGE};",
        "    for (int j = 0; j < 8; ++j) {",
        "        const float y[4] = {j & 1 ? 200.0f : -200.0f, j & 2 ? 200.0f : -200.0f, j & 4 ? 1e30f : -1e30f,",
        "                            j & 1 ? 1e30f : -1e30f};",
        f"        if (!{name}_bound(y, command)) return {LIMITS};",
        f"        for (int i = 0; i < 4; ++i) before[i] = y[i] > 0.0f ? {name}_high[i] : {name}_low[i];",
        f"        if ({name}_deviation(command, before) > {name.upper()}_TOLERANCE) return {LIMITS};",
        "    }",
        f"    for (int k = 0; k < {len(INVALID)} * {size}; ++k) {{",
        f"        float spoilt[{size}];",
        f"        memcpy(spoilt, {name}_test_observations, sizeof spoilt);",
        f"        memcpy(spoilt + k % {size}, {name}_test_bits + k / {size}, sizeof(float));",
        "        memcpy(before, command, sizeof before);",
        f"        if ({name}_command(spoilt, command) || memcmp(before, command, sizeof before)) return {OBSERVATION};",
        "    }",
        "    *worst = 0.0f;",
        f"    for (int k = 0; k < {n}; ++k) {{",
        f"        const int finite = {name}_command({name}_test_observations + {size} * k, command);",
        f"        const float deviation = finite ? {name}_deviation(command, {name}_test_commands + 4 * k) : 1.0f;",
        f"        if (!first && deviation > {name.upper()}_TOLERANCE) first = {VECTORS} + k;",
        "        if (deviation > *worst) *worst = deviation;",
        "    }",
        *(_flight(name, len(policy.test_flight)) if has_step else []),
        "    return first;",
        "}",
        "",
        "/* 0, or the number of the first case that fails:",
        f"   {FORMAT}: float is not IEEE 754 single precision; {DAMAGE}: a stored number is damaged;",
        f"   {LIMITS}: a large network output does not give the limit of the command;",
        f"   {OBSERVATION}: an observation that is not finite gives a command;",
        *([f"   {STATE}: a state that is not finite gives a command, or changes the next ones;"] if has_step else []),
        f"   {VECTORS} + k: the command for test observation k deviates{';' if has_step else '. */'}",
        *([f"   {TICKS} + k: the command at tick k of the test flight deviates. */"] if has_step else []),
        f"static inline int {name}_selftest(void)",
        "{",
        "    float worst;",
        f"    return {name}_run_cases(&worst);",
        "}",
        "",
        "/* Largest deviation at the test vectors, as a fraction of the range of commands; 1 if a case without a",
        "   deviation fails. */",
        f"static inline float {name}_check(void)",
        "{",
        "    float worst;",
        f"    (void){name}_run_cases(&worst);",
        "    return worst;",
        "}",
        "",
        "#ifndef retrim_selftest",
        f"#define retrim_selftest {name}_selftest",
        "#else /* a program with several policies names each self-test */",
        "#undef retrim_selftest",
        "#define retrim_selftest retrim_selftest_is_ambiguous",
        "#endif",
        "",
    ]


def _constants(policy: Portable) -> list[tuple[str, np.ndarray]]:
    """Return the names and values of all stored arrays, in the order of the checksum."""
    layers = [
        (f"{kind}{i}", part) for i, layer in enumerate(policy.layers) for kind, part in zip("wb", layer, strict=True)
    ]
    names = ["low", "high", "y0", "test_observations", "test_commands"]
    names += [] if policy.observation is None else ["test_states", "test_flight"]
    return layers + [(name, getattr(policy, name)) for name in names]


def _checksum(total: int, values: np.ndarray) -> int:
    """Return the hash of single-precision words: the change of one word always changes the result."""
    for word in np.ascontiguousarray(values, np.float32).ravel().view(np.uint32).tolist():
        total = (total ^ word) * PRIME & 0xFFFFFFFF
    return total


def _hash(name: str) -> list[str]:
    return [
        "/* Hash of stored numbers; a volatile pointer, since the memory of the target is examined, not the source. */",
        f"static inline uint32_t {name}_hash(uint32_t sum, const float *x, int n)",
        "{",
        "    const volatile float *stored = x;",
        "    for (int i = 0; i < n; ++i) {",
        "        const float copy = stored[i];",
        "        uint32_t bits;",
        "        memcpy(&bits, &copy, sizeof bits);",
        f"        sum = (sum ^ bits) * {PRIME}u;",
        "    }",
        "    return sum;",
        "}",
        "",
    ]


def _deviation(name: str) -> list[str]:
    return [
        "/* Largest difference between two finite commands, as a fraction of the range. */",
        f"static inline float {name}_deviation(const float *command, const float *expected)",
        "{",
        "    float worst = 0.0f;",
        "    for (int j = 0; j < 4; ++j) {",
        f"        const float deviation = fabsf(command[j] - expected[j]) / ({name}_high[j] - {name}_low[j]);",
        "        if (deviation > worst) worst = deviation;",
        "    }",
        "    return worst;",
        "}",
        "",
    ]


def _flight(name: str, ticks: int) -> list[str]:
    """Return the case of a flight: two memories, one of which also receives states that are not finite."""
    return [
        f"    {name}_memory memory, undisturbed;",
        f"    {name}_reset(&memory);",
        f"    {name}_reset(&undisturbed);",
        f"    for (int tick = 0; tick < {ticks}; ++tick) {{",
        f"        const float *x = {name}_test_states + 15 * tick;",
        f"        const int finite = {name}_step(&undisturbed, x, x + 3, x + 12, before);",
        f"        const float deviation = finite ? {name}_deviation(before, {name}_test_flight + 4 * tick) : 1.0f;",
        f"        if (!first && deviation > {name.upper()}_TOLERANCE) first = {TICKS} + tick;",
        "        if (deviation > *worst) *worst = deviation;",
        f"        if ({name}_step(&memory, x, x + 3, x + 12, command) != finite",
        "            || memcmp(command, before, sizeof before)) {",
        "            *worst = 1.0f;",
        f"            return {STATE};",
        "        }",
        f"        for (int k = 0; k < {len(INVALID)} * 15; ++k) {{",
        "            float spoilt[15];",
        "            memcpy(spoilt, x, sizeof spoilt);",
        f"            memcpy(spoilt + k % 15, {name}_test_bits + k / 15, sizeof(float));",
        f"            if ({name}_step(&memory, spoilt, spoilt + 3, spoilt + 12, command)",
        "                || memcmp(command, before, sizeof before)) {",
        "                *worst = 1.0f;",
        f"                return {STATE};",
        "            }",
        "        }",
        "    }",
    ]
