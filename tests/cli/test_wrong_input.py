"""Wrong input: one clear line, exit code 1 or 2, no traceback; no training, no flight, and no new folder."""

import os
import stat

import jax
import pytest

from commands import retrim
from helpers import tiny_preset
from retrim import Setup, changed, load, save_delta, save_learner_state, save_policy

pytestmark = pytest.mark.usefixtures("as_a_user")

BIG = "12345678901234567890"
FILES = {
    "nested.toml": "a = " + "[" * 100_000 + "]" * 100_000,
    "unknown.toml": "[adapt]\nnum_update = 3\n",
    "table.toml": "adapt = 3\n",
    "history.toml": "command_history = 3\n",
    "trained.toml": "[pretrain]\nhorizon = 3\n",
    "latin.toml": "name = 'caf\xe9'\n",
    "strange.toml": "mass = 1.2\nwheels = 3\n",
    "no_lift.toml": (
        "mass = 1.0\ninertia = [0.005, 0.005, 0.009]\narm = [0.1, 0.1]\nthrust_max = 5.0\nrates_max = [8.0, 8.0, 4.0]\n"
        "motor_tau = 0.04\n"
    ),
    "broken.csv": "t,x,y,z\n0,0,0,one\n",
    "key.toml": "plantz = ['bem']\n",
    "scenario.toml": "plants = ['rotorpy']\nsensors = ['mocap']\n",
    "preset.toml": "presets = ['hover/quick']\n",
    "length.toml": "seconds = nan\n",
    "seeds.toml": "seeds = [0, -1]\n",
    "twice.toml": "seeds = [2, 2]\n",
    "follows.toml": "references = ['circle']\n",
    "size.toml": "disturbances = ['wind=abc']\n",
    "method.toml": "presets = ['vision/ideal']\nmethods = ['base-do']\n",
    "ranks.toml": "methods = ['base', 'lora']\n[overlay.pretrain]\nhidden_sizes = [64]\n",
    "overlay.toml": "[overlay]\nnonsense = 1\n",
    "notes.safetensors": "no policy",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory, as_a_user):
    """Return a user's folder with valid and invalid files of every kind; its policies are untrained."""
    here = tmp_path_factory.mktemp("user")
    for name, text in FILES.items():
        (here / name).write_bytes(text.encode("latin-1"))
    circle = {"reference": "circle"}
    for name, preset in (("p", tiny_preset()), ("t", changed(load("track/preview"), track=circle))):
        setup = Setup.from_preset(preset)
        policy = setup.new_policy(jax.random.key(0))
        save_policy(here / name / "policy.safetensors", policy, preset)
        if name == "p":
            save_learner_state(
                here / "learner_state.safetensors", setup.learner.init(policy, jax.random.key(1)), preset
            )
            other = setup.new_policy(jax.random.key(2))
            save_delta(here / "delta.safetensors", setup.low_rank(other, jax.random.key(3)))
    whole = (here / "p" / "policy.safetensors").read_bytes()
    (here / "cut.safetensors").write_bytes(whole[:-100])
    (here / "flipped.safetensors").write_bytes(whole[:-50] + bytes([whole[-50] ^ 1]) + whole[-49:])
    (here / "file").write_text("no folder")
    (here / "closed").mkdir()
    (here / "closed").chmod(stat.S_IRUSR | stat.S_IXUSR)
    yield here
    (here / "closed").chmod(stat.S_IRWXU)


def tree(folder):
    return sorted(path for path in folder.rglob("*") if "__pycache__" not in path.parts)


FLY = ("fly", "--policy", "p")
WRONG = [
    # numbers
    ((*FLY, "--seconds", "nan"), "flights of nan s: must be 1 s to 36000 s long"),
    ((*FLY, "--seconds", "inf"), "flights of inf s: must be"),
    ((*FLY, "--seconds", "0"), "flights of 0 s: must be"),
    ((*FLY, "--seconds", "-1"), "flights of -1 s: must be"),
    ((*FLY, "--seed", BIG), f"seed {BIG}: must be 0 to 4294967295"),
    ((*FLY, "--seed", "-1"), "seed -1: must be"),
    ((*FLY, "--starts", "0"), "0 starts: must be 1 to 100000"),
    ((*FLY, "--starts", BIG), f"{BIG} starts: must be"),
    ((*FLY, "--thrust-error", "2"), "thrust error 2.0 must be between -0.5 and 1"),
    ((*FLY, "--thrust-error", "nan"), "thrust error nan must be"),
    (("pretrain", "hover", "--seed", BIG), f"seed {BIG}: must be"),
    (("pretrain", "hover", "--updates", "0"), "pretrain.num_updates: Input should be greater than or equal to 1"),
    (("pretrain", "hover", "--envs", BIG), "pretrain.num_envs: Input should be less than or equal to"),
    (("demo", "--seed", "-1"), "seed -1: must be"),
    (("demo", "--seconds", "0"), "flights of 0 s: must be"),
    (("demo", "--starts", "0"), "0 starts: must be"),
    (("reproduce", "hover", "--seeds", "-1"), "seed -1: must be"),
    (("reproduce", "hover", "--seeds", "3", "3"), "seeds 3, 3: at least one is needed, and each only once"),
    (("reproduce", "vision", "--starts", "0"), "0 starts: must be"),
    (("reproduce", "track", "--seconds", "nan"), "flights of nan s: must be"),
    (("reproduce", "plants", "--seconds", "0"), "flights of 0 s: must be"),
    (("reproduce", "reversing", "--seconds", "20"), "flights of 20 s: a push that reverses needs at least 30 s"),
    # names
    (("pretrain", "dance"), "no task 'dance'; there are hover, vision, track"),
    (("pretrain", "hover", "--preset", "nope"), "no preset 'nope'; there are hover/retrim"),
    (("pretrain", "track", "--preset", "hover/fast"), "preset 'hover/fast' is for hover, not for track"),
    (("pretrain", "hover", "--vehicle", "nope"), "no vehicle 'nope'; there are small, large, kingfisher"),
    (("pretrain", "hover", "--residual", "nope"), "no residual 'nope'; there are ensemble"),
    (("pretrain", "track", "--reference", "square"), "no reference 'square'; did you mean 'star'?"),
    (("pretrain", "hover", "--reference", "circle"), "--reference circle: a hover policy follows no reference"),
    ((*FLY, "--reference", "circle"), "--reference circle: a hover policy follows no reference"),
    (("fly", "--policy", "t", "--reference", "moon"), "no reference 'moon'"),
    ((*FLY, "--plant", "nope"), "no plant 'nope'; there are bem, simple, second-order, rotorpy, mujoco, crazyflow"),
    ((*FLY, "--vehicle", "nope"), "no vehicle 'nope'"),
    ((*FLY, "--sensors", "nope"), "no sensor 'nope'; there are ideal, mocap, onboard, rough"),
    ((*FLY, "--disturbance", "huge"), "no disturbance 'huge'; there are none, small, large"),
    ((*FLY, "--disturbance", "wind=abc"), "disturbance 'wind=abc': 'abc' is not a number"),
    ((*FLY, "--disturbance", "wind=1e9"), "disturbance 'wind=1e9': a size of 1e+09 m/s must be between 0 and 20"),
    ((*FLY, "--disturbance", "large=3"), "disturbance 'large=3': this level is fixed"),
    ((*FLY, "--adapt", "maybe"), "no method 'maybe'; there are base"),
    ((*FLY, "--residual", "os:nope"), "residual 'os:nope' cannot be imported"),
    ((*FLY, "--residual", "json:dumps"), "not JSON serializable"),
    ((*FLY, "--plant", "rotorpy", "--vehicle", "large"), "plant 'rotorpy' flies its own vehicle, hummingbird"),
    ((*FLY, "--plant", "rotorpy", "--sensors", "mocap"), "sensors 'mocap' need bem, simple or second-order"),
    (("demo", "--plant", "nope"), "no plant 'nope'"),
    (("demo", "--preset", "track/preview"), "preset 'track/preview' is for track, not for hover"),
    (("bench", "--works", "nap"), "no work nap; there are pretrain-retrim"),
    (("reproduce", "hover", "--presets", "vision/ideal"), "preset 'vision/ideal' is for vision, not for hover"),
    (("reproduce", "hover", "--sensors", "nope"), "no sensor 'nope'"),
    (("reproduce", "track", "--plant", "nope"), "no plant 'nope'"),
    (("reproduce", "tuning", "--seconds", "3"), "--seconds 3 must be at least 4: the first 3 do not count"),
    (("reproduce", "tuning", "--candidates", "-5"), "--candidates -5 must be between 0 and 10000"),
    (("reproduce", "tuning", "--methods", "base"), "base: no baseline with settings"),
    (("reproduce", "hover", "--datt-steps", "0"), "--datt-steps 0 must be between 1 and"),
    (("reproduce", "design", "--epochs", "15"), "--epochs 15 must be a positive multiple of 10"),
    (("reproduce", "vision", "--presets", "slow"), "no preset 'slow'"),
    (("reproduce", "vision", "--methods", "indy"), "no method 'indy'; did you mean 'indi'?"),
    (("reproduce", "plants", "--plant", "nope"), "no plant 'nope'"),
    (("reproduce", "reversing", "--preset", "track/paper"), "preset 'track/paper' is for track, not for hover"),
    (("gauntlet", "--only", "storm"), "no condition 'storm'; there are "),
    (("gauntlet", "--only", "none", "--methods", "best"), "no method 'best'"),
    (("reproduce", "transfer", "--presets", "hover/retrim", "hover/fast"), "'hover/fast' is for hover, not for track"),
    (("reproduce", "scaling", "--flights", "6"), "--flights 6 must be a positive multiple of 4"),
    # files
    (("pretrain", "hover", "--config", "missing.toml"), "missing.toml: no such file"),
    (("pretrain", "hover", "--config", "/dev/zero"), "/dev/zero: not a regular file"),
    (("pretrain", "hover", "--config", "nested.toml"), "nested.toml: not TOML"),
    (("pretrain", "hover", "--config", "latin.toml"), "latin.toml: not TOML"),
    (("pretrain", "hover", "--config", "unknown.toml"), "adapt.num_update: unknown key; did you mean 'num_updates'?"),
    (("pretrain", "hover", "--config", "table.toml"), "table.toml: adapt: "),
    (("pretrain", "hover", "--vehicle", "strange.toml"), "wheels: unknown key; there are name, mass"),
    (("pretrain", "hover", "--vehicle", "no_lift.toml"), "thrust_max = 5.0 N must exceed 1.2 times the weight"),
    (("pretrain", "track", "--reference", "missing.csv"), "missing.csv: No such file"),
    (("pretrain", "track", "--reference", "broken.csv"), "broken.csv, line 2"),
    ((*FLY, "--vehicle", "missing.toml"), "missing.toml: no such file"),
    ((*FLY, "--config", "history.toml"), "command_history = 3, but the policy was trained with 2"),
    ((*FLY, "--config", "trained.toml"), "[pretrain] cannot change for a policy that is trained"),
    (("fly",), "give either --policy FILE or --resume FILE"),
    ((*FLY, "--resume", "learner_state.safetensors"), "give either --policy FILE or --resume FILE"),
    (("fly", "--policy", "missing"), "missing: no such file; `retrim pretrain hover --out DIR` makes one"),
    (("fly", "--policy", "cut.safetensors"), "cut.safetensors: not a whole safetensors file"),
    (("fly", "--policy", "flipped.safetensors"), "flipped.safetensors: the checksum does not match"),
    (("fly", "--policy", "notes.safetensors"), "notes.safetensors: not a whole safetensors file"),
    (
        ("fly", "--policy", "learner_state.safetensors"),
        "learner_state.safetensors: holds a learner state; continue from it",
    ),
    (("fly", "--resume", "p/policy.safetensors"), "holds a 'policy', expected a 'learnt'"),
    (("fly", "--resume", "missing"), "missing: no such file; `retrim fly --out DIR` makes a learner_state.safetensors"),
    (("fly", "--resume", "learner_state.safetensors", "--delta", "delta.safetensors"), "--delta needs --policy"),
    (("fly", "--resume", "learner_state.safetensors", "--residual", "ensemble"), "keeps its own residual"),
    ((*FLY, "--delta", "delta.safetensors"), "made for a different base policy"),
    ((*FLY, "--delta", "p/policy.safetensors"), "holds a 'policy', expected a 'delta'"),
    # sweeps
    (("sweep", "missing.toml"), "missing.toml: no such file"),
    (("sweep", "key.toml"), "key.toml: plantz: unknown key; did you mean 'plants'?"),
    (("sweep", "scenario.toml"), "sensors 'mocap' need bem, simple or second-order"),
    (("sweep", "preset.toml"), "no preset 'hover/quick'"),
    (("sweep", "length.toml"), "length.toml: seconds: "),
    (("sweep", "seeds.toml"), "seed -1: must be"),
    (("sweep", "twice.toml"), "seeds 2, 2: at least one is needed, and each only once"),
    (("sweep", "follows.toml"), "reference 'circle': a hover policy follows no reference"),
    (("sweep", "size.toml"), "'abc' is not a number"),
    (
        ("sweep", "method.toml"),
        "preset 'vision/ideal': the frame of effective gravity needs a measured state or a pose filter",
    ),
    (("sweep", "ranks.toml"), "LoRA: 3 ranks (4, 10, 1) for 2 layers"),
    (("sweep", "overlay.toml"), "nonsense: unknown key"),
]


@pytest.mark.parametrize(("words", "message"), WRONG, ids=lambda value: " ".join(value) if type(value) is tuple else "")
def test_wrong_input_prints_one_line_and_writes_nothing(folder, words, message):
    before = tree(folder)
    out = retrim(*words, "--out", "new/folder", cwd=folder, code=1)
    assert message in out
    assert out.startswith("retrim: ")
    assert out.count("\n") == 1
    assert tree(folder) == before


def test_refused_flight_prints_no_other_remark(folder, monkeypatch):
    monkeypatch.setattr("retrim.live.operator.page.find_spec", lambda name: None)
    out = retrim("live", "--plant", "mavlink:udp:nowhere", cwd=folder, code=1)
    assert out.startswith("retrim: address 'udp:nowhere': expected udp:HOST:PORT")
    assert out.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "usage: retrim COMMAND"),
        (("fyl",), "no command 'fyl'; did you mean 'fly'?"),
        (("fly", "--latency", "maybe"), "invalid choice 'maybe'"),
        (("fly", "--bogus", "3"), "--bogus"),
        (("fly", "--seconds", "soon"), "retrim: --seconds: could not convert string to float: 'soon'; `retrim"),
        (("fly", "--policy"), "Missing value for argument '--policy'"),
        (("replay", "log.csv", "--adapt", "full"), "retrim: --adapt full needs --policy; `retrim pretrain hover"),
        (("pretrain",), "required"),
        (("reproduce", "nope"), "nope"),
    ],
)
def test_wrong_usage_explains_usage(folder, words, message):
    before = tree(folder)
    out = retrim(*words, cwd=folder, code=2)
    assert message in out
    assert "Traceback" not in out
    assert out.count("\n") == 1 or not words
    assert tree(folder) == before


COMMANDS = [
    ("pretrain", "hover"),
    FLY,
    ("demo",),
    ("sweep", "sizes.toml"),
    ("reproduce", "hover"),
    ("reproduce", "model"),
    ("bench",),
]


@pytest.mark.parametrize("out", ["file", "file/in/it", "/proc/nowhere", "closed/new"])
@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_unwritable_output_is_refused_first(folder, words, out, monkeypatch):
    if out.startswith("closed") and os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    (folder / "sizes.toml").write_text("seeds = [0, 1]\n")
    before = tree(folder)
    result = retrim(*words, "--out", out, cwd=folder, code=1)
    assert f"retrim: {out}: results cannot be written there" in result
    assert result.count("\n") == 1
    assert tree(folder) == before


def test_unsupported_disturbance_is_refused(folder):
    pytest.importorskip("rotorpy")
    before = tree(folder)
    words = "--plant", "rotorpy", "--disturbance", "payload", "--adapt", "none", "--out", "new"
    out = retrim(*FLY, *words, cwd=folder, code=1)
    assert "retrim: RotorpyPlant: cannot carry a load or weaken rotors" in out
    assert tree(folder) == before
