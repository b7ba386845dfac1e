"""Policies that a run has trained are kept in its folder: nobody waits for them twice, and `retrim fly` takes them."""

import re
from collections.abc import Sequence

from ...config.loading import dump
from ...config.presets import Preset
from ...config.setup import Setup
from ...config.trust import python_names
from ...control.policy import Policy
from ...errors import CheckpointError
from ...io.trained import load_policy, save_policy
from ..provenance import section_key
from ..reporter import Reporter
from ..run import Run
from ..training import train, trained_elsewhere
from .kept import files_behind, named_in

POLICIES = "policies"
UNSAFE = re.compile(r"[^\w.+=-]+")
"""In the name of a preset, which may be a path; what no file should be called."""


def trained_policies(preset: Preset, seeds: Sequence[int], run: Run, reporter: Reporter) -> dict[int, Policy]:
    """Return a policy for each seed; those that ``run.trained`` has are not trained again.

    Args:
        preset: What to train.
        seeds: Seeds of weights and starts.
        run: Its ``trained`` keeps the policies, of this code and of the files behind the preset.
        reporter: Receives progress.

    Returns:
        By seed, in their order; an interruption leaves out those that are not complete.

    Raises:
        JobError: A training failed in another process; told once the others have come.
    """
    made_of = section_key(preset=dump(preset), files=files_behind(*named_in(preset)))
    stem = f"{UNSAFE.sub('-', preset.name)}-{made_of[:8]}"
    paths = {seed: run.trained / POLICIES / f"{stem}-seed{seed}.safetensors" for seed in seeds}
    found = dict[int, Policy]()
    for seed, path in paths.items():
        if path.is_file():
            try:
                found[seed] = load_policy(path, trust=python_names(preset))[0]
            except CheckpointError as error:
                reporter.say(f"{error}; trained again")

    def landed(seed: int, policy: Policy) -> None:
        save_policy(paths[seed], policy, preset)
        found[seed] = policy

    missing = [seed for seed in paths if seed not in found]
    if missing and run.executor is not None and not run.interrupted:
        trained_elsewhere(preset, missing, run.executor, reporter=reporter, stop=run.stop, landed=landed)
        missing = []
    setup = Setup.of(preset)  # one: its programs are shared by the seeds
    for seed in missing:
        if run.interrupted:
            break
        reporter.say(f"preset {preset.name}, seed {seed}")
        policy, _ = train(setup, seed, reporter=reporter, stop=run.stop)
        if not run.interrupted:
            landed(seed, policy)
    return {seed: found[seed] for seed in paths if seed in found}
