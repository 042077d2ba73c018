"""YAML as users expect it: safe, `1e6` a number, `on` and `no` plain words, a repeated key an error.

PyYAML follows YAML 1.1, which reads `1e6` and `3e-4` as strings and `no` as False. The scalars here are those of the core
schema of YAML 1.2, and so are the tags: `!!str 12` is text, and every tag outside that schema is an error. Nothing in a
file can name a Python object.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Callable
from typing import Any

import yaml
from yaml.constructor import ConstructorError

from jaxsafe.schema.errors import ConfigError, show

MAX_LETTERS = 2**20
"""A text may be this long: PyYAML takes about ten seconds to read as much. An environment has some 10,000 letters."""

MAX_VALUES = 1_000_000
"""A document may hold this many values once its aliases are replaced, more than fit into a text without any. A few nested
aliases stand for billions."""

_SCALARS = (
    ("null", r"(?:~|null|)", "~n\0"),
    ("bool", r"(?:true|false)", "tf"),
    ("int", r"[-+]?[0-9]+", "-+0123456789"),
    ("float", r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan", "-+0123456789."),
)


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict = {}  # noqa: RUF012, typed so by the base
    yaml_constructors: dict = {}  # noqa: RUF012, typed so by the base

    def get_single_data(self) -> Any:
        node = self.get_single_node()
        if node is None:
            return None
        if _count_values(node, {}) > MAX_VALUES:
            problem = f"its aliases stand for more than {MAX_VALUES:,} values"
            raise ConstructorError(None, None, problem, node.start_mark)
        return self.construct_document(node)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        if not isinstance(node, yaml.MappingNode):
            raise ConstructorError(None, None, "expected a mapping after the tag !!map", node.start_mark)
        result: dict[Any, Any] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise ConstructorError(None, None, "expected a name or a number as a key", key_node.start_mark)
            key = self.construct_object(key_node, deep=True)
            if key in result:
                raise ConstructorError(None, None, f"key {show(key)} stands twice", node.start_mark)
            result[key] = self.construct_object(value_node, deep=deep)
        return result


def _count_values(node: yaml.Node, known: dict[int, int | None]) -> int:
    """Count the values below a node as if every alias were written out; `known` holds the counts found so far."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in known:
        known[id(node)] = None  # until it is counted
        parts = [part for pair in node.value for part in pair] if isinstance(node, yaml.MappingNode) else node.value
        known[id(node)] = 1 + sum(_count_values(part, known) for part in parts)
    count = known[id(node)]
    if count is None:
        raise ConstructorError(None, None, "an alias stands inside what it is the alias of", node.start_mark)
    return count


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


_CONVERT: dict[str, Callable[[str], Any]] = {
    "null": lambda text: None,
    "bool": lambda text: text == "true",
    "int": int,  # 010 is ten, not eight
    "float": lambda text: float(text.replace(".inf", "inf").replace(".nan", "nan")),
}


def _scalar(loader: _Loader, node: yaml.Node) -> Any:
    """Read a scalar of the core schema, whether its tag was written out or follows from its form."""
    name = node.tag.rpartition(":")[2]
    pattern = next(pattern for tag, pattern, _ in _SCALARS if tag == name)
    if not isinstance(node, yaml.ScalarNode) or not re.fullmatch(pattern, node.value):
        problem = (
            f"found {show(node.value) if isinstance(node, yaml.ScalarNode) else 'a collection'} after the tag !!{name}"
        )
        raise ConstructorError(None, None, problem, node.start_mark)
    return _CONVERT[name](node.value)


def _text(loader: _Loader, node: yaml.ScalarNode) -> str:
    """Read a text. An escape can write what no file name or terminal takes: control characters and half characters."""
    text = loader.construct_scalar(node)
    if any(unicodedata.category(letter) in ("Cc", "Cs") and letter not in "\t\n" for letter in text):
        raise ConstructorError(None, None, f"found a control character in {show(text)}", node.start_mark)
    return text


for _tag in _CONVERT:
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _scalar)
_Loader.add_constructor("tag:yaml.org,2002:str", _text)
_Loader.add_constructor("tag:yaml.org,2002:seq", _Loader.construct_yaml_seq)
_Loader.add_constructor("tag:yaml.org,2002:map", _Loader.construct_yaml_map)
_Loader.yaml_constructors[None] = _Loader.construct_undefined  # every other tag


class _TextLoader(_Loader):
    """Reads every scalar as text."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012, typed so by the base


def parse(text: str, place: str, as_text: bool = False) -> Any:
    """Read one YAML document from a string, its scalars `as_text` if they are names whatever they look like.

    Raises:
        ConfigError: the text is not YAML or too long; the message begins with `place` and gives the line.
    """
    if len(text) > MAX_LETTERS:
        raise ConfigError(f"{place}: expected at most {MAX_LETTERS:,} letters")
    try:
        return yaml.load(text, _TextLoader if as_text else _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise ConfigError(
            f"{place}{where}: not valid YAML: {getattr(error, 'problem', None) or 'cannot be read'}"
        ) from None
    except (ValueError, OverflowError, RecursionError) as error:
        raise ConfigError(f"{place}: not valid YAML: {str(error).splitlines()[0]}") from None


def read(path: str | os.PathLike) -> Any:
    """Read a YAML file.

    Raises:
        ConfigError: the file cannot be read or is not YAML.
    """
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read(MAX_LETTERS + 1)
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or 'not a text file'}") from None
    return parse(text, str(path))


def write(value: Any, ascii_only: bool = False) -> str:
    """Plain data as YAML: mappings in block style, lists of scalars on one line, other letters as escapes if asked for."""
    options = {"sort_keys": False, "default_flow_style": None, "width": 100, "allow_unicode": not ascii_only}
    return yaml.dump(value, Dumper=_Dumper, **options)
