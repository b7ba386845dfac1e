"""Trains the policies of a run once, and stores them so that `retrim fly` can use them."""

import re
from collections.abc import Sequence

from ..config.loading import dump
from ..config.presets import Preset
from ..config.setup import Setup
from ..control.policy import AbstractPolicy
from ..runkit.codecs import policy_codec
from ..runkit.file_digests import file_digests, preset_names
from ..runkit.provenance import section_key
from ..runkit.reporter import Reporter
from ..runkit.run import Run
from ..runkit.store import Store
from ..runkit.training import train, train_elsewhere

POLICIES = "policies"
UNSAFE_CHARACTERS = re.compile(r"[^\w.+=-]+")
"""Characters in a preset's name (which may be a path) that are unsafe in a file name."""


def train_policies(preset: Preset, seeds: Sequence[int], run: Run, reporter: Reporter) -> dict[int, AbstractPolicy]:
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
    inputs = section_key(preset=dump(preset), files=file_digests(*preset_names(preset)))
    stem = f"{POLICIES}/{UNSAFE_CHARACTERS.sub('-', preset.name)}-{inputs[:8]}"
    store, codec = Store(run.policy_folder, reporter=reporter, stop=run.stop), policy_codec(preset)
    result = dict[int, AbstractPolicy]()
    for seed in seeds:
        if (policy := store.get(f"{stem}-seed{seed}", codec)) is not None:
            result[seed] = policy

    def on_result(seed: int, policy: AbstractPolicy) -> None:
        store.put(f"{stem}-seed{seed}", policy, codec)
        result[seed] = policy

    missing = [seed for seed in dict.fromkeys(seeds) if seed not in result]
    if missing and run.executor is not None and not run.interrupted:
        train_elsewhere(preset, missing, run.executor, reporter=reporter, stop=run.stop, on_result=on_result)
        missing = []
    setup = Setup.from_preset(preset)  # one set-up, so that the seeds share its programs
    for seed in missing:
        if run.interrupted:
            break
        reporter.say(f"preset {preset.name}, seed {seed}")
        policy, _ = train(setup, seed, reporter=reporter, stop=run.stop)
        if not run.interrupted:
            on_result(seed, policy)
    return {seed: result[seed] for seed in seeds if seed in result}
