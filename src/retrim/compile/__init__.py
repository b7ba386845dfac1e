"""Compile JAX functions to NumPy programs, for controllers that run without JAX.

``trace`` and ``expressions`` need JAX and write the program before take-off. ``ops`` runs the program and needs only
NumPy.
"""
