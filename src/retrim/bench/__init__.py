"""Measure the run time and memory of each benchmark on this machine."""
