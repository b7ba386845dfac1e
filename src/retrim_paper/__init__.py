"""Reproduces the paper "Learning on the Fly" with retrim: tables, ablations, learned baselines and a demonstration.

retrim never imports this package. retrim finds the commands, and the methods ``datt`` and
``raptor``, through entry points.
"""

COMMANDS = {
    "demo": ("The whole loop: pretrain, fly, adapt; a table and pictures.", "retrim_paper.cli.demo"),
    "reproduce": (
        "Make a table of the paper again: hover, track, fast, vision, reversing, ...",
        "retrim_paper.cli.reproduce",
    ),
    "gauntlet": (
        "A policy under everything that changes, at hover or on references: recovery, steady and worst error.",
        "retrim_paper.cli.gauntlet",
    ),
}
"""Help text and module of each command, by name."""
