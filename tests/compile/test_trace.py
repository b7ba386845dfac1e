"""A controller compiled to NumPy returns the same commands as in JAX, tick after tick."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax, random

from retrim import Measurement
from retrim.compile.ops.program import NumpyProgram
from retrim.compile.trace import numpy_program, plain
from retrim.config.loading import changed
from retrim.config.named_presets import PRESETS
from retrim.config.setup import Setup
from retrim.control.mppi import MppiController
from retrim.errors import ConfigError
from retrim.live.processes.controllers import plain_source
from retrim.onboard.pilot import LivePilot
from retrim.physics import so3
from retrim.physics.state import State
from retrim.runtime import ControllerPilot


def leaves(tree):
    return [plain(leaf)[()] for leaf in jax.tree.leaves(tree)]


def check(function, parameters, inputs, tolerance=1e-12):
    """Assert that the program and JAX return the same values, shapes and types."""
    program = NumpyProgram(numpy_program(function, parameters, inputs))
    result = program.step(program.prepare(leaves(parameters)), leaves(inputs))
    expected = leaves(jax.jit(function)(parameters, inputs))
    assert len(result) == len(expected)
    for a, b in zip(result, expected, strict=True):
        assert (np.shape(a), np.asarray(a).dtype) == (np.shape(b), np.asarray(b).dtype)
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


X = jnp.linspace(-1.4, 1.7, 24).reshape(2, 3, 4)
POSITIVE = jnp.abs(X) + 0.1
OPERATIONS = {
    "unary": lambda p, x: [
        jnp.sin(x), jnp.cos(x), jnp.tanh(x), jnp.exp(x), jnp.abs(x), jnp.sign(x), jnp.floor(x), jnp.ceil(x), -x,
        jnp.log(jnp.abs(x) + p), jnp.sqrt(jnp.abs(x)), lax.rsqrt(jnp.abs(x) + 1.0), jax.nn.sigmoid(x), jnp.square(x),
        x**3, lax.integer_pow(x, -2), jnp.round(x), jnp.arcsin(x / 2.0), jnp.arctan(x), jnp.expm1(x),
    ],
    "binary": lambda p, x: [
        x + p, x - p, x * p, x / p, jnp.arctan2(x, p), jnp.maximum(x, p), jnp.minimum(x, p), jnp.fmod(x, p),
        jnp.abs(x) ** p, x < p, x >= p, x == p, (x < p) & (x > -p), (x < p) | (x > 1.0), ~(x < p), (x < p) ^ (x > 1.0),
    ],
    "choice": lambda p, x: [
        jnp.where(x > p, x, p), jnp.clip(x, -p, p), lax.select_n(jnp.array(2), x, 2 * x, 3 * x), jnp.where(x > p, x, x),
        lax.select(p > 0.0, x, -x), lax.select(p < 0.0, x, -x), jnp.where(x[1, 2, 3] > p, x[0, 0, 0], p), p + (p > 9.0),
        lax.select(x[0, 0, 0] < p, x[0, 1, 2], jnp.nan * p), lax.select(p > 0.0, x > p, x < p),
    ],
    "shapes": lambda p, x: [
        x.reshape(6, 4), x[0, 1:, ::2], x[..., ::-1], x.transpose(2, 0, 1), jnp.broadcast_to(x[:, :1], (2, 5, 4)),
        jnp.concatenate([x, 2.0 * x], axis=1), jnp.stack([x, x], axis=-1), jnp.stack([x, p * x]),
        jnp.pad(x, ((0, 0), (1, 2), (0, 1))),
        lax.pad(x, p, ((0, 0, 0), (-1, 2, 1), (1, -1, 0))), jnp.split(x, [1, 3], axis=2), jnp.tile(x, (1, 2, 1)),
        jnp.squeeze(x[:1]), x[:, None], jnp.arange(5) * p, jnp.eye(3) * p, x[1, 2, 3], p * x[1, 0, 2] + x[0, 1, 1],
        jnp.stack([x[1, 2, 3], x[0, 0, 1], p]), jnp.stack([x[0, 0] > p, x[1, 1] > p]),
        (p + x[0, 1])[2] * x[:1, 1:2, 2:3], [*x], jnp.unstack(p + x[0], axis=1), [*(p * x[0, 0])],
        jnp.unstack(p + x[:1]),
    ],
    "sums": lambda p, x: [
        x.sum(), x.sum((0, 2)), x.max(1), x.min((1, 2)), x.mean(0), x.prod(2),
        (x > p).any(1), (x > p).all(), x.cumsum(1),
        x.argmin(2), x.argmax(0),
    ],
    "products": lambda p, x: [
        x[0] @ x[1].T, x[0] @ x[1, 0], x[0, 0] @ x[1].T, jnp.einsum("bij,bkj->bik", x, x),
        jnp.einsum("bij,bkj->bki", x, p * x),
        jnp.tensordot(x, x, ((0, 2), (0, 2))), jnp.einsum("bij,bij->b", x, x), jnp.outer(x[0, 0], x[1, 1]),
    ],
    "indices": lambda p, x: [
        x[0, 1, jnp.array([3, 0, 2])], jnp.take(x, jnp.array([1, 5]), axis=1), x[jnp.int32(p), 2], x.at[0, 1].set(p),
        x.at[:, jnp.array([2])].set(7.0), lax.dynamic_slice(x, (0, jnp.int64(p + 5.0), 1), (2, 2, 2)), x[jnp.int32(-1)],
        lax.dynamic_update_slice(x, jnp.ones((1, 2, 2)), (jnp.int64(p), 2, 1)), 7 // jnp.int32(2 + p), x.astype(int),
    ],
    "integers": lambda p, x: [
        ~x.astype(jnp.int32), (1e9 * x).astype(jnp.int32), jnp.array([jnp.nan, 3e9, -3e9, jnp.inf, -jnp.inf, -1.7])
        .astype(jnp.int32) + (0 * p).astype(jnp.int32), (2e9 * jnp.abs(x)).astype(jnp.int32).sum(1),
        (2e9 * jnp.abs(x)).astype(jnp.int32).cumsum(2), (9e5 * x).astype(jnp.int32).prod(0), (300 * x).astype(jnp.int8),
        jnp.arange(5.0)[jnp.clip((1e30 * x).astype(jnp.int32), 0, 4)], (4e9 * jnp.abs(x)).astype(jnp.uint32) >> 3,
        jnp.take(jnp.arange(4, dtype=jnp.uint32), jnp.array([1, 9]) + (0 * p).astype(int), mode="fill"),
        jnp.take(x > 0, jnp.array([1, 9]) + (0 * p).astype(int), axis=1, mode="fill"),
        jnp.take(x, jnp.array([1, 9]) + (0 * p).astype(int), axis=1, mode="fill", fill_value=-2.5),
        jnp.take(x.astype(int), jnp.array([1, 9]) + (0 * p).astype(int), axis=1, mode="fill", fill_value=7),
    ],
    "loops": lambda p, x: [
        lax.scan(lambda c, row: (c * p + row.sum(), c), x[0, 0, 0], x),
        lax.scan(lambda c, row: (c + row, (c, row[0])), x[0], (x + p), reverse=True),
        lax.fori_loop(0, 5, lambda i, c: c + i * p, x), lax.map(jnp.cumsum, x[0]),
        lax.scan(lambda c, _: (c + p, jnp.arange(2.0)), x, None, length=3),
    ],
}  # fmt: skip


DRAWS = {
    "normal": lambda k: random.normal(k, (3, 4)),
    "uniform": lambda k: random.uniform(k, (5,), minval=-1.0, maxval=2.0),
    "split": lambda k: random.split(k, 3),
    "one of a split": lambda k: random.normal(random.split(k, 3)[1]),
    "folded": lambda k: random.fold_in(k, jnp.uint32(7)),
    "integers": lambda k: random.bits(k, (6,), "uint32"),
    "single precision": lambda k: random.normal(k, (4,), jnp.float32),
}


@pytest.mark.parametrize("name", DRAWS)
def test_random_numbers_equal_jax(name):
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        check(lambda _, k: DRAWS[name](k), jnp.array(0.0), random.key(11), tolerance=2e-6)
        check(lambda _, seed: DRAWS[name](random.key(seed)), jnp.array(0.0), jnp.array(-5, jnp.int32), tolerance=2e-6)


@pytest.mark.parametrize("name", OPERATIONS)
def test_operation_equals_jax(name):
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        check(OPERATIONS[name], jnp.array(0.7), X)


def test_expressions_of_parameters_are_computed_once():
    source = numpy_program(lambda p, x: jnp.exp(p) * x + jnp.sin(jnp.array(2.0)), jnp.array(0.3), X)
    prepare, step = source.text.split("def step")
    assert "np.exp" in prepare
    assert "np.exp" not in step
    assert "np.sin" not in source.text


def test_unsupported_operation_is_refused_before_take_off():
    with pytest.raises(ConfigError, match="operation 'sort' in this controller has no NumPy form"):
        numpy_program(lambda p, x: jnp.sort(x), jnp.array(0.0), X)
    with pytest.raises(ConfigError, match="rounding away from zero in this controller has no NumPy form"):
        numpy_program(lambda p, x: lax.round(x), jnp.array(0.0), X)
    many = random.split(random.key(0), 4)
    for function in (
        lambda p, x: jax.vmap(lambda k: random.normal(k, (2,)))(random.split(random.key(x), 64)).mean(0),
        lambda p, x: jax.vmap(lambda k: random.split(k, 2))(random.split(random.key(x), 4)),
        lambda p, x: random.key_data(jnp.where(jnp.arange(4) > x, many, random.key(x))),
    ):
        with pytest.raises(ConfigError, match="a batch of random keys in this controller has no NumPy form"):
            numpy_program(function, jnp.array(0.0), jnp.array(3))
    for function, what in (
        (lambda p, x: lax.shift_right_logical(x, jnp.array(1)), "a logical shift of signed integers"),
        (lambda p, x: lax.reduce_and_p.bind(x[None], axes=(0,)), "a bitwise reduction"),
    ):
        with pytest.raises(ConfigError, match=f"{what} in this controller has no NumPy form"):
            numpy_program(function, jnp.array(0.0), jnp.array(3))
    with pytest.raises(ConfigError, match="a loop of 101 steps, not of 1 to 100, in this controller has no NumPy form"):
        numpy_program(lambda p, x: lax.fori_loop(0, 101, lambda i, c: c + p, x), jnp.array(0.0), X)


@pytest.mark.parametrize(
    ("preset", "reference"),
    [
        ("hover/retrim", None),
        ("hover/paper", None),
        ("track/retrim", "figure8"),
        ("track/retrim with a load", "figure8"),
        ("track/fast", "star"),
        ("track/paced", "figure8=max"),
        ("vision/retrim", None),
        ("vision/ideal", None),
    ],
)
def test_preset_gives_same_commands(preset, reference):
    name, _, load = preset.partition(" with a ")
    values = changed(PRESETS[name], adapt={"residual": "swing"}) if load else PRESETS[name]
    setup = Setup.from_preset(values, reference)
    with jax.numpy_dtype_promotion("standard"):
        state = setup.learner.init(setup.new_policy(random.key(0)), random.key(1))
    parameters, fixed = eqx.partition(state, eqx.is_array)

    def decide(parameters, inputs):
        memory, t, x = inputs
        return setup.controller(eqx.combine(parameters, fixed))(memory, t, x)

    memory = eqx.filter_jit(lambda state, x: setup.controller(state).init(x))(
        state, State.at(jnp.array([0.0, 0.0, 1.0]))
    )
    program = NumpyProgram(numpy_program(decide, parameters, (memory, jnp.array(0.0), State.at(jnp.zeros(3)))))
    preparation, memory_before, jitted = program.prepare(leaves(parameters)), leaves(memory), jax.jit(decide)
    for i in range(25):
        a, b, c = random.split(random.key(i), 3)
        x = State(
            0.5 * random.normal(a, (3,)) + jnp.array([0.0, 0.0, 1.0]),
            so3.exp(0.3 * random.normal(b, (3,))),
            0.3 * random.normal(c, (3,)),
        )
        t = jnp.array(0.02 * i)
        u, memory = jitted(parameters, (memory, t, x))
        result = program.step(preparation, [*memory_before, *leaves((t, x))])
        memory_before = result[2:]
        for one, other in zip(result, leaves((u, memory)), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


def test_mppi_gives_same_commands():
    """MPPI has loops, and a random key among its parameters."""
    setup = Setup.from_preset(PRESETS["hover/fast"])
    pilot = setup.pilot(setup.new_policy(random.key(0)), "mppi", random.key(1))
    assert isinstance(pilot, ControllerPilot)
    assert isinstance(pilot.controller, MppiController)
    controller = dataclasses.replace(pilot.controller, samples=8, horizon=6)
    live, lockstep = LivePilot(plain_source(setup, controller)), ControllerPilot(controller)
    for i in range(5):
        x = State(jnp.array([0.1 * i, 0.0, 1.0]), so3.exp(jnp.array([0.1, 0.05 * i, 0.0])), jnp.zeros(3))
        flat = np.concatenate([np.ravel(leaf) for leaf in (x.p, x.R, x.v)])
        if i == 0:
            live.reset(flat)
            lockstep.reset(Measurement(0.0, x))
        np.testing.assert_allclose(
            live.act(0.02 * i, 0.0, flat), lockstep.act(Measurement(0.02 * i, x)).vector(), rtol=1e-9, atol=1e-9
        )
