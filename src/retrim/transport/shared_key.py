"""Read the key that two machines share, and sign their messages with it."""

import hashlib
import hmac
import os
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import ConfigError

VARIABLE = "RETRIM_KEY"
SHORTEST, LONGEST = 16, 4096  # bytes
KEY_COMMAND = "openssl rand -hex 32 > FILE makes one"


@dataclass(frozen=True)
class SharedKey:
    """The key; it is never displayed."""

    secret: bytes = field(repr=False)

    def sign(self, *parts: bytes) -> bytes:
        """Return HMAC-SHA256 over the parts, each preceded by its length: 32 bytes."""
        code = hmac.new(self.secret, digestmod=hashlib.sha256)
        for part in parts:
            code.update(len(part).to_bytes(8, "little"))
            code.update(part)
        return code.digest()


def read_key(file: Path | None) -> SharedKey | None:
    """Return the key from a file or from the variable ``RETRIM_KEY``; None if there is neither.

    The variable is removed from the environment, so that processes that are started later do not inherit the key.

    Raises:
        ConfigError: The file cannot be read, or the key is too short or too long.
    """
    variable, source = os.environ.pop(VARIABLE, ""), VARIABLE
    secret = variable.encode("utf-8", "surrogateescape").strip()
    if file is not None:
        source = f"--key {str(file)[:80]!r}"
        try:
            with file.open("rb") as stream:
                secret = stream.read(LONGEST + 2).strip()
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or "no such file"
            raise ConfigError(f"{source}: the key cannot be read ({reason}); {KEY_COMMAND}") from error
    elif not variable:
        return None
    if not SHORTEST <= len(secret) <= LONGEST:
        raise ConfigError(f"{source}: a key has {SHORTEST} to {LONGEST} bytes, this one {len(secret)}; {KEY_COMMAND}")
    return SharedKey(secret)
