"""Stand-in for the package of MAVROS messages."""
