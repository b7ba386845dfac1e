"""The self-test of an exported header passes on a correct target, and returns the first case that fails otherwise."""

import dataclasses
import re
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from helpers import tiny_preset
from retrim.config import changed, load
from retrim.config.setup import Setup
from retrim.control.lora import LoraPolicy
from retrim.export.c_header import write_c
from retrim.export.c_literals import number
from retrim.export.c_selftest import DAMAGE, FORMAT, LIMITS, OBSERVATION, STATE, TICKS, TOLERANCE, VECTORS
from retrim.export.checking import FLAGS
from retrim.export.portable import FLIGHT, TESTS, portable_of

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no C compiler")

CPP = ("-std=c++11", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
COMPILERS = {
    "c99": ("gcc", *FLAGS), "unoptimised": ("gcc", *FLAGS, "-O0"), "fast-math": ("gcc", *FLAGS, "-ffast-math"),
    "c++": ("g++", *CPP),
    "careful": ("gcc", *FLAGS, "-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
}  # fmt: skip
PRESETS = {  # the observation of each kind of task
    "state": "hover/fast", "state and commands": "hover/retrim", "many vehicles": "hover/any",
    "many vehicles, reference": "track/any", "preview": "track/retrim", "pace": "track/paced",
    "tracking error": "track/paper", "keypoints": "vision/paper", "filtered keypoints": "vision/retrim",
}  # fmt: skip
MAIN = """
#include <stdio.h>
#include "quad.h"
int main(void) {
    printf("%d %.9g", retrim_selftest(), (double)quad_check());
    return quad_selftest() != retrim_selftest();
}
"""


def enlarge_weights(policy):
    """Return the policy with larger weights, so that commands change."""
    return policy.with_params(jax.tree.map(lambda leaf: jnp.asarray(6.0 * np.asarray(leaf)), policy.layers))


def make_portable(preset):
    setup = Setup.from_preset(preset)
    return portable_of(enlarge_weights(setup.new_policy(random.key(0))), setup)


@pytest.fixture(scope="module")
def quad():
    """Return a policy with a step function and a history of two commands."""
    return make_portable(tiny_preset(command_history=2))


def compile_and_run(folder, policy, *, compiler="unoptimised", main=MAIN, change=lambda text: text):
    """Compile a header in a folder, and return the words that the program prints.

    Without optimisation, the compiler takes less than half of the time.
    """
    write_c(folder / "quad.h", policy)
    text = (folder / "quad.h").read_text()
    (folder / "quad.h").write_text(change(text))
    source = "main.cpp" if compiler == "c++" else "main.c"
    (folder / source).write_text(main)
    if shutil.which(COMPILERS[compiler][0]) is None:
        pytest.skip("there is no such compiler")
    subprocess.run([*COMPILERS[compiler], source, "-o", "main", "-lm"], cwd=folder, check=True)
    return subprocess.run([folder / "main"], capture_output=True, text=True, check=True).stdout.split()


def swap_text(old, new, count=-1):
    """Return a function that replaces a text, which a header must contain."""

    def change(text):
        assert old in text
        return text.replace(old, new, count)

    return change


@pytest.mark.parametrize("kind", PRESETS)
def test_policy_of_every_kind_passes(kind, tmp_path):
    policy = make_portable(changed(load(PRESETS[kind]), pretrain={"hidden_sizes": [16, 16]}))
    for compiler in ("c99", "fast-math", "c++"):
        case, deviation = compile_and_run(tmp_path, policy, compiler=compiler)
        assert case == "0", compiler
        assert 0.0 < float(deviation) <= TOLERANCE, compiler
    assert (policy.observation is not None) == ("quad_step" in (tmp_path / "quad.h").read_text())


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize(("history", "sizes"), [(0, [8]), (3, [12, 16, 12])])
def test_every_history_and_depth_passes_with_every_compiler(history, sizes, compiler, tmp_path):
    policy = make_portable(tiny_preset(command_history=history, pretrain={"hidden_sizes": sizes}))
    assert len(policy.test_flight) == FLIGHT + history
    assert compile_and_run(tmp_path, policy, compiler=compiler)[0] == "0"


def test_merged_delta_passes(tmp_path):
    setup = Setup.from_preset(tiny_preset(command_history=2))
    low = LoraPolicy.of(enlarge_weights(setup.new_policy(random.key(0))), key=random.key(1), ranks=(2, 2, 1))
    low = low.with_params(jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf) + 0.1), low.delta))
    assert compile_and_run(tmp_path, portable_of(low.merged(), setup))[0] == "0"


EVERY_BIT = """
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#define const
#include "quad.h"
static int flip(float *x, int n)
{
    int missed = 0;
    for (int i = 0; i < 32 * n; ++i) {
        uint32_t bits;
        memcpy(&bits, x + i / 32, sizeof bits);
        bits ^= 1u << i % 32;
        memcpy(x + i / 32, &bits, sizeof bits);
        missed += quad_selftest() != 2;
        bits ^= 1u << i % 32;
        memcpy(x + i / 32, &bits, sizeof bits);
    }
    return missed;
}
int main(void) {
    int missed = 0;
    FLIP
    printf("%d %d", quad_selftest(), missed);
    return 0;
}
"""


def test_wrong_bit_in_any_number_is_found(tmp_path):
    """This includes the last bit of a weight, which hardly changes a command."""
    names = [f"{kind}{i}" for i in range(3) for kind in "wb"]
    names += ["low", "high", "y0", "test_observations", "test_commands", "test_states", "test_flight"]
    calls = "".join(f"missed += flip(quad_{name}, (int)(sizeof quad_{name} / sizeof(float)));" for name in names)
    small = make_portable(tiny_preset(command_history=2, pretrain={"hidden_sizes": [8, 8]}))
    assert compile_and_run(tmp_path, small, compiler="c99", main=EVERY_BIT.replace("FLIP", calls)) == ["0", "0"]


@pytest.mark.parametrize("row", range(TESTS))
def test_wrong_command_is_found_by_number(row, quad, tmp_path):
    """The checksum is correct, so that only the comparison fails."""
    wrong = quad.test_commands.copy()
    wrong[row:, row] += 3.0 * TOLERANCE * (quad.high - quad.low)[row]
    case, deviation = compile_and_run(tmp_path, dataclasses.replace(quad, test_commands=wrong))
    assert int(case) == VECTORS + row
    assert 2.0 * TOLERANCE <= float(deviation) <= 4.0 * TOLERANCE


@pytest.mark.parametrize("tick", range(FLIGHT + 2))
def test_wrong_tick_of_flight_is_found_by_number(tick, quad, tmp_path):
    wrong = quad.test_flight.copy()
    wrong[tick:, tick % 4] -= 3.0 * TOLERANCE * (quad.high - quad.low)[tick % 4]
    assert int(compile_and_run(tmp_path, dataclasses.replace(quad, test_flight=wrong))[0]) == TICKS + tick


@pytest.mark.parametrize("layer", range(3))
def test_different_weights_are_found(layer, quad, tmp_path):
    layers = list(quad.layers)
    layers[layer] = (np.float32(1.01) * layers[layer][0], layers[layer][1])
    assert (
        VECTORS <= int(compile_and_run(tmp_path, dataclasses.replace(quad, layers=tuple(layers)))[0]) < VECTORS + TESTS
    )


RECIPROCAL = """
#include <math.h>
/* One step of Newton's method from an estimate, which -ffast-math permits instead of a division. */
static float reciprocal(float a) { const float r = 1.0f / a; return r * (2.0f - a * r); }
"""
STEEP = "if (exponent > 80.0f) exponent = 80.0f;"
DIVISION = swap_text("/ (1.0f + expf(exponent))", "* reciprocal(1.0f + expf(exponent))")
OLD = "next.past[i] = next.past[i + 4]"
WRONG = {
    "an exponent without a limit": (LIMITS, lambda text: RECIPROCAL + DIVISION(swap_text(STEEP, "")(text))),
    "limits that are exchanged": (LIMITS, swap_text("quad_low[j] + (quad_high[j]", "quad_high[j] + (quad_high[j]")),
    "no test of bits": (OBSERVATION, swap_text("u) return 0;\n    }", "u) return 1;\n    }")),
    "a state that is not tested": (STATE, swap_text("|| !quad_finite(v, 3)) return 0;", ") return 0;")),
    "a memory of bad ticks": (STATE, swap_text("next = *memory;", "next = *memory;\n    memory->past[4] += 1.0f;")),
    "a history that does not move": (TICKS + 2, swap_text(OLD, "next.past[i] = next.past[i]")),
    "another origin": (TICKS, swap_text("(p[2] - 1.0f)", "(p[2] - 1.1f)")),
    "another gravity": (TICKS, swap_text("i == 0 ? 9.81", "i == 0 ? 9.60")),
}  # fmt: skip


@pytest.mark.parametrize("wrong", WRONG)
def test_code_with_different_results_is_found(wrong, quad, tmp_path):
    case, change = WRONG[wrong]
    assert int(compile_and_run(tmp_path, quad, change=change)[0]) == case


def test_reciprocal_of_fast_math_passes(quad, tmp_path):
    assert compile_and_run(tmp_path, quad, compiler="c99", change=lambda text: RECIPROCAL + DIVISION(text))[0] == "0"


def test_float_of_different_width_is_found(quad, tmp_path):
    wide = "#include <float.h>\n#include <math.h>\n#include <stdint.h>\n#include <string.h>\n#define float double\n"
    main = MAIN.replace('#include "quad.h"', wide + '#include "quad.h"')
    write_c(tmp_path / "quad.h", quad)
    (tmp_path / "main.c").write_text(main)
    subprocess.run(["gcc", "-std=c99", "-O0", "-w", "main.c", "-o", "main", "-lm"], cwd=tmp_path, check=True)
    result = subprocess.run([tmp_path / "main"], capture_output=True, text=True, check=True).stdout.split()
    assert int(result[0]) == FORMAT


@pytest.mark.parametrize("name", ["w0", "test_commands", "test_flight"])
def test_damaged_number_in_file_is_found(name, quad, tmp_path):
    """The next representable number deviates by less than the tolerance."""

    def change(text):
        before, first, after = re.fullmatch(rf"(.* quad_{name}\[\d+\] = {{\n)([^,]+)f(,.*)", text, re.S).groups()
        return before + number(float(np.nextafter(np.float32(first), np.float32(np.inf)))) + after

    assert int(compile_and_run(tmp_path, quad, change=change)[0]) == DAMAGE


FLY = """
#include <stdio.h>
#include "quad.h"
int main(void) {
    quad_memory plain, tested;
    float u[4], v[4];
    int wrong = 0;
    quad_reset(&plain);
    quad_reset(&tested);
    for (int tick = 0; tick < QUAD_TICKS; ++tick) {
        const float *x = quad_test_states + 15 * tick;
        quad_step(&plain, x, x + 3, x + 12, u);
        wrong += retrim_selftest();
        quad_step(&tested, x, x + 3, x + 12, v);
        wrong += memcmp(u, v, sizeof u) != 0;
    }
    printf("%d", wrong);
    return 0;
}
"""


def test_self_test_does_not_change_flight(quad, tmp_path):
    assert compile_and_run(tmp_path, quad, main=FLY.replace("QUAD_TICKS", str(len(quad.test_flight)))) == ["0"]


def test_program_with_two_policies_must_name_self_test(quad, tmp_path):
    """The common name would test only one of them."""
    write_c(tmp_path / "other.h", quad)
    both = '#include "other.h"\n#include "quad.h"\n'
    separate = (
        f'#include <stdio.h>\n{both}int main(void) {{ printf("%d", other_selftest() + quad_selftest()); return 0; }}'
    )
    assert compile_and_run(tmp_path, quad, main=separate) == ["0"]
    (tmp_path / "main.c").write_text(both + "int main(void) { return retrim_selftest(); }")
    compilation = subprocess.run(["gcc", *FLAGS, "main.c", "-lm"], cwd=tmp_path, capture_output=True, text=True)
    assert compilation.returncode != 0
    assert "retrim_selftest_is_ambiguous" in compilation.stderr
