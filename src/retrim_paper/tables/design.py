"""The paper's design study (Sec. IV-C): training time and final error for each way to simulate and differentiate."""

from typing import Any

import numpy as np
from jax import random

from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.errors import ConfigError
from retrim.evaluation.metrics import mean_and_deviation
from retrim.evaluation.study import table_presets, train_all
from retrim.runkit.document import Document, TableSection
from retrim.runkit.flights import FlightSpec
from retrim.runkit.flying import cut_at_termination, score_flight
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import Run

from ..design import (
    CHOICES,
    CHUNK,
    ENVS,
    FIT_EPOCHS,
    PLANT,
    POLICY_EPOCHS,
    PUSH,
    ROLLOUT_S,
    ROLLOUTS,
    SCORE_S,
    fly_batch_of_policy,
    retrain,
)

PAPER = "the paper: low fidelity trains about twice as fast at a comparable error; res-back costs about 30 % more time"
COLUMNS = ("model", "time of an epoch [ms]", "beside the first", "compiling [s]", "residual left [m/s²]", "error [m]")


def design(
    run: Run,
    reporter: Reporter,
    *,
    preset: str = "hover/fast",
    seeds: tuple[int, ...] = (0, 1, 2),
    starts: int = 8,
    epochs: int = POLICY_EPOCHS,
) -> None:
    """The design study: time and error by model, by gradient source, and with or without residual gradients.

    Args:
        run: Folder for design.md and design.json.
        reporter: Receives progress and the section.
        preset: Preset for hover, with which the base policies are trained.
        seeds: Training seeds.
        starts: Scored flights per seed.
        epochs: Re-training epochs; a multiple of ten.
    """
    (base,) = table_presets([preset], "hover", seeds=seeds, starts=starts, seconds=SCORE_S)
    if epochs < CHUNK or epochs % CHUNK:
        raise ConfigError(f"--epochs {epochs} must be a positive multiple of {CHUNK}")
    intro = (
        f"Made by `retrim reproduce design`, after the paper's protocol: {ROLLOUTS} flights of {ROLLOUT_S:g} s of the "
        f"base policy under 2 m/s² along +x on plant `{PLANT}`; one residual network for each model, "
        f"{FIT_EPOCHS} epochs; {epochs} epochs of the policy, {ENVS} roll-outs each; then {starts} flights of "
        f"{SCORE_S:g} s without further learning, scored over their last 2 s. Times are medians over seeds and "
        f"programs of {CHUNK} epochs, with their range; the variants alternate. Compiling: as the "
        "machine's compile cache had it, for the first seed. High fidelity: rotors, thrust map, "
        "drag and rate controller at 1 kHz; its gradient is its own, or that of the point mass."
    )
    document = Document(run, "design", "Design study (Sec. IV-C of the paper)", intro, seeds, reporter)
    study = train_all(base, seeds, run, reporter)
    rows: list[dict[str, Any]] = []
    setup = Setup.from_preset(base)
    with run.interruptible(), reporter.progress("re-training") as advance:
        for seed, policy in study.policies.items() if not run.interrupted else ():
            logs = fly_batch_of_policy(setup, policy, ROLLOUTS, ROLLOUT_S, 1000 + seed)
            for i, (name, choice) in enumerate(CHOICES.items()):
                if run.interrupted:
                    break
                advance(len(rows) / (len(CHOICES) * len(study.policies)), f"{name}, seed {seed}")
                result = retrain(setup, policy, logs, random.key(seed), choice, epochs=epochs)
                spec = FlightSpec(Scenario(PUSH, PLANT), "base", 0, seed)
                flight_logs = fly_batch_of_policy(setup, result.policy, starts, SCORE_S, seed)
                flights = [score_flight(setup, spec, cut_at_termination(setup.flight_task, log)) for log in flight_logs]
                rows.append({
                    "model": name, "seed": seed, "order": i, "compile_s": result.compile_s, "epoch_s": result.epoch_s,
                    "residual_rms": result.residual_rms, "errors": [flight.steady for flight in flights],
                })  # fmt: skip
    if rows:
        document.add(_section(rows), rows)
    document.write()


def _section(rows: list[dict[str, Any]]) -> TableSection:
    first = np.median(np.concatenate([row["epoch_s"] for row in rows if row["order"] == 0]))
    lines = []
    for name in CHOICES:
        mine = [row for row in rows if row["model"] == name]
        if not mine:
            continue
        times = 1e3 * np.concatenate([row["epoch_s"] for row in mine])
        errors = np.concatenate([row["errors"] for row in mine])
        whole = errors[np.isfinite(errors)]
        crash_text = f", {len(errors) - len(whole)} crashed" if len(whole) < len(errors) else ""
        lines.append((
            name,
            f"{np.median(times):.1f} ({times.min():.1f} to {times.max():.1f})",
            f"{np.median(times) / (1e3 * first):.2f}",
            f"{max(row['compile_s'] for row in mine):.1f}",
            f"{np.mean([row['residual_rms'] for row in mine]):.3f}",
            mean_and_deviation(whole) + crash_text if len(whole) else "all crashed",
        ))  # fmt: skip
    return TableSection(COLUMNS, tuple(lines), "", PAPER[0].upper() + PAPER[1:] + ".")
