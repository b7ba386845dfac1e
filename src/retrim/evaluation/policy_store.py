"""Stores trained policies in a run's folder, so that they are trained only once and `retrim fly` can use them."""

import re
from collections.abc import Sequence

from ..config.loading import dump
from ..config.presets import Preset
from ..config.setup import Setup
from ..config.trust import python_names
from ..control.policy import AbstractPolicy
from ..errors import CheckpointError
from ..io.trained import load_policy, save_policy
from ..runkit.provenance import section_key
from ..runkit.reporter import Reporter
from ..runkit.run import Run
from ..runkit.training import train, trained_elsewhere
from .section_store import file_digests, named_in

POLICIES = "policies"
UNSAFE = re.compile(r"[^\w.+=-]+")
"""Characters in a preset's name (which may be a path) that are unsafe in a file name."""


def trained_policies(preset: Preset, seeds: Sequence[int], run: Run, reporter: Reporter) -> dict[int, AbstractPolicy]:
    """Return a policy for each seed; policies that are already in ``run.trained`` are not trained again.

    Args:
        preset: Preset to train with.
        seeds: Seeds for the weights and starts.
        run: Run whose ``trained`` folder stores the policies. They are reused only with the same code and the same
            files that the preset refers to.
        reporter: Receives the progress.

    Returns:
        Policies by seed, in order; after an interruption, incomplete ones are missing.

    Raises:
        JobError: Training failed in another process; raised after the other jobs are completed.
    """
    made_of = section_key(preset=dump(preset), files=file_digests(*named_in(preset)))
    stem = f"{UNSAFE.sub('-', preset.name)}-{made_of[:8]}"
    paths = {seed: run.trained / POLICIES / f"{stem}-seed{seed}.safetensors" for seed in seeds}
    result = dict[int, AbstractPolicy]()
    for seed, path in paths.items():
        if path.is_file():
            try:
                result[seed] = load_policy(path, trust=python_names(preset))[0]
            except CheckpointError as error:
                reporter.say(f"{error}; trained again")

    def on_result(seed: int, policy: AbstractPolicy) -> None:
        save_policy(paths[seed], policy, preset)
        result[seed] = policy

    missing = [seed for seed in paths if seed not in result]
    if missing and run.executor is not None and not run.interrupted:
        trained_elsewhere(preset, missing, run.executor, reporter=reporter, stop=run.stop, on_result=on_result)
        missing = []
    setup = Setup.from_preset(preset)  # one set-up, so that the seeds share its programs
    for seed in missing:
        if run.interrupted:
            break
        reporter.say(f"preset {preset.name}, seed {seed}")
        policy, _ = train(setup, seed, reporter=reporter, stop=run.stop)
        if not run.interrupted:
            on_result(seed, policy)
    return {seed: result[seed] for seed in paths if seed in result}
