"""Reads the header of a Blackbox flight log of Betaflight: the layout of its frames and the settings of the board."""

import struct
from dataclasses import dataclass
from pathlib import Path

from ...errors import LogError

BEGIN = b"H Product:Blackbox"
LONGEST = 64 * 1024  # largest size of a header [bytes]
FIELDS = 256  # largest number of fields in a frame
LARGEST = 2.0**32  # no setting of a board is larger
HEADER_MARK = b"H "
ENCODINGS = (0, 1, 3, 6, 7, 8, 9)
PREDICTORS = range(12)


@dataclass(frozen=True)
class FrameLayout:
    """Fields of one kind of frame."""

    encodings: tuple[int, ...]
    predictors: tuple[int, ...]


@dataclass(frozen=True)
class BlackboxHeader:
    """Header of one flight."""

    names: tuple[str, ...]
    """Fields of the main frames."""
    signed: tuple[bool, ...]
    layouts: dict[str, FrameLayout]
    """Layouts of frames, by their letter: I and P, and S, G and H if the log contains them."""
    values: dict[str, str]
    """Settings of the board."""
    end: int
    """Offset of the first frame."""

    def numbers(self, name: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """Return a setting's numbers, which commas separate, or ``default``.

        The default applies if the setting is absent or not as long, or if a number is not finite or exceeds 32 bits.
        """
        try:
            result = tuple(float(part) for part in self.values.get(name, "").split(","))
        except ValueError:
            return default
        fits = len(result) == len(default) and all(abs(number) <= LARGEST for number in result)
        return result if fits else default

    def interval(self) -> tuple[int, int]:
        """Return how many of how many loop iterations are logged."""
        text = self.values.get("P interval", "1/1")
        first, _, second = text.partition("/")
        try:
            number, count = (int(first), int(second)) if second else (1, int(first))
        except ValueError:
            return 1, 1
        return (number, count) if 1 <= number <= count <= 10_000 else (1, 1)

    @property
    def revision(self) -> str:
        """Name and version of the firmware, in printable letters."""
        return "".join(c for c in self.values.get("Firmware revision", "") if c.isprintable())[:80].strip()

    @property
    def gyro_scale(self) -> float:
        """Rate of one unit of the gyroscope [deg/s]."""
        text = self.values.get("gyro_scale", "0x3f800000")
        try:
            bits = int(text, 16)
            scale = struct.unpack("<f", struct.pack("<I", bits))[0]
        except (ValueError, struct.error):
            return 1.0
        return float(scale) if 1e-3 <= scale <= 10.0 else 1.0


def read_header(path: Path, data: bytes, begin: int) -> BlackboxHeader:
    """Read the header that starts at an offset.

    Args:
        path: The file, for messages.
        data: Contents of the file.
        begin: Offset of the header.

    Raises:
        LogError: The header is not complete, or describes frames that no board writes.
    """
    values, at = dict[str, str](), begin
    while data.startswith(HEADER_MARK, at):
        end = data.find(b"\n", at, begin + LONGEST)
        if end < 0:
            break
        name, _, value = data[at + 2 : end].decode("latin-1").partition(":")
        values.setdefault(name.strip(), value.strip())
        at = end + 1
    kinds = {kind for kind in "IPSGH" if f"Field {kind} encoding" in values}
    if not {"I", "P"} <= kinds or "Field I name" not in values:
        raise LogError(f"{path}: the header of the Blackbox log is incomplete: it does not describe its frames")
    names = tuple(values["Field I name"].split(","))
    layouts = {kind: _layout(path, values, kind) for kind in sorted(kinds)}
    signed = tuple(part == "1" for part in values.get("Field I signed", "").split(","))
    sizes = {len(names), len(signed), *(len(layouts[kind].encodings) for kind in "IP")}
    if len(sizes) != 1 or not 2 <= len(names) <= FIELDS or names[:2] != ("loopIteration", "time"):
        raise LogError(f"{path}: the header of the Blackbox log is damaged: its lists of fields do not match")
    return BlackboxHeader(names, signed, layouts, values, at)


def _layout(path: Path, values: dict[str, str], kind: str) -> FrameLayout:
    """Return the layout of one kind of frame."""
    try:
        encodings = tuple(int(part) for part in values[f"Field {kind} encoding"].split(","))
        predictors = tuple(int(part) for part in values.get(f"Field {kind} predictor", "").split(","))
    except ValueError:
        encodings, predictors = (), (0,)
    known = all(code in ENCODINGS for code in encodings) and all(code in PREDICTORS for code in predictors)
    if not known or len(encodings) != len(predictors) or len(encodings) > FIELDS:
        raise LogError(
            f"{path}: the header of the Blackbox log is damaged: it describes no {kind} frame that is supported"
        )
    return FrameLayout(encodings, predictors)
