"""A seed of an evaluation that stays hidden, and a commitment to it that can be checked later."""

from __future__ import annotations

import hashlib
import secrets
from pathlib import Path
from typing import Any, NamedTuple

from jaxsafe.storage.files import OWNER, read_json, write_json
from jaxsafe.storage.forms import Kind

NUM_SEEDS = 2**31
"""The seeds are the whole numbers below this one, as for the option `seed`."""

SALT_BYTES = 16
"""Number of random bytes of a salt. Without them the seed could be found by trying all seeds."""

_FORM = {
    "seed": Kind(
        f"a whole number from 0 to {NUM_SEEDS - 1:,}",
        lambda value: type(value) is int and 0 <= value < NUM_SEEDS,
    ),
    "salt": Kind(
        f"at least {2 * SALT_BYTES} letters",
        lambda value: isinstance(value, str) and len(value) >= 2 * SALT_BYTES,
    ),
}
"""The form of the file of a hidden seed."""


class HiddenSeed(NamedTuple):
    """A seed that results do not name."""

    seed: int
    salt: str

    @property
    def commitment(self) -> str:
        """The SHA-256 of the text `SEED:SALT`, as `sha256sum` prints it. Results have it."""
        return hashlib.sha256(f"{self.seed}:{self.salt}".encode()).hexdigest()


def read_hidden_seed(path: Path) -> HiddenSeed:
    """Return the hidden seed in a file.

    Raises:
        ConfigError: the file is missing, broken, or of another form.
    """
    content: dict[str, Any] = read_json(path, _FORM)
    return HiddenSeed(content["seed"], content["salt"])


def read_or_draw_hidden_seed(path: Path) -> HiddenSeed:
    """Return the hidden seed in a file. If there is no such file, draw one and write it.

    Only the user may read the new file.

    Raises:
        ConfigError: the file is broken or of another form.
    """
    if path.exists():
        return read_hidden_seed(path)
    drawn = HiddenSeed(secrets.randbelow(NUM_SEEDS), secrets.token_hex(SALT_BYTES))
    write_json(path, drawn._asdict(), OWNER)
    return drawn
