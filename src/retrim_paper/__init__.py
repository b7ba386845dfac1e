"""Reproduces the paper "Learning on the Fly" with retrim: tables, ablations, learned baselines and a demonstration.

retrim never imports this package. It finds the commands, and the methods ``datt`` and ``raptor``, through entry points.
"""

COMMANDS = {
    "demo": ("Show the whole loop: pretrain, fly, adapt; tables and pictures.", "retrim_paper.cli.demo"),
    "reproduce": (
        "Reproduce a table of the paper: hover, track, fast, vision, reversing, ...",
        "retrim_paper.cli.reproduce",
    ),
    "gauntlet": (
        "Fly a policy under many conditions: recovery time, steady error and worst error.",
        "retrim_paper.cli.gauntlet",
    ),
}
"""Help text and module of each command, by name."""
