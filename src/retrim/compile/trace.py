"""Convert controllers to NumPy source, so that the control process does not need JAX.

A controller is traced once, before take-off. Each operation of the trace becomes one line of NumPy. Values that depend
only on constants are computed during the conversion. Values that depend on parameters but not on inputs are computed
when the parameters change. All other values are computed each tick. Controllers, whether learned or classical,
built-in or user-defined, thus fly in real time with the same definition that is trained in JAX.
"""

import re
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import random
from jax.extend.core import ClosedJaxpr, Jaxpr, Var

from .expressions import EXPRESSIONS, no_form
from .ops import lax, threefry
from .ops.program import ProgramSource

CONSTANT, PARAMETER, INPUT = range(3)
INLINE = ("jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint")
LONGEST = 100  # maximum number of steps of a loop
NUMBER = ".reshape(())"
"""Expression that converts a block of one element to a scalar."""
BLOCK = re.compile(r"(\w+)\[(\d+:\d+(?:, \d+:\d+)*)\]")
Ref = tuple[str, int]
"""Name of a value in the source, and the kind of its dependency: constant, parameter or input."""


def numpy_program(function: Callable[..., Any], parameters: Any, inputs: Any) -> ProgramSource:
    """Convert a function of two pytrees to a program.

    Args:
        function: ``function(parameters, inputs)`` returns a pytree; it is traced with JAX.
        parameters: Example of the parameters, which change rarely.
        inputs: Example of the inputs, which are new at every call.

    Raises:
        ConfigError: The function contains an operation without a NumPy form in this module.
    """
    closed_jaxpr = jax.make_jaxpr(function)(parameters, inputs)
    writer = _Writer()
    kinds = [PARAMETER] * len(jax.tree.leaves(parameters)) + [INPUT] * len(jax.tree.leaves(inputs))
    refs: list[Ref] = [(f"p{i}" if kind == PARAMETER else f"i{i}", kind) for i, kind in enumerate(kinds)]
    outputs = writer.inline(closed_jaxpr, refs)
    return ProgramSource(writer.source(refs, outputs), writer.constants)


def plain(value: Any) -> np.ndarray:
    """Return a leaf as a NumPy array; a random key becomes its two words."""
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        value = random.key_data(value)
    return np.asarray(value)


class _Writer:
    """Collects source lines and constants."""

    def __init__(self) -> None:
        self.constants: dict[str, Any] = {}
        self.lines: list[tuple[str, str, int, tuple[str, ...]]] = []
        self._refs: dict[str, Ref] = {}
        self._scope: dict[str, Any] = {"np": np, "lax": lax, "threefry": threefry}

    def constant(self, value: Any) -> Ref:
        """Return the name of a constant."""
        array = plain(value)
        key = f"{array.dtype} {array.shape} {array.tobytes().hex()}"
        if key not in self._refs:
            name = f"c{len(self.constants)}"
            # NumPy scalars are several times faster than arrays without axes.
            self.constants[name] = self._scope[name] = array if array.ndim else array[()]
            self._refs[key] = (name, CONSTANT)
        return self._refs[key]

    def inline(self, closed_jaxpr: ClosedJaxpr, refs: Sequence[Ref]) -> list[Ref]:
        """Write the lines of a trace; return its outputs."""
        jaxpr: Jaxpr = closed_jaxpr.jaxpr
        result: dict[Var, Ref] = dict(zip(jaxpr.invars, refs, strict=True))
        result |= {var: self.constant(value) for var, value in zip(jaxpr.constvars, closed_jaxpr.consts, strict=True)}

        def read(atom: Any) -> Ref:
            return result[atom] if isinstance(atom, Var) else self.constant(np.asarray(atom.val, atom.aval.dtype))

        for eqn in jaxpr.eqns:
            operands = [read(atom) for atom in eqn.invars]
            name = eqn.primitive.name
            if name in INLINE:
                inner = eqn.params.get("jaxpr") or eqn.params.get("call_jaxpr") or eqn.params["fun_jaxpr"]
                if isinstance(inner, Jaxpr):
                    inner = ClosedJaxpr(inner, ())
                results = self.inline(inner, operands)
            elif name == "scan":
                results = self._unroll(eqn, operands)
            elif name in EXPRESSIONS:
                results = self._write(eqn, operands)
            else:
                raise no_form(f"operation {name!r}")
            result |= dict(zip(eqn.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _write(self, eqn: Any, operands: list[Ref]) -> list[Ref]:
        text = EXPRESSIONS[eqn.primitive.name](eqn, *(name for name, _ in operands))
        for name, kind in operands:
            if text == name and not eqn.primitive.multiple_results:  # the operation returns its operand unchanged
                return [(name, kind)]
        if not eqn.primitive.multiple_results:
            return [self._line(text, operands)]
        if max((kind for _, kind in operands), default=CONSTANT) == CONSTANT:
            return [self.constant(value) for value in eval(text, self._scope)]
        whole = self._line(text, operands)
        return [self._line(f"{whole[0]}[{i}]", [whole]) for i in range(len(eqn.outvars))]

    def _line(self, text: str, operands: Sequence[Ref]) -> Ref:
        """Return the name of an expression; identical expressions are written once."""
        text, operands = self._number(text, operands)
        kind = max((kind for _, kind in operands), default=CONSTANT)
        if kind == CONSTANT:
            return self.constant(eval(text, self._scope))
        if text not in self._refs:
            self._refs[text] = (f"v{len(self.lines)}", kind)
            self.lines.append((f"v{len(self.lines)}", text, kind, tuple(name for name, _ in operands)))
        return self._refs[text]

    def _number(self, text: str, operands: Sequence[Ref]) -> tuple[str, Sequence[Ref]]:
        """Index an array directly: NumPy scalars are several times faster than arrays without axes."""
        name = operands[0][0] if text.endswith(NUMBER) else ""
        block = BLOCK.fullmatch(self.lines[int(name[1:])][1]) if name.startswith("v") else None
        if block is None:
            return text, operands
        array, starts = block[1], re.sub(r":\d+", "", block[2])
        return f"{array}[{starts}]", [(array, operands[0][1])]

    def _unroll(self, eqn: Any, operands: list[Ref]) -> list[Ref]:
        """Write the body of a loop of known length once for each step."""
        params = eqn.params
        length, (constants, carry, slices) = params["length"], _parts(params, operands)
        if not 0 < length <= LONGEST:
            raise no_form(f"a loop of {length} steps, not of 1 to {LONGEST},")
        rows = [list[Ref]() for _ in range(length)]
        for i in reversed(range(length)) if params["reverse"] else range(length):
            refs = [self._line(f"{each[0]}[{i}]", [each]) for each in slices]
            after = self.inline(params["jaxpr"], [*constants, *carry, *refs])
            carry, rows[i] = after[: len(carry)], after[len(carry) :]
        columns = zip(*rows, strict=True)
        return [*carry, *(self._line(f"np.stack([{', '.join(n for n, _ in c)}])", c) for c in columns)]

    def source(self, refs: Sequence[Ref], outputs: Sequence[Ref]) -> str:
        """Return the source of both functions, without unused lines."""
        names, needed_lines = {name for name, _ in outputs}, []
        for line in reversed(self.lines):
            if line[0] in names:
                names |= set(line[3])
                needed_lines.append(line)
        needed_lines.reverse()
        kinds = dict(refs) | {name: kind for name, _, kind, _ in needed_lines}
        needed_inputs = {n for *_, kind, names in needed_lines if kind == INPUT for n in names} | {
            name for name, _ in outputs
        }
        needed_parameters = sorted(n for n in needed_inputs if kinds.get(n) == PARAMETER)

        def body(kind: int) -> list[str]:
            return [f"    {name} = {text}" for name, text, k, _ in needed_lines if k == kind]

        def unpack_line(names: Sequence[str], source: str) -> list[str]:
            return [f"    {', '.join(names)}, = {source}"] if names else []

        parameters = [name for name, kind in refs if kind == PARAMETER]
        inputs = [name for name, kind in refs if kind == INPUT]
        lines = ["def prepare(parameters):", *unpack_line(parameters, "parameters"), *body(PARAMETER)]
        lines += [f"    return [{', '.join(needed_parameters)}]", "", "def step(prepared, inputs):"]
        lines += [*unpack_line(needed_parameters, "prepared"), *unpack_line(inputs, "inputs"), *body(INPUT)]
        return "\n".join([*lines, f"    return [{', '.join(name for name, _ in outputs)}]", ""])


def _parts(params: dict[str, Any], operands: list[Ref]) -> tuple[list[Ref], ...]:
    """Split the operands of a loop into constants, carried values, and arrays with one row per step."""
    if "ft_in" in params:  # since jax 0.11
        return tuple(list(part) for part in params["ft_in"].update(operands).unpack())
    constants, carry_end = params["num_consts"], params["num_consts"] + params["num_carry"]
    return operands[:constants], operands[constants:carry_end], operands[carry_end:]
