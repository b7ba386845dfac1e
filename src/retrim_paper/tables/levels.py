"""Lays out table sections as in the paper: a row per method, and a column per disturbance level."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from jax import random

from retrim.config.loading import dump
from retrim.config.methods import find_method
from retrim.config.presets import Preset
from retrim.config.scenario import Scenario
from retrim.config.setup import Setup
from retrim.control.baselines import BASELINES
from retrim.evaluation.figures import picture
from retrim.evaluation.flight_groups import clear_flights
from retrim.evaluation.metrics import cell, metres, rows
from retrim.evaluation.study import Study, fly_all, refuse_misfits, train_all
from retrim.runkit.codecs import Rows, section_codec
from retrim.runkit.document import Document, TableSection
from retrim.runkit.file_digests import file_digests, preset_names, scenario_names
from retrim.runkit.provenance import section_key
from retrim.runkit.run import PARTS

from ..datt.training import DATT_STEPS, RIVALS, check_period, check_steps
from .further_figures import figures_table

LEVELS = {"none": "no disturbance", "small": "small, 0.5 m/s² per axis", "large": "large, 2 m/s² per axis"}
"""The paper's disturbances and their labels."""
PaperRows = Mapping[str, tuple[str, str, str]]
"""The paper's errors at the three levels [m], by method."""
METHODS = ("base", "base-i", "base-do", "geometric", "geometric-i", "indi", "mppi", "l1-mpc", "full", "lora")
"""Methods of the paper's tables, except for those that need minutes of training."""


def of_policies(methods: Sequence[str]) -> tuple[str, ...]:
    """Return the methods that fly a policy trained with the table's preset."""
    others = {*BASELINES, *RIVALS}
    return tuple(method for method in methods if method not in others and find_method(method).on_board is None)


@dataclass(frozen=True)
class Levels:
    """One section in the paper's layout: a row per method, and a column per disturbance level."""

    title: str
    preset: Preset
    scenario: Scenario
    """Scenario for the flights; each level replaces its disturbance."""
    stem: str
    """File name of the picture."""
    methods: Sequence[str] = ("base", "full", "lora")
    paper: PaperRows = field(default_factory=dict)
    levels: Mapping[str, str] = field(default_factory=lambda: LEVELS)
    """Disturbances and their labels."""
    drawn_methods: Sequence[str] = ("base", "full")
    """Methods in the picture, which shows the last level."""

    @property
    def scenarios(self) -> list[Scenario]:
        """Scenario for each level."""
        return [replace(self.scenario, disturbance=level) for level in self.levels]


def fly_levels(
    document: Document,
    sections: Sequence[Levels],
    *,
    starts: int,
    seconds: float | None,
    datt_steps: int = DATT_STEPS,
) -> None:
    """Train, fly and lay out every section; write the document after each section and after an interruption.

    Args:
        document: Receives the sections; its seeds are the training seeds.
        sections: Sections of the table; each preset is trained once.
        starts: Flights per disturbance, method and seed.
        seconds: Length of a flight [s]; by default that of the task.
        datt_steps: Number of training steps for DATT, if it is among the methods.

    Raises:
        ConfigError: A name does not exist, or two settings are incompatible; raised before any training.
    """
    run, reporter, studies = document.run, document.reporter, dict[tuple[str, bool], Study]()
    check_steps(datt_steps)
    sections = [section for section in sections if section.methods]
    for section in sections:
        if any(method in RIVALS for method in section.methods):
            check_period(section.preset)
        own = [method for method in section.methods if method not in RIVALS] or ["base"]
        refuse_misfits(section.preset, section.scenarios, methods=own, starts=starts, seconds=seconds)
    for section in sections:
        key = section_key(
            preset=dump(section.preset), scenarios=[repr(each) for each in section.scenarios], title=section.title,
            methods=list(section.methods), seeds=list(document.seeds), starts=starts, seconds=seconds,
            datt_steps=datt_steps if "datt" in section.methods else 0, files=_files_behind(section),
        )  # fmt: skip
        stored_section = run.store(reporter).get_or_make(
            f"{PARTS}/{key}",
            partial(_fly_section, section, studies, document, starts=starts, seconds=seconds, datt_steps=datt_steps),
            section_codec(run.folder),
            on_reuse=partial(run.reuse, section.title, reporter),
            on_store=partial(clear_flights, run),
        )
        if stored_section is not None:
            document.add(*stored_section)
            document.add(figures_table(stored_section[1], section.title, section.levels))
        if run.interrupted:
            break
    document.write()


def _files_behind(section: Levels) -> dict[str, str]:
    """Return digests of the files on which the section depends, except for retrim and the preset itself."""
    names = list[str | None](section.methods)
    for each in section.scenarios:
        names += scenario_names(each)
    return file_digests(*names, *preset_names(section.preset))


def _fly_section(
    section: Levels,
    studies: dict[tuple[str, bool], Study],
    document: Document,
    *,
    starts: int,
    seconds: float | None,
    datt_steps: int,
) -> tuple[TableSection, Rows] | None:
    """Return the section and its rows of results; None if no flight finished. ``studies`` receives a new study."""
    run, reporter = document.run, document.reporter
    trains = bool(of_policies(section.methods))
    key = dump(section.preset), trains
    if key not in studies and trains:
        studies[key] = train_all(section.preset, document.seeds, run, reporter)
    elif key not in studies:  # no method flies a policy, so only the seeds of the study matter
        untrained_policy = Setup.from_preset(section.preset).new_policy(random.key(0))
        studies[key] = Study(section.preset, dict.fromkeys(document.seeds, untrained_policy), ())
    study = studies[key]
    methods, title = section.methods, section.title
    own = [method for method in methods if method not in RIVALS]
    all_flights = []
    if own:
        all_flights = fly_all(
            study, section.scenarios, run, reporter, methods=own, starts=starts, seconds=seconds
        ).flights
    for rival in (method for method in methods if method in RIVALS):
        nets = RIVALS[rival](study.preset, tuple(study.policies), run, reporter, steps=datt_steps)
        policy_study = Study(study.preset, nets, ())
        all_flights += fly_all(
            policy_study, section.scenarios, run, reporter, methods=[rival], starts=starts, seconds=seconds
        ).flights
    if not all_flights:
        return None
    place = {scenario: i for i, scenario in enumerate(section.scenarios)}
    all_flights.sort(key=lambda flight: (place[flight.spec.scenario], methods.index(flight.spec.method)))
    result = [{**row, "preset": study.preset.name, "section": title} for row in rows(all_flights)]
    kinds = [event.kind for flight in all_flights for event in flight.events]
    crashes = sum(flight.log.terminated for flight in all_flights)
    about = (
        f"{study.about()} The gate admitted {kinds.count('policy')} policies and refused {kinds.count('rejected')}. "
        f"{crashes} of {len(all_flights)} flights crashed."
    )
    setup = Setup.from_preset(study.preset, section.scenario.reference)
    first = [
        f for f in all_flights if f.spec.seed == all_flights[0].spec.seed and f.spec.method in section.drawn_methods
    ]
    picture_paths = picture(first, setup, section.scenarios[-1], run.folder, stem=section.stem)
    table = level_table(result, methods, section.paper, title, section.levels)
    return replace(table, about=about, picture=picture_paths[0] if picture_paths else None), result


def level_table(
    rows: Sequence[dict[str, Any]],
    methods: Sequence[str],
    paper: PaperRows,
    title: str,
    levels: Mapping[str, str] = LEVELS,
) -> TableSection:
    """Return results in the paper's layout: methods down, disturbances across, the paper's figures in brackets."""
    by = {(row["method"], row["disturbance"]): row for row in rows}
    cells = list[tuple[str, ...]]()
    for method in methods:
        ours = [by.get((method, level)) for level in levels]
        theirs = [f" ({figure})" for figure in paper[method]] if method in paper else [""] * len(levels)
        figures = ("-" if row is None else cell(row) + they for row, they in zip(ours, theirs, strict=True))
        cells.append((find_method(method).label, *figures))
        if any(row is not None and "cross_track_m" in row for row in ours):
            cells.append(("... in step; cross-track", *map(_in_step, ours)))
    absent = [method for method in paper if method not in methods]
    cells += [(f"{find_method(m).label}, the paper's", *(f"({figure})" for figure in paper[m])) for m in absent]
    return TableSection(("error [m]", *levels.values()), tuple(cells), title)


def _in_step(row: dict[str, Any] | None) -> str:
    """Return the error after the best constant time shift, and the distance to the reference's nearest point [m]."""
    if row is None or row.get("unshifted_m") is None or "cross_track_m" not in row:
        return "-"
    return f"{metres(row['unshifted_m'])}; {metres(row['cross_track_m'])}"
