"""DATT, a learned baseline: a network that is trained by reinforcement learning, with an L1 estimator."""
