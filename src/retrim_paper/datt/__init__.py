"""DATT, a learned baseline: a network trained by reinforcement learning, with an L1 estimator."""
