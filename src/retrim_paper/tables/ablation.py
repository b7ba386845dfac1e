"""Ablation: each component removed from our preset and added to the paper's, compared with no learning."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from retrim.config.limits import check_flights, check_seeds
from retrim.config.loading import changed, dump, load
from retrim.config.presets import Adapt, Preset
from retrim.config.scenario import Scenario
from retrim.evaluation.flight_groups import clear_flights
from retrim.evaluation.metrics import cell
from retrim.evaluation.study import Study, fly_all, train_all
from retrim.runkit.codecs import Rows, section_codec
from retrim.runkit.document import Document, TableSection
from retrim.runkit.flights import Flight
from retrim.runkit.provenance import section_key
from retrim.runkit.reporter import Reporter
from retrim.runkit.run import PARTS, Run

from ..ablation_options import CONTROL, OFF, ON, Lever

Task = Literal["hover", "track"]
DISTURBANCES = {"hover": ("none", "large", "step", "gusts", "pickup"), "track": ("none", "large", "gusts")}
REFERENCES: dict[str, tuple[str | None, ...]] = {"hover": (None,), "track": ("circle", "figure8")}
INTRO = """\
Made by `retrim reproduce ablation`. Mean error after 5 s of flight [m]: mean ± standard deviation over training seeds
and starts; this includes the error after a change in conditions, and not only the final error. Small quadrotor on
plant `bem`, ideal sensors. Learning is charged to flight time by fixed latencies. A setting of pretraining has its own
policies."""


def ablation(
    run: Run,
    reporter: Reporter,
    *,
    task: Task = "hover",
    seeds: tuple[int, ...] = (0,),
    seconds: float = 24.0,
    starts: int = 8,
) -> None:
    """Effect of each component: removed from our preset, added to the paper's, and compared with no learning.

    Args:
        run: Folder for ablation_hover.md or ablation_track.md, and its JSON file. The same command resumes after a
            kill.
        reporter: Receives progress and the sections.
        task: Either hover or track.
        seeds: Training seeds; each also seeds the starts, gusts and learners of its flights.
        seconds: Length of a flight [s].
        starts: Flights per disturbance, component and seed.
    """
    check_seeds(seeds)
    check_flights(starts, seconds)
    document = Document(run, f"ablation_{task}", f"Ablation: {task}", INTRO, seeds, reporter)
    studies = dict[str, Study]()
    for name, levers in ((f"{task}/retrim", (*CONTROL, *OFF[task])), (f"{task}/paper", (*CONTROL, *ON[task]))):
        lines, result = list[tuple[str, ...]](), list[dict[str, Any]]()
        for lever in levers:
            if run.interrupted:
                break
            preset = changed(load(name), **lever.changes)
            key = section_key(
                table="ablation", preset=dump(preset), lever=lever.label, method=lever.method, seeds=list(seeds),
                seconds=seconds, starts=starts,
            )  # fmt: skip
            section = run.store(reporter).get_or_make(
                f"{PARTS}/{key}",
                partial(_fly, name, preset, lever, task, studies, document, starts=starts, seconds=seconds),
                section_codec(run.folder),
                on_reuse=partial(run.reuse, f"{name}: {lever.label.strip('*')}", reporter),
                on_store=partial(clear_flights, run),
            )
            if section is None:
                break
            if not run.interrupted:
                lines += section[0].rows
            result += section[1]
        columns = tuple(
            each if reference is None else f"{reference}, {each}"
            for reference in REFERENCES[task]
            for each in DISTURBANCES[task]
        )
        document.add(TableSection(("lever", *columns), tuple(lines), f"Preset {name}"), result)
    document.write()


def _fly(
    name: str,
    preset: Preset,
    lever: Lever,
    task: Task,
    studies: dict[str, Study],
    document: Document,
    *,
    starts: int,
    seconds: float,
) -> tuple[TableSection, Rows] | None:
    """Fly one component under all disturbances; return its table line and its rows, None if no flight finished."""
    run, reporter = document.run, document.reporter
    reporter.say(f"{name}: {lever.label.strip('*')}")
    cells, result = list[str](), list[dict[str, Any]]()
    for reference in REFERENCES[task]:
        study = _study(_follows(preset, reference), studies, document.seeds, run, reporter)
        scenarios = [Scenario(each, reference=reference) for each in DISTURBANCES[task]]
        methods = (lever.method,)
        flights = fly_all(study, scenarios, run, reporter, methods=methods, starts=starts, seconds=seconds)
        for scenario in scenarios:
            group = [flight for flight in flights.flights if flight.spec.scenario == scenario]
            if group:
                result.append(_row(group, preset.name, lever))
                cells.append(cell(result[-1], digits=4))
    return (TableSection((), ((lever.label, *cells),)), result) if result else None


def _follows(preset: Preset, reference: str | None) -> Preset:
    """Return the preset for flying ``reference``; a policy without preview is trained on this reference alone."""
    if reference is None or preset.track is None or preset.track.looks_ahead:
        return preset
    return changed(preset, track={"reference": reference})


def _study(preset: Preset, studies: dict[str, Study], seeds: Sequence[int], run: Run, reporter: Reporter) -> Study:
    """Return the policies for a preset; presets with the same training share them."""
    key = dump(replace(preset, adapt=Adapt()))
    if key not in studies:
        studies[key] = train_all(preset, seeds, run, reporter)
    return replace(studies[key], preset=preset)


def _row(flights: Sequence[Flight], preset: str, lever: Lever) -> dict[str, Any]:
    errors = np.array([flight.late for flight in flights])
    whole, scenario = errors[np.isfinite(errors)], flights[0].spec.scenario
    return {
        "preset": preset,
        "lever": lever.label.strip("*"),
        "method": lever.method,
        "metric": "late",
        "disturbance": scenario.disturbance,
        "reference": scenario.reference,
        "mean": float(whole.mean()) if len(whole) else None,
        "std": float(whole.std(ddof=1)) if len(whole) > 1 else None,
        "n": len(errors),
        "crashes": len(errors) - len(whole),
    }
