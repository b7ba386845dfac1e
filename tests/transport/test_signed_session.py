"""Two ends with a key accept each message of the other end once, and no messages of third parties."""

import os
import pickle
import secrets
import threading

import pytest

from retrim.errors import ConfigError
from retrim.transport import session as sessions
from retrim.transport.network import NetworkBus
from retrim.transport.remote import Address
from retrim.transport.session import FOREIGN_KEY, GREETINGS, HEAD, MISSING_KEY, UNSIGNED, Session
from retrim.transport.shared_key import SharedKey, read_key

KEY, OTHER = SharedKey(b"k" * 32), SharedKey(b"o" * 32)
TOPICS = {"out": 1000, "mission": 1000, "into": 1000} | dict.fromkeys(GREETINGS, 0)


class End(NetworkBus):
    """One end on a wire that a third party can read and write."""

    def __init__(self, wire, side, key=KEY, vehicle=""):
        super().__init__(TOPICS, None if key is None else Session(key, vehicle, GREETINGS[side]))
        self.wire = wire
        wire.ends.append(self)

    def _send(self, topic, frame):
        self.wire.frames.append((self, topic, frame))

    def close(self):
        self.wire.ends.remove(self)


class Wire:
    def __init__(self):
        self.ends, self.frames, self.record = [], [], []

    def settle(self):
        """Deliver all messages."""
        for _ in range(20):
            for end in self.ends:
                end._attend()
            count, self.frames = self.frames, []
            for sender, topic, frame in count:
                self.record.append((topic, frame))
                for end in self.ends:
                    if end is not sender:
                        end._receive(topic, frame)
            if not count:
                return
        raise AssertionError("they never stop to talk")


@pytest.fixture
def wire():
    return Wire()


def read_messages(end, topic):
    message = end.latest(topic)
    return None if message is None else message.data


def test_messages_arrive_in_both_directions_in_any_start_order(wire):
    flight = End(wire, 0)
    flight.publish("mission", b"before anybody is there")
    wire.settle()
    ground = End(wire, 1)
    wire.settle()
    assert read_messages(ground, "mission") == b"before anybody is there"
    for i in range(3):
        flight.publish("out", b"out %d" % i)
        ground.publish("into", b"into %d" % i)
        wire.settle()
        assert (read_messages(ground, "out"), read_messages(flight, "into")) == (b"out %d" % i, b"into %d" % i)
    assert flight.refusals == ground.refusals == 0
    assert flight.fault == ground.fault == ""


def test_repeated_message_does_not_overtake_newer_one(wire):
    """A network that keeps only the last message would lose the newer one."""
    flight, ground = End(wire, 0), End(wire, 1)
    flight.publish("out", b"first")
    newer = threading.Thread(target=flight.publish, args=("out", b"second"))
    record = flight._send

    def send_slowly(topic, frame):
        if topic == "out" and not newer.ident:
            newer.start()
            newer.join(0.2)
        record(topic, frame)

    flight._send = send_slowly
    wire.settle()
    newer.join(5.0)
    counts = [
        HEAD.unpack_from(frame)[3] for topic, frame in [*wire.record, *[f[1:] for f in wire.frames]] if topic == "out"
    ]
    assert newer.ident
    assert counts == sorted(counts)
    wire.settle()
    assert ground.latest("out").data == b"second"


@pytest.mark.parametrize("again", [0, 1])
def test_restarted_end_continues_and_previous_end_is_ignored(wire, again):
    ends = [End(wire, 0), End(wire, 1)]
    topics = "out", "into"
    for end, topic in zip(ends, topics, strict=True):
        end.publish(topic, b"first")
    wire.settle()
    version = ends[1 - again].latest(topics[again]).version
    old = ends[again]
    old.close()
    ends[again] = End(wire, again)
    wire.settle()
    assert read_messages(ends[again], topics[1 - again]) == b"first"
    ends[again].publish(topics[again], b"second")
    wire.settle()
    result = ends[1 - again].latest(topics[again])
    assert result.data == b"second"
    assert result.version > version
    old.publish(topics[again], b"of a process that hung")
    wire.settle()
    assert read_messages(ends[1 - again], topics[again]) == b"second"


def test_replayed_messages_are_refused_by_all_ends(wire):
    """The receivers refuse them, and so do new ends, alone or together."""
    flight, ground = End(wire, 0), End(wire, 1)
    flight.publish("out", b"old")
    ground.publish("into", b"old")
    wire.settle()
    flight.publish("out", b"new")
    ground.publish("into", b"new")
    wire.settle()
    record = list(wire.record)

    def replay(*ends):
        for topic, frame in record:
            for end in ends:
                end._receive(topic, frame)
        wire.settle()

    replay(flight, ground)
    assert (read_messages(ground, "out"), read_messages(flight, "into")) == (b"new", b"new")
    assert flight.refusals > 0
    assert ground.refusals > 0
    ground.close()
    later = End(wire, 1)
    replay(flight, later)
    assert read_messages(later, "out") == b"new"  # from the current flight
    later.publish("into", b"newer")
    wire.settle()
    replay(flight, later)
    assert read_messages(flight, "into") == b"newer"
    alone = End(Wire(), 1)
    for topic, frame in record:
        alone._receive(topic, frame)
    assert read_messages(alone, "out") is None
    assert read_messages(alone, "into") is None


def test_changed_message_is_refused(wire):
    flight, ground = End(wire, 0), End(wire, 1)
    wire.settle()
    flight.publish("out", b"payload")
    ((_, topic, frame),) = wire.frames
    assert topic == "out"
    wire.frames.clear()
    for i in range(len(frame)):
        for bit in (1, 128):
            ground._receive("out", frame[:i] + bytes([frame[i] ^ bit]) + frame[i + 1 :])
    for cut in (b"", frame[:-1], frame[: HEAD.size], frame[: HEAD.size - 1], frame + b"x", frame[1:]):
        ground._receive("out", cut)
    for other in ("mission", "into", GREETINGS[0]):  # with a different topic
        ground._receive(other, frame)
    flight._receive("out", frame)  # sent back
    ground._receive("out", bytes(2000))
    assert read_messages(ground, "out") is read_messages(ground, "mission") is read_messages(ground, "into") is None
    assert flight.latest("out").version == 1
    assert ground.refusals == 2 * len(frame) + 6 + 3 + 1
    ground._receive("out", frame)
    assert read_messages(ground, "out") == b"payload"


def test_vehicles_with_same_key_refuse_messages_for_other_vehicle(wire):
    flight, ground = End(wire, 0, vehicle="quad1"), End(wire, 1, vehicle="quad2")
    flight.publish("out", b"for quad1")
    wire.settle()
    assert read_messages(ground, "out") is None
    assert ground.refusals > 0


@pytest.mark.parametrize(
    ("here", "there", "fault"), [(KEY, OTHER, FOREIGN_KEY), (KEY, None, UNSIGNED), (None, KEY, MISSING_KEY)]
)
def test_different_or_missing_key_gives_one_line_at_both_ends(wire, here, there, fault):
    flight, ground = End(wire, 0, here), End(wire, 1, there)
    flight.publish("out", b"out")
    ground.publish("into", b"into")
    wire.settle()
    assert flight.fault == fault
    assert read_messages(flight, "into") is read_messages(ground, "out") is None
    assert flight.refusals > 0
    assert fault.isprintable()
    assert len(fault) < 120


def test_third_party_cannot_join_established_session(wire):
    flight, ground = End(wire, 0), End(wire, 1)
    flight.publish("mission", b"mine")
    wire.settle()
    for end in (flight, ground):
        for topic in TOPICS:
            end._receive(topic, b"noise")
            end._receive(topic, secrets.token_bytes(200)[: HEAD.size])
    assert flight.fault == ground.fault == ""
    assert read_messages(ground, "mission") == b"mine"
    flight.publish("mission", b"mine still")
    wire.settle()
    assert read_messages(ground, "mission") == b"mine still"


def test_code_is_hmac_sha256_with_unambiguous_parts():
    assert len(KEY.sign(b"a")) == 32
    assert KEY.sign(b"ab", b"c") != KEY.sign(b"a", b"bc")
    assert KEY.sign(b"a", b"b") != KEY.sign(b"a", b"b", b"")
    assert KEY.sign(b"a") != OTHER.sign(b"a")


def test_key_is_read_and_never_shown(tmp_path, monkeypatch):
    file = tmp_path / "key"
    file.write_text("0123456789abcdef-secret\n")
    key = read_key(file)
    assert key == SharedKey(b"0123456789abcdef-secret")
    address = Address.of("zenoh:10.0.0.5:7447", key)
    for display in (repr(key), str(key), repr(address), str(address), repr([address]), f"{address!r}"):
        assert "secret" not in display.replace("secret=", "")
    assert pickle.loads(pickle.dumps(address)).shared == key
    monkeypatch.setenv("RETRIM_KEY", " 0123456789abcdef-secret ")
    assert read_key(None) == key
    assert "RETRIM_KEY" not in os.environ  # processes that are started from now on do not have it
    assert read_key(None) is None


@pytest.mark.parametrize("text", ["", "short", "x" * 5000, " " * 50])
def test_invalid_key_gives_one_line_without_it(tmp_path, monkeypatch, text):
    file = tmp_path / "key"
    file.write_text(text)
    with pytest.raises(ConfigError, match="a key has 16 to 4096 bytes") as error:
        read_key(file)
    assert text.strip() == "" or text not in str(error.value)
    monkeypatch.setenv("RETRIM_KEY", text)
    if text:
        with pytest.raises(ConfigError, match=r"RETRIM_KEY: a key has 16 to 4096 bytes"):
            read_key(None)


def test_unreadable_key_file_is_refused(tmp_path):
    for file in (tmp_path / "none", tmp_path, tmp_path / "a\0b"):
        with pytest.raises(ConfigError, match="the key cannot be read") as error:
            read_key(file)
        assert str(error.value).isprintable()


def test_key_is_required_beyond_loopback():
    for text in ("zenoh:192.168.1.5:7447", "ros:robot:11311/quad1", "zenoh:0.0.0.0:7447", "zenoh:127.0.0.1.evil:1"):
        with pytest.raises(ConfigError, match="need a shared key: --key FILE or the variable RETRIM_KEY"):
            Address.of(text).check_shared()
        Address.of(text, KEY).check_shared()
    for text in ("zenoh:127.0.0.1:7447", "ros:localhost:11311"):
        Address.of(text).check_shared()


def test_mark_distinguishes_signed_messages():
    assert sessions.MARK[-1] > 0x80  # writer numbers of unsigned messages have 63 bits
