"""The public benchmark of learned model-predictive control: its quadrotor, its trajectories and its errors."""
