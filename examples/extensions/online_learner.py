"""Online learner: evolution strategies instead of gradients. `learner = "online_learner:make"` in the table [adapt]."""

import jax
from jax.flatten_util import ravel_pytree

import retrim


class Evolution(retrim.OnlineLearner):
    length: float = 0.05  # of a step

    def retrain(self, state, env, starts, key):
        weights, tree = ravel_pytree(state.policy.params)
        noise = 0.01 * jax.random.normal(key, (self.num_updates, 8, weights.size), weights.dtype)

        def update(w, gradient):
            x0, noise = gradient
            cost = lambda w: retrim.policy_loss(state.policy.with_params(tree(w)).merged(), env, x0)
            uphill = jax.vmap(lambda e: cost(w + e) - cost(w - e))(noise) @ noise
            return w - self.length * uphill / (1e-9 + jax.numpy.linalg.norm(uphill)), None

        w, _ = jax.lax.scan(update, weights, (starts, noise))
        return retrim.PolicyState(state.policy.with_params(tree(w)), state.optimiser)


make = lambda request: request.create(Evolution)
