"""ROS 1, which has reached its end of life: a link to a vehicle, a bus and a peer, for stacks that need it."""
