"""Stand-in for the package of PX4 messages."""
