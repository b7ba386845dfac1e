"""Draw pictures; only the command line imports this package."""
