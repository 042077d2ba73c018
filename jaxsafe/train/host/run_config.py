"""The file `config.yaml` of a run, as data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jaxsafe.schema import yaml12
from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.forms import NULL, NUMBER, TEXT, check


def read_content(path: Path) -> dict[str, Any]:
    """Return what `config.yaml` of a run holds, as data.

    Raises:
        ConfigError: it cannot be read, or does not belong to a run.
    """
    file = path / "config.yaml"
    content = yaml12.read(file)
    if not isinstance(content, dict) or not {"env", "training", "environment"} <= set(content):
        raise ConfigError(f"{file}: expected the keys env, training and environment")
    form = {"env": TEXT | NUMBER, "training": {}, "environment": {}}
    check(content, form | ({"commit": TEXT | NULL} if "commit" in content else {}), str(file))
    return content
