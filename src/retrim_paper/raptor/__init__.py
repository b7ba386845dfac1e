"""RAPTOR, a learned baseline: a published recurrent policy that commands the motors."""
