"""YAML as users expect it: safe, `1e6` a number, `on` and `no` plain words, a repeated key an error.

PyYAML follows YAML 1.1, which reads `1e6` and `3e-4` as strings and `no` as False. The scalars here are those of the core
schema of YAML 1.2. Nothing in a file can name a Python object.
"""

from __future__ import annotations

import os
import re
from typing import Any

import yaml

from jaxsafe.errors import ConfigError

_SCALARS = (
    ("null", r"(?:~|null|)", "~n\0"),
    ("bool", r"(?:true|false)", "tf"),
    ("int", r"[-+]?[0-9]+", "-+0123456789"),
    ("float", r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan", "-+0123456789."),
)


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict = {}  # noqa: RUF012, typed so by the base

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        repeated = next((key for key in keys if keys.count(key) > 1), None)
        if repeated is not None:
            raise yaml.constructor.ConstructorError(None, None, f"key {repeated!r} stands twice", node.start_mark)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    yaml_implicit_resolvers: dict = {}  # noqa: RUF012, typed so by the base

    def ignore_aliases(self, data: Any) -> bool:
        return True


for _tag, _pattern, _first in _SCALARS:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}",
            re.compile(f"^(?:{_pattern})$"),
            list(_first.replace("\0", "")) + [""] * ("\0" in _first),
        )


def _int(loader: _Loader, node: yaml.ScalarNode) -> int:
    return int(node.value)  # 010 is ten, not eight


_Loader.add_constructor("tag:yaml.org,2002:int", _int)


def parse(text: str, place: str) -> Any:
    """Read one YAML document from a string.

    Raises:
        ConfigError: the text is not YAML; the message begins with `place` and gives the line.
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise ConfigError(
            f"{place}{where}: not valid YAML: {getattr(error, 'problem', None) or 'cannot be read'}"
        ) from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{place}: not valid YAML: {str(error).splitlines()[0]}") from None


def read(path: str | os.PathLike) -> Any:
    """Read a YAML file.

    Raises:
        ConfigError: the file cannot be read or is not YAML.
    """
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or 'not a text file'}") from None
    return parse(text, str(path))


def write(value: Any, ascii_only: bool = False) -> str:
    """Plain data as YAML: mappings in block style, lists of scalars on one line, other letters as escapes if asked for."""
    options = {"sort_keys": False, "default_flow_style": None, "width": 100, "allow_unicode": not ascii_only}
    return yaml.dump(value, Dumper=_Dumper, **options)
