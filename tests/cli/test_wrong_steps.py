"""Wrong input at the steps of docs/how-to/from-the-box.md: one clear line, exit code 1 or 2, and no traceback."""

import re
from pathlib import Path

import jax
import pytest

from commands import retrim
from helpers import tiny_preset
from retrim import Setup, save_policy
from retrim.live import link_check
from retrim.testing import betaflight_peer, crazyflie_peer, mavlink_peer, px4, ros2_peer

pytestmark = pytest.mark.usefixtures("as_a_user")
FIVE_INCH = Path(__file__).parents[2] / "examples/five_inch.toml"
MSP = "msp:serial:/dev/nowhere:115200,pose=/mocap/quad"
LIVE = ("live", "--policy", "h", "--adapt", "none", "--seconds", "20", "--plant")


@pytest.fixture(scope="module")
def folder(tmp_path_factory, as_a_user):
    """Return the folder of a user who follows the page."""
    here = tmp_path_factory.mktemp("box")
    text = FIVE_INCH.read_text()
    files = {
        "five_inch.toml": text,
        "light.toml": re.sub("(?m)^mass = .*", "mass = -0.7", text),
        "grams.toml": re.sub("(?m)^mass = .*", "mass = 720", text),
        "kilograms.toml": re.sub("(?m)^thrust_max = .*", "thrust_max = 3.2", text),
        "typo.toml": text.replace("motor_tau", "motor_tao"),
        "empty.bfl": "",
        "header.bfl": "H Product:Blackbox flight data recorder by Nicholas Sherlock\n",
        "text.bfl": "no log",
        "flight.doc": "no log",
        "title.csv": "t,x,y,z\n",
    }
    (here / "found").mkdir()
    files["found/vehicle.toml"] = text
    for name, content in files.items():
        (here / name).write_text(content)
    preset = tiny_preset()
    save_policy(here / "h/policy.safetensors", Setup.from_preset(preset).new_policy(jax.random.key(0)), preset)
    return here


COMMANDS = [
    (("pretrain", "hover", "--vehicle", "light.toml"), "light.toml: mass: Input should be greater than 0.005"),
    (("pretrain", "hover", "--vehicle", "grams.toml"), "mass"),
    (("pretrain", "hover", "--vehicle", "kilograms.toml"), "is it the thrust of one rotor? four have 12.8 N"),
    (("pretrain", "hover", "--vehicle", "typo.toml"), "motor_tao: unknown key; did you mean 'motor_tau'?"),
    (("pretrain", "hover", "--vehicle", "id/vehicle.toml"), "id/vehicle.toml: no such file"),
    (("pretrain", "hover", "--vehicle", "found"), "vehicle 'found' is a folder; state the file: found/vehicle.toml"),
    (("replay", "manual.bfl", "--identify"), "manual.bfl: no such file"),
    (("replay", "empty.bfl", "--identify"), "empty.bfl: it is empty"),
    (("replay", "header.bfl", "--identify"), "the header of the Blackbox log is incomplete"),
    (("replay", "text.bfl", "--identify"), "it is not a Blackbox log: no flight begins in it"),
    (("replay", "flight.doc", "--identify"), "unknown kind of log; there are .csv"),
    (("replay", "title.csv", "--identify"), "it has a header and no sample"),
    (("replay", "first/flight.csv", "--identify", "--policy", "h"), "first/flight.csv: no such file"),
    (("fly", "--policy", "h", "--plant", "second-order", "--vehicle", "id/vehicle.toml"), "no such file"),
    (("fly", "--policy", "five_inch.toml"), "`retrim pretrain hover --vehicle five_inch.toml` makes one"),
    (("fly", "--policy", "missing", "--disturbance", "large"), "missing: no such file"),
    ((*LIVE, "mavlnk:udp:0.0.0.0:14540"), "did you mean 'mavlink'?"),
    ((*LIVE, "mavlink:udp:0.0.0.0"), "expected udp:HOST:PORT, as udp:127.0.0.1:14540"),
    ((*LIVE, "mavlink:udp:0.0.0.0:99999"), "expected udp:HOST:PORT"),
    ((*LIVE, "mavlink:udp:0.0.0.0:14540", "--disturbance", "large"), "which cannot be disturbed by name"),
    ((*LIVE, "msp:serial:/dev/ttyAMA0:115200"), "expected msp:(serial:DEVICE:BAUD|tcp:HOST:PORT),(odometry|pose)="),
    ((*LIVE, "msp:serial:/dev/ttyAMA0:115200,pose=mocap/quad"), "as msp:serial:/dev/ttyAMA0:115200,pose=/mocap/quad"),
    ((*LIVE, "msp:serial:/dev/ttyAMA0:fast,pose=/mocap/quad"), "expected serial:DEVICE:BAUD"),
    (("live", "--policy", "h", "--plant", MSP, "--adapt", "base-id"), "is for one vehicle"),
]


@pytest.mark.parametrize(
    ("words", "message"), COMMANDS, ids=lambda value: " ".join(value) if type(value) is tuple else ""
)
def test_wrong_command_prints_one_line(folder, words, message):
    out = retrim(*words, "--out", "new", cwd=folder, code=1)
    assert message in out
    assert out.startswith("retrim: ")
    assert out.count("\n") == 1
    assert not (folder / "new").exists()


PROGRAMS = [
    (link_check, ("bem",), "plant 'bem' is simulated; a link to a vehicle is needed"),
    (link_check, (MSP,), "serial:/dev/nowhere:115200 cannot be opened"),
    (link_check, (MSP, "--seconds", "nan"), "--seconds must be 1 to 3600, got nan"),
    (link_check, (MSP, "--vehicle", "nope"), "no vehicle 'nope'"),
    (betaflight_peer, ("--vehicle", "missing.toml"), "missing.toml: no such file"),
    (betaflight_peer, ("--disturbance", "huge"), "no disturbance 'huge'"),
    (betaflight_peer, ("--backend", "dds"), "no back end 'dds' of ROS 2; there are rclpy, cyclonedds, zenoh"),
    (betaflight_peer, ("--log", "nowhere/manual.bfl"), "--log must be a file in a folder that exists"),
    (betaflight_peer, ("--log", "manual.bfl", "--seconds", "nan"), "--seconds must be 5 to 600, got nan"),
    (mavlink_peer, ("--plant", "nope"), "no plant 'nope'"),
    (px4, ("nowhere",), "nowhere: there is no bin/px4 there"),
]


@pytest.mark.parametrize(("program", "words", "message"), PROGRAMS)
def test_wrong_options_of_program_end_it_with_one_line(folder, program, words, message, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    with pytest.raises(SystemExit) as end:
        program.main(words)
    assert message in str(end.value.code)
    assert "\n" not in str(end.value.code)


@pytest.mark.parametrize(
    ("program", "words", "message"),
    [
        (px4, ("nowhere", "--set", "MC_ROLLRATE_K"), "must be NAME=NUMBER, got 'MC_ROLLRATE_K'"),
        (crazyflie_peer, ("--port", "99999"), "a port must be 1 to 65535, got 99999"),
        (ros2_peer, ("px4", "--release", "0.9"), "invalid choice: '0.9' (choose from"),
    ],
)
def test_wrong_usage_of_program_explains_usage(program, words, message, capsys):
    with pytest.raises(SystemExit) as end:
        program.main(words)
    assert end.value.code == 2
    assert message in capsys.readouterr().err
