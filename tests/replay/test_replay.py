"""Replay of a log: prediction errors of the models, and adaptation of a policy to the log."""

import dataclasses
import importlib
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fake_log import MAP, columns, fly_once, write_csv, write_map
from helpers import tiny_preset
from retrim.config.loading import load
from retrim.config.setup import Setup
from retrim.config.vehicle_file import read_vehicle
from retrim.config.vehicles import make_vehicle
from retrim.errors import ConfigError, LogError
from retrim.io.logs import read_flight_log, read_map
from retrim.io.policies import save_policy
from retrim.replay import identification
from retrim.replay.adaptation import AdaptationResult, adapt_to
from retrim.replay.identification import Estimate, IdentifiedVehicle
from retrim.replay.prediction import Protocol, predict_log
from retrim.replay.predictors import mean_of, model_factory, ridge, yardsticks
from retrim.replay.replay import Replay, replay
from retrim.replay.rows import rows_of
from retrim.runkit.reporter import Silent
from retrim.runkit.run import Run

pytestmark = pytest.mark.usefixtures("optax_promotion")

PUSH = (1.0, -0.5, 0.3)
replays = importlib.import_module("retrim.replay.replay")  # the module, not the function of the same name
SHORT = Protocol(buffer=2.0, horizon=1.0, every=1.0)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("log")
    return write_csv(folder / "log.csv", columns(fly_once(14.0, wind=PUSH))), write_map(folder / "map.toml", MAP)


@pytest.fixture(scope="module")
def brief(tmp_path_factory):
    """Return a log that suffices for prediction, and not for identification."""
    return write_csv(tmp_path_factory.mktemp("brief") / "log.csv", columns(fly_once(7.0, wind=PUSH)))


@pytest.fixture(scope="module")
def log(files, brief):
    return read_flight_log(brief, read_map(files[1]))


def test_residual_of_push_is_push(log):
    rows = rows_of(log)
    assert rows.a_res[np.asarray(rows.valid)] == pytest.approx(
        np.broadcast_to(PUSH, (int(rows.valid.sum()), 3)), abs=2e-3
    )


def test_push_is_predicted_and_zero_prediction_misses_it(log):
    result = {each.name: each for each in predict_log(rows_of(log), log.dt, yardsticks(log.dt), SHORT)}
    assert result["zero"].rmse == pytest.approx(np.linalg.norm(PUSH), rel=1e-2)
    for name in ("last second", "mean of the buffer", "ridge"):
        assert result[name].rmse < 0.02
    assert result["zero"].per_axis == pytest.approx(np.abs(PUSH), abs=0.01)
    assert result["zero"].times == tuple(np.arange(2.0, 6.5, 1.0)[: len(result["zero"].times)])


@pytest.mark.parametrize("name", ["regression", "linear", "ensemble"])
def test_residual_models_predict_push(log, name):
    preset = load("hover/retrim")
    begin = model_factory(name, preset, make_vehicle("small"), 0, window=100, fit_every=1.0, fit_steps=100)
    (result,) = predict_log(rows_of(log), log.dt, {name: begin}, SHORT)
    assert result.rmse < 0.35


def test_only_valid_rows_count(log):
    rows = rows_of(log)
    spoilt = jnp.arange(rows.valid.shape[0]) % 7 == 0
    bad_file = type(rows)(
        rows.x, rows.u, jnp.where(spoilt[:, None], 99.0, rows.a_res), rows.omega, rows.valid & ~spoilt
    )
    for name, begin in (("mean", lambda: mean_of), ("ridge", lambda: ridge)):
        (a,) = predict_log(bad_file, log.dt, {name: begin}, SHORT)
        assert a.rmse < 0.02


def test_too_short_log_is_refused_with_remedy(log):
    with pytest.raises(LogError, match="choose a shorter --buffer or --horizon"):
        list(predict_log(rows_of(log), log.dt, yardsticks(log.dt), Protocol(10.0, 10.0)))


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"buffer": 0.0}, "--buffer 0"),
        ({"delay": 2.0}, "--delay 2"),
        ({"adapt": "full"}, "--adapt full needs --policy"),
        ({"policy": Path("h")}, "--policy needs --adapt METHOD, or --identify"),
        ({"adapt": "base"}, "must be full, lora or none"),
        ({"updates": 0}, "--updates 0"),
        ({"seed": -1}, "seed -1: must be 0 to 4294967295"),
        ({"seed": 10**20}, "seed 1000*: must be 0 to 4294967295"),
    ],
)
def test_invalid_options_are_refused(wrong, text):
    with pytest.raises(ConfigError, match=text):
        Replay(**wrong)


def test_report_is_table_plot_and_json(files, tmp_path, monkeypatch):
    """The log has no commanded rates, whose identification has its own tests and a large program."""
    monkeypatch.setattr(identification, "DRAWS", 20)
    path, choice = files[0], write_map(tmp_path / "map.toml", MAP.partition("[rates]")[0])
    run = Run("replay", tmp_path)
    replay(path, Replay(map=str(choice), buffer=2.0, horizon=1.0, identify=True), run, Silent())
    text = (tmp_path / "replay.md").read_text()
    assert "Residual of the point mass" in text
    assert "| linear |" in text
    assert (tmp_path / "replay.png").stat().st_size > 10_000
    result = json.loads((tmp_path / "replay.json").read_text())
    assert {row["name"] for row in result["rows"]} >= {"zero", "ridge", "regression", "ensemble", "linear"}
    assert result["identified"]["thrust_gain"][0] == pytest.approx(1.0, abs=0.02)
    assert "# Identified from log.csv" in (tmp_path / "vehicle.toml").read_text()


def test_slow_log_keeps_its_tick_and_refuses_adaptation(tmp_path):
    path = write_csv(tmp_path / "log.csv", columns(fly_once(6.0, dt=1 / 30, wind=PUSH)))
    calls = Replay(map=str(write_map(tmp_path / "map.toml")), buffer=100 / 30, horizon=50 / 30)
    document = replay(path, calls, Run("replay", tmp_path), Silent())
    assert "a tick of 33.33 ms" in document.sections[1].about
    save_policy(
        tmp_path / "p.safetensors", Setup.from_preset(tiny_preset()).new_policy(jax.random.key(0)), tiny_preset()
    )
    calls = dataclasses.replace(calls, adapt="full", policy=tmp_path / "p.safetensors")
    with pytest.raises(LogError, match=r"a sample every 33.3 ms, but the policy's tick is 20 ms"):
        replay(path, calls, Run("replay", tmp_path), Silent())


def test_too_short_buffer_is_refused(files, tmp_path, monkeypatch):
    """0.2 s are ten samples at 50 Hz; the message states a sufficient length, which is accepted."""
    path, choice = files
    with pytest.raises(ConfigError, match=r"--buffer 0\.2: must be 0\.26 to .* every 20 ms") as error:
        replay(path, Replay(map=str(choice), buffer=0.2, horizon=1.0), Run("replay", tmp_path), Silent())
    assert "\n" not in str(error.value)
    setup = []
    monkeypatch.setattr(replays, "predict_log", lambda rows, dt, predictors, protocol: setup.extend(predictors) or ())
    replay(path, Replay(map=str(choice), buffer=0.26, horizon=1.0), Run("replay", tmp_path), Silent())
    assert "regression" in setup


HEAVY = """
mass = 1.2
inertia = [0.0075, 0.0075, 0.014]
arm = [0.115, 0.12]
thrust_max = 60.0
rates_max = [8.0, 7.0, 4.0]
motor_tau = 0.04
rate_lag = [0.05, 0.06, 0.2]
command_delay = 0.03
propeller = "5 inch"
propeller_diameter = 7.0
drag_area = [0.01, 0.02, 0.03]
"""


def test_missing_values_come_from_vehicle_file(files, tmp_path, monkeypatch):
    path, choice = files
    (tmp_path / "heavy.toml").write_text(HEAVY)
    drag = Estimate(0.3, 0.2, 0.4)  # in a comment of the file
    result = IdentifiedVehicle(*[None] * 9, (drag, None, None), 0.1)
    monkeypatch.setattr(replays, "identify", lambda log, seed: result)
    monkeypatch.setattr(replays, "_score_predictions", lambda *calls: [])
    vehicle = str(tmp_path / "heavy.toml")
    calls = Replay(map=str(choice), buffer=2.0, horizon=1.0, identify=True, vehicle=vehicle)
    replay(path, calls, Run("replay", tmp_path), Silent())
    assert "0.3 1/s" in (tmp_path / "vehicle.toml").read_text()
    identified_one, heavy = read_vehicle(tmp_path / "vehicle.toml"), read_vehicle(tmp_path / "heavy.toml")
    assert identified_one == dataclasses.replace(heavy, name="heavy-identified")


THRUST = Estimate(4.6 / 0.32, 14.0, 15.0)
"""Full thrust of 1.47 times the weight; a vehicle file needs 1.6 times."""


@pytest.mark.parametrize(("thrust", "is_flown"), [(THRUST, False), (Estimate(30.0, 29.0, 31.0), True)])
def test_vehicle_that_cannot_be_flown_is_written_and_reported(thrust, is_flown, files, tmp_path, monkeypatch):
    found = IdentifiedVehicle(*[None] * 9, (None, None, None), 0.1)
    monkeypatch.setattr(replays, "identify", lambda log, seed: dataclasses.replace(found, full_thrust=thrust))
    monkeypatch.setattr(replays, "_score_predictions", lambda *calls: [])
    calls = Replay(map=str(files[1]), buffer=2.0, horizon=1.0, identify=True)
    document = replay(files[0], calls, Run("replay", tmp_path), Silent())
    assert document.files == [tmp_path / "replay.md", tmp_path / "vehicle.toml"]
    text = (tmp_path / "replay.md").read_text()
    assert ("cannot fly, and `retrim pretrain` refuses it**: thrust_max = " in text) is not is_flown
    if is_flown:
        read_vehicle(tmp_path / "vehicle.toml")
    else:
        assert "1.47 times the weight" in text
        with pytest.raises(ConfigError, match=r"1\.47 times the weight"):
            read_vehicle(tmp_path / "vehicle.toml")


OTHERS = ("vehicle.toml", "replay.png", "replay.svg", "adapted.safetensors", "delta.safetensors",
          "learner_state.safetensors")  # fmt: skip


def test_results_of_earlier_replay_are_removed_by_name(files, tmp_path, monkeypatch):
    """A folder has the files of one log only; files that are read, and those of other commands, stay."""
    monkeypatch.setattr(replays, "_score_predictions", lambda *calls: [])
    calls = Replay(map=str(files[1]), buffer=2.0, horizon=1.0)
    for name in (*OTHERS, "policy.safetensors", "replay.csv"):
        (tmp_path / name).write_text(HEAVY)
    document = replay(files[0], calls, Run("replay", tmp_path), Silent())
    assert all((tmp_path / name).exists() for name in OTHERS)  # there was no report of a replay
    own = dataclasses.replace(calls, vehicle=str(tmp_path / "." / "vehicle.toml"))
    replay(files[0], own, Run("replay", tmp_path), Silent())
    left = {"replay.md", "replay.json", "policy.safetensors", "replay.csv"}
    assert {path.name for path in tmp_path.iterdir()} == left | {"vehicle.toml"}
    replay(files[0], calls, Run("replay", tmp_path), Silent())
    assert {path.name for path in tmp_path.iterdir()} == left
    assert document.files == [tmp_path / "replay.md"]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"buffer": 5.0, "horizon": 10.0}, "choose a shorter --buffer or --horizon"),
        ({"buffer": 0.2}, "--buffer 0.2: must be"),
        ({"identify": True}, "identification needs 8 s at least"),
        ({"adapt": "full", "dt": 0.01}, "a sample every 20 ms, but the policy's tick is 10 ms"),
        ({"adapt": "full", "window": 2000}, "no 40 s of flight in one piece, which the learner's window needs"),
    ],
)
def test_log_that_does_not_fit_is_refused_before_work(change, text, files, brief, tmp_path, monkeypatch):
    """No prediction is made, and no file is written or removed."""
    monkeypatch.setattr(replays, "_score_predictions", lambda *calls: pytest.fail("it was refused after the work"))
    for name in ("replay.json", "replay.md", *OTHERS):
        (tmp_path / name).write_text("of an earlier replay")
    if "adapt" in change:
        preset = tiny_preset(adapt={"window": change.pop("window", 50)}, dt=change.pop("dt", 0.02))
        policy = Setup.from_preset(preset).new_policy(jax.random.key(0))
        save_policy(tmp_path / "p.safetensors", policy, preset)
        change["policy"] = tmp_path / "p.safetensors"
    calls = Replay(**{"map": str(files[1]), "buffer": 2.0, "horizon": 1.0} | change)
    with pytest.raises((LogError, ConfigError), match=text):
        replay(brief, calls, Run("replay", tmp_path), Silent())
    assert {(tmp_path / name).read_text() for name in ("replay.json", "replay.md", *OTHERS)} == {"of an earlier replay"}


def test_uninformative_log_writes_no_vehicle_file(files, tmp_path, monkeypatch):
    monkeypatch.setattr(replays, "identify", lambda log, seed: IdentifiedVehicle(*[None] * 9, (None, None, None), 0.1))
    monkeypatch.setattr(replays, "_score_predictions", lambda *calls: [])
    calls = Replay(map=str(files[1]), buffer=2.0, horizon=1.0, identify=True)
    document = replay(files[0], calls, Run("replay", tmp_path), Silent())
    assert "no vehicle file is written" in document.sections[-1].about
    assert not (tmp_path / "vehicle.toml").exists()


def test_report_begins_with_warnings_and_shows_every_value(tmp_path, monkeypatch):
    """One column is not the thrust, for example a battery voltage; then the column is the thrust."""
    monkeypatch.setattr(replays, "_score_predictions", lambda *calls: [])
    flight = fly_once(7.0, size=3.0)
    choice = write_map(tmp_path / "map.toml", thrust__unit='"share"')
    text = []
    for name, column in (("voltage", 4.1 - 0.01 * flight.t), ("thrust", 0.05 * flight.c)):
        path = write_csv(tmp_path / f"{name}.csv", columns(flight) | {"c": column})
        run = Run("replay", tmp_path / name)
        document = replay(path, Replay(map=str(choice), buffer=2.0, horizon=1.0), run, Silent())
        text.append((tmp_path / name / "replay.md").read_text())
        figures = {row[0]: row[1] for row in document.sections[0].rows}
        assert figures["motion of the position, by the velocity"] == "100 %"
        store = json.loads((tmp_path / name / "replay.json").read_text())["agreement"]
        assert set(store) == {"motion", "lift", "climb", "turning"}
    warning = "**Warning: this log agrees badly with itself, and no figure below can be relied on: thrust explains "
    assert text[0].index(warning) < text[0].index("## ")
    assert "Warning" not in text[1]


def test_policy_adapts_to_push_of_log(files, tmp_path):
    """The gate admits policies that are better in the model corrected by the log."""
    preset = tiny_preset(adapt={"residual": "linear", "window": 100, "fit_every": 1.0, "learning_rate": 1e-3})
    setup = Setup.from_preset(preset)
    policy = setup.new_policy(jax.random.key(0))
    log = read_flight_log(files[0], read_map(files[1]), dt=preset.dt)
    result = adapt_to(rows_of(log), setup, policy, method="full", updates=4, seed=0, reporter=Silent())
    assert 0 <= result.admissions <= result.attempts == 4
    model = setup.learner.residual_model
    x, u = jax.tree.map(lambda leaf: leaf[100], (rows_of(log).x, rows_of(log).u))
    np.testing.assert_allclose(model.predict(result.state.residual, x, u), PUSH, atol=0.1)


def test_policy_is_adapted_with_its_residual_and_unsuitable_model_is_refused(files, brief, tmp_path, monkeypatch):
    preset = tiny_preset(adapt={"residual": "regression", "window": 100, "fit_every": 1.0, "fit_steps": 100})
    policy = Setup.from_preset(preset).new_policy(jax.random.key(0))
    save_policy(tmp_path / "p.safetensors", policy, preset)
    monkeypatch.setattr(replays, "_score_predictions", lambda *calls: [])
    used = []

    def adapt(rows, setup, policy, **calls):
        used.append(setup.preset.adapt.residual)
        return AdaptationResult(
            setup.learner.init(policy, jax.random.key(0)), 0, 5, 3.0, 3.0 if len(used) == 1 else 0.1
        )

    monkeypatch.setattr(replays, "adapt_to", adapt)
    text = []
    for residual in (None, "linear"):
        calls = Replay(
            map=str(files[1]),
            buffer=2.0,
            horizon=1.0,
            adapt="full",
            policy=tmp_path / "p.safetensors",
            residual=residual,
        )
        text.append(replay(brief, calls, Run("replay", tmp_path), Silent()).sections[-1].about)
    assert used == ["regression", "linear"]
    assert ["the policy does not hold" in each for each in text] == [True, False]
