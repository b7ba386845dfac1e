"""Messages of errors are one printable line of limited length for any quoted text."""

import pickle

import pytest

from retrim import errors
from retrim.cli.console import RichReporter, console, refuse
from retrim.errors import LONGEST, RetrimError, excerpt, one_line, printable

KINDS = [each for each in vars(errors).values() if isinstance(each, type) and issubclass(each, RetrimError)]


@pytest.mark.parametrize("kind", KINDS)
def test_message_is_one_line_for_any_quoted_text(kind):
    for text in ("plain", "a\nb\tc", "\x1b[2J\x00\u202e", "start " + 10**7 * "x" + " end", ""):
        error = kind(text)
        assert len(str(error)) <= LONGEST
        assert str(error).isprintable()
        assert str(pickle.loads(pickle.dumps(error))) == str(error)
    assert str(kind("plain: 'a' must be b")) == "plain: 'a' must be b"


def test_long_line_keeps_beginning_and_end():
    line = one_line("start " + 10**7 * "x" + " end")
    assert line.startswith("start x")
    assert line.endswith("x end")
    assert len(line) == LONGEST
    assert one_line("a \n b\x07") == "a b\\x07"
    assert excerpt(10**7 * "x") == f"'{'x' * 34} ... {'x' * 19}'"
    assert excerpt("a'b\n") == '"a\'b\\n"'


def test_shown_text_has_no_control_characters():
    with console.capture() as display:
        refuse("a\x1b]0;owned\x07")
        RichReporter().say("b\x1b[2J\nc")
        with RichReporter().progress("d") as advance:
            advance(1.0, "e\x1b[2J")
    assert "\x1b[2J" not in display.get()
    assert "\x07" not in display.get()
    assert printable("a\tb\nc\x9b") == "a\\tb\nc\\x9b"
