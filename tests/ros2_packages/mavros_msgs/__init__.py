"""Stand-in for the package of mavros's messages."""
