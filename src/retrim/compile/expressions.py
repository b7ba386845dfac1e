"""Provide NumPy expressions for the operations of a trace, by name.

Each expression is a function of the equation and the names of its operands.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.lax import GatherScatterMode, RoundingMethod

from ..errors import ConfigError

Expression = Callable[..., str]


def no_form(operation: str) -> ConfigError:
    """Return the error for an operation without a NumPy form."""
    return ConfigError(f"{operation} in this controller has no NumPy form, so it cannot fly live")


def _is_key(variable: Any) -> bool:
    return bool(jnp.issubdtype(variable.aval.dtype, jax.dtypes.prng_key))


def _of_one_key(expression: Expression) -> Expression:
    def check_key(eqn: Any, *operands: str) -> str:
        if eqn.invars[0].aval.ndim:
            raise no_form("a batch of random keys")
        return expression(eqn, *operands)

    return check_key


def _infix(symbol: str) -> Expression:
    return lambda eqn, a, b: f"{a} {symbol} {b}"


def _call(function: str) -> Expression:
    return lambda eqn, *operands: f"{function}({', '.join(operands)})"


def _reduction(ufunc: str) -> Expression:
    def expression(eqn: Any, x: str) -> str:
        axes, dtype = tuple(eqn.params["axes"]), np.dtype(eqn.outvars[0].aval.dtype)
        if ufunc.startswith("logical") and dtype.kind != "b":
            raise no_form("a bitwise reduction")
        # integers must wrap on overflow
        whole = f", dtype={dtype.name!r}" if ufunc in ("add", "multiply") and dtype.kind in "iu" else ""
        # the method of the ufunc takes half the time of the NumPy function
        return f"np.{ufunc}.reduce({x}, {axes[0] if len(axes) == 1 else axes}{whole})"

    return expression


def _stack(eqn: Any, *xs: str) -> str:
    if eqn.params["axis"] == 0 and not _is_key(eqn.invars[0]):  # takes a quarter of the time of np.stack
        return f"np.array(({', '.join(xs)},), {np.dtype(eqn.outvars[0].aval.dtype).name!r})"
    return f"np.stack(({', '.join(xs)},), axis={eqn.params['axis']})"


def _same(eqn: Any, x: str) -> str:
    return x


def _shape(eqn: Any) -> tuple[int, ...]:
    aval = eqn.outvars[0].aval
    return (*aval.shape, 2) if _is_key(eqn.outvars[0]) else tuple(aval.shape)


def _reshape(eqn: Any, x: str) -> str:
    return x if eqn.invars[0].aval.shape == eqn.outvars[0].aval.shape else f"{x}.reshape({_shape(eqn)})"


def _broadcast(eqn: Any, x: str) -> str:
    shape, before = _shape(eqn), eqn.invars[0].aval.shape
    if tuple(before) == tuple(eqn.outvars[0].aval.shape):
        return x
    if _is_key(eqn.invars[0]):
        raise no_form("a batch of random keys")
    spread = [1] * len(shape)
    for axis, n in zip(eqn.params["broadcast_dimensions"], before, strict=True):
        spread[axis] = n
    source = x if tuple(spread) == tuple(before) else f"{x}.reshape({tuple(spread)})"
    return source if tuple(spread) == shape else f"np.broadcast_to({source}, {shape})"


def _convert(eqn: Any, x: str) -> str:
    dtype, before = np.dtype(eqn.params["new_dtype"]), np.dtype(eqn.invars[0].aval.dtype)
    if dtype.kind in "iu" and before.kind == "f":
        return f"lax.to_integer({x}, {dtype.name!r})"
    return x if before == dtype else f"{x}.astype({dtype.name!r})"


def _slice(eqn: Any, x: str) -> str:
    p = eqn.params
    strides = p["strides"] or (1,) * len(p["start_indices"])
    axes = [
        f"{a}:{b}" + (f":{s}" if s != 1 else "")
        for a, b, s in zip(p["start_indices"], p["limit_indices"], strides, strict=True)
    ]
    return f"{x}[{', '.join(axes)}]"


def _select(eqn: Any, which: str, *cases: str) -> str:
    if _is_key(eqn.invars[1]) and eqn.invars[0].aval.ndim:
        raise no_form("a batch of random keys")
    if len(set(cases)) == 1:
        return cases[0]
    if len(cases) == 2 and eqn.invars[0].aval.dtype == bool:
        if not eqn.invars[0].aval.ndim:  # takes a fortieth of the time of np.where
            return f"({cases[1]} if {which} else {cases[0]})"
        return f"np.where({which}, {cases[1]}, {cases[0]})"
    return f"np.choose({which}, ({', '.join(cases)},))"


def _dot(eqn: Any, a: str, b: str) -> str:
    (over_a, over_b), (batch_a, batch_b) = eqn.params["dimension_numbers"]
    ranks = [v.aval.ndim for v in eqn.invars]
    if not batch_a and tuple(over_a) == (ranks[0] - 1,) and tuple(over_b) == (0,) and max(ranks) <= 2:
        return f"{a} @ {b}"
    if not batch_a:
        return f"np.tensordot({a}, {b}, ({tuple(over_a)}, {tuple(over_b)}))"
    letters = iter("abcdefghijklmnopqrstuvwxyz")
    left, right = [next(letters) for _ in range(ranks[0])], [next(letters) for _ in range(ranks[1])]
    for i, j in zip((*batch_a, *over_a), (*batch_b, *over_b), strict=True):
        right[j] = left[i]
    free_a = [left[i] for i in range(ranks[0]) if i not in (*batch_a, *over_a)]
    free_b = [right[j] for j in range(ranks[1]) if j not in (*batch_b, *over_b)]
    out = [left[i] for i in batch_a] + free_a + free_b
    return f"np.einsum('{''.join(left)},{''.join(right)}->{''.join(out)}', {a}, {b})"


def _div(eqn: Any, a: str, b: str) -> str:
    return f"{a} / {b}" if np.issubdtype(eqn.outvars[0].aval.dtype, np.floating) else f"lax.integer_div({a}, {b})"


def _power(eqn: Any, x: str) -> str:
    n = eqn.params["y"]
    return f"{x} * {x}" if n == 2 else f"{x} ** {n}" if n >= 0 else f"1 / {x} ** {-n}"


def _gather(eqn: Any, x: str, at: str) -> str:
    d, fill = eqn.params["dimension_numbers"], GatherScatterMode.FILL_OR_DROP
    if d.operand_batching_dims:
        raise no_form("gather with batches")
    axes = (d.offset_dims, d.collapsed_slice_dims, d.start_index_map, eqn.params["slice_sizes"])
    mode = GatherScatterMode.from_any(eqn.params["mode"])
    value, argument = eqn.params["fill_value"], ""
    if mode == fill and value is not None:  # the text of a float may be "nan", which is not a name
        value = np.asarray(value).item()
        argument = f", value=float({str(value)!r})" if isinstance(value, float) else f", value={value}"
    return f"lax.gather({x}, {at}, {', '.join(str(tuple(each)) for each in axes)}, fill={mode == fill}{argument})"


def _scatter(eqn: Any, x: str, at: str, updates: str) -> str:
    d, mode = eqn.params["dimension_numbers"], GatherScatterMode.from_any(eqn.params["mode"])
    if d.operand_batching_dims or mode == GatherScatterMode.CLIP:
        raise no_form("scatter with batches or clipped indices")
    axes = f"{tuple(d.update_window_dims)}, {tuple(d.inserted_window_dims)}, {tuple(d.scatter_dims_to_operand_dims)}"
    return f"lax.scatter({x}, {at}, {updates}, {axes})"


def _round(eqn: Any, x: str) -> str:
    if eqn.params["rounding_method"] != RoundingMethod.TO_NEAREST_EVEN:
        raise no_form("rounding away from zero")
    return f"np.round({x})"


def _cumsum(eqn: Any, x: str) -> str:
    axis, dtype = eqn.params["axis"], np.dtype(eqn.outvars[0].aval.dtype).name
    if eqn.params["reverse"]:
        return f"np.flip(np.cumsum(np.flip({x}, {axis}), {axis}, {dtype!r}), {axis})"
    return f"np.cumsum({x}, {axis}, {dtype!r})"


def _shift_right(eqn: Any, x: str, by: str) -> str:
    if np.dtype(eqn.invars[0].aval.dtype).kind != "u":
        raise no_form("a logical shift of signed integers")
    return f"{x} >> {by}"


def _split(eqn: Any, x: str) -> str:
    return f"np.split({x}, {np.cumsum(eqn.params['sizes'])[:-1].tolist()}, axis={eqn.params['axis']})"


def _unstack(eqn: Any, x: str) -> str:
    axis = eqn.params["axis"]
    return x if axis == 0 else f"np.moveaxis({x}, {axis}, 0)"


def _pad(eqn: Any, x: str, value: str) -> str:
    return f"lax.pad({x}, {value}, {tuple(tuple(int(n) for n in axis) for axis in eqn.params['padding_config'])})"


def _iota(eqn: Any) -> str:
    shape, along, dtype = _shape(eqn), eqn.params["dimension"], np.dtype(eqn.params["dtype"]).name
    spread = tuple(-1 if axis == along else 1 for axis in range(len(shape)))
    return f"np.broadcast_to(np.arange({shape[along]}, dtype={dtype!r}).reshape({spread}), {shape})"


def _index(function: str) -> Expression:
    return lambda eqn, x: (
        f"{function}({x}, axis={eqn.params['axes'][0]}).astype({np.dtype(eqn.params['index_dtype']).name!r})"
    )


EXPRESSIONS: dict[str, Expression] = {
    **{name: _infix(s) for name, s in {
        "add": "+", "add_any": "+", "sub": "-", "mul": "*", "pow": "**", "eq": "==", "ne": "!=", "lt": "<", "le": "<=",
        "gt": ">", "ge": ">=", "and": "&", "or": "|", "xor": "^",
    }.items()},
    **{name: _call(f"np.{f}") for name, f in {
        "sqrt": "sqrt", "exp": "exp", "log": "log", "log1p": "log1p", "expm1": "expm1", "sin": "sin", "cos": "cos",
        "tan": "tan", "tanh": "tanh", "atan2": "arctan2", "asin": "arcsin", "acos": "arccos", "atan": "arctan",
        "abs": "abs", "sign": "sign", "floor": "floor", "ceil": "ceil", "max": "maximum", "min": "minimum",
        "is_finite": "isfinite", "not": "invert", "square": "square", "rem": "fmod", "nextafter": "nextafter",
    }.items()},
    **{name: _reduction(f) for name, f in {
        "reduce_sum": "add", "reduce_max": "maximum", "reduce_min": "minimum", "reduce_and": "logical_and",
        "reduce_or": "logical_or", "reduce_prod": "multiply",
    }.items()},
    **dict.fromkeys(("stop_gradient", "copy", "copy_p", "optimization_barrier"), _same),
    "neg": lambda eqn, x: f"-{x}",
    "rsqrt": lambda eqn, x: f"1 / np.sqrt({x})",
    "logistic": _call("lax.logistic"),
    "round": _round,
    "div": _div,
    "integer_pow": _power,
    "clamp": lambda eqn, low, x, high: f"np.minimum(np.maximum({x}, {low}), {high})",
    "select_n": _select,
    "convert_element_type": _convert,
    "reshape": _reshape,
    "squeeze": _reshape,
    "expand_dims": _reshape,
    "broadcast_in_dim": _broadcast,
    "transpose": lambda eqn, x: f"{x}.transpose({tuple(eqn.params['permutation'])})",
    "rev": lambda eqn, x: f"np.flip({x}, {tuple(eqn.params['dimensions'])})",
    "slice": _slice,
    "split": _split,
    "unstack": _unstack,  # since jax 0.11
    "concatenate": lambda eqn, *xs: f"np.concatenate(({', '.join(xs)},), axis={eqn.params['dimension']})",
    "stack": _stack,
    "tile": lambda eqn, x: f"np.tile({x}, {tuple(eqn.params['reps'])})",
    "pad": _pad,
    "iota": _iota,
    "cumsum": _cumsum,
    "argmin": _index("np.argmin"),
    "argmax": _index("np.argmax"),
    "erf_inv": _call("lax.erf_inv"),
    "shift_right_logical": _shift_right,
    "shift_left": _infix("<<"),
    "bitcast_convert_type": lambda eqn, x: f"np.asarray({x}).view({np.dtype(eqn.params['new_dtype']).name!r})",
    "random_seed": _of_one_key(_call("threefry.seed")),
    "random_fold_in": _of_one_key(_call("threefry.fold_in")),
    "random_split": _of_one_key(lambda eqn, key: f"threefry.split({key}, {tuple(eqn.params['shape'])})"),
    "random_bits": _of_one_key(
        lambda eqn, key: f"threefry.bits({key}, {tuple(eqn.params['shape'])}, {eqn.params['bit_width']})"
    ),
    "dot_general": _dot,
    "gather": _gather,
    "scatter": _scatter,
    "dynamic_slice": lambda eqn, x, *at: f"lax.dynamic_slice({x}, ({', '.join(at)},), {_shape(eqn)})",
    "dynamic_update_slice": lambda eqn, x, new, *at: f"lax.dynamic_update_slice({x}, {new}, ({', '.join(at)},))",
}  # fmt: skip
