"""Roles of a live flight: the required processes and their plans."""

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from live_helpers import hover_source, plan
from live_processes import DT, HOME, level
from retrim import Scenario
from retrim.live.operator.page import PagePlan
from retrim.live.roles import ROLES, RoleRequest
from retrim.live.spec import LiveSpec, PageSpec
from retrim.onboard.topics import VEHICLE
from retrim.transport.remote import Address

ALWAYS = ["control", "plant", "watchdog", "recorder"]
PAGE = PageSpec("localhost", 8080, "hover", np.zeros((1, 3)), (), 0.1, 0.7)


@pytest.fixture(scope="module")
def spec():
    controller, place = hover_source(), Path("place")
    return LiveSpec(
        controller, (), place / "start", None, Scenario(), "small", level(np.array([0.0, 0.0, 0.5])), HOME,
        plan(controller).limits, DT, 1, 150, 1.0, 0, place,
    )  # fmt: skip


def required_roles(spec):
    return [name for name, role in ROLES.items() if role.is_needed(spec)]


def test_flight_has_required_processes(spec):
    here = replace(spec, layers=("residual", "policy"))
    remote = replace(here, learners=Address.of("zenoh:127.0.0.1:7447", None))
    identifying = replace(spec, controller=replace(spec.controller, parameters={VEHICLE: {}}))
    assert required_roles(spec) == ALWAYS
    assert required_roles(here) == ["control", "plant", "residual", "policy", "watchdog", "recorder"]
    assert required_roles(remote) == ["control", "plant", "bridge", "watchdog", "recorder"]
    assert required_roles(identifying) == ["control", "plant", "identifier", "watchdog", "recorder"]
    assert required_roles(replace(spec, page=PAGE)) == [*ALWAYS, "page"]


@pytest.mark.parametrize("name", ROLES)
def test_main_function_of_role_exists(name):
    module, _, function = ROLES[name].main.partition(":")
    assert callable(getattr(importlib.import_module(module), function))


def test_plans_contain_flight_and_priority_of_role(spec):
    request = RoleRequest(spec, spec.start, Path("bus"), cores=frozenset({1}), control=7)
    plans = {name: ROLES[name].plan(request) for name in (*ALWAYS, "residual", "policy", "identifier")}
    assert {plan.folder for plan in plans.values()} == {Path("bus")}
    assert {plan.parent for plan in plans.values()} == {request.parent}
    assert plans["watchdog"].control == 7
    assert plans["watchdog"].priority > plans["control"].priority > plans["plant"].priority > 0
    assert (plans["residual"].layer, plans["policy"].layer) == ("residual", "policy")
    assert isinstance(ROLES["page"].plan(replace(request, spec=replace(spec, page=PAGE))), PagePlan)
