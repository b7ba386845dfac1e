"""Policy network: a residual perceptron with tanh. `network = "network:residual"` in the table [pretrain]."""

import equinox as eqx
import jax

import retrim


class Residual(eqx.Module):
    first: eqx.nn.Linear
    second: eqx.nn.Linear
    last: eqx.nn.Linear

    def __call__(self, observation):
        h = jax.nn.tanh(self.first(observation))
        return 0.1 * self.last(h + jax.nn.tanh(self.second(h)))


def residual(request: retrim.NetworkRequest) -> eqx.Module:
    sizes = ((request.size, 64), (64, 64), (64, 4))
    return Residual(*(eqx.nn.Linear(*s, key=k) for s, k in zip(sizes, jax.random.split(request.key, 3))))
