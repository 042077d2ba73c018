"""YAML as users expect it.

`1e6` is a number, `on` and `no` are plain words, and a repeated key is an error.

PyYAML follows YAML 1.1, which reads `1e6` and `3e-4` as strings and `no` as False. The scalars here
are those of the core schema of YAML 1.2. The tags are those of the core schema too: `!!str 12` is
text, and every other tag is an error. Reading is safe, because nothing in a file can name a Python
object.
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
"""The longest text that is read. PyYAML takes about ten seconds for a text of this length.

The text of an environment has some 10,000 letters.
"""

MAX_VALUES = 1_000_000
"""The most values that a document may hold once its aliases are replaced.

A text without aliases cannot hold as many, but a few nested aliases stand for billions.
"""

_SCALARS = (
    ("null", r"(?:~|null|)", ("~", "n", "")),
    ("bool", r"(?:true|false)", tuple("tf")),
    ("int", r"[-+]?[0-9]+", tuple("-+0123456789")),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan",
        tuple("-+0123456789."),
    ),
)
"""Name, pattern and possible first letters of the scalars that are not text.

An empty first letter stands for an empty scalar.
"""


class _Loader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict = {}  # noqa: RUF012, typed so by the base
    yaml_constructors: dict = {}  # noqa: RUF012, typed so by the base

    def get_single_data(self) -> Any:
        node = self.get_single_node()
        if node is None:
            return None
        if _count_values(node, {}) > MAX_VALUES:
            problem = f"its aliases stand for more than {MAX_VALUES:,} values"
            raise ConstructorError(problem=problem, problem_mark=node.start_mark)
        return self.construct_document(node)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        if not isinstance(node, yaml.MappingNode):
            problem = "expected a mapping after the tag !!map"
            raise ConstructorError(problem=problem, problem_mark=node.start_mark)
        result: dict[Any, Any] = {}
        for key_node, value_node in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                problem = "expected a name or a number as a key"
                raise ConstructorError(problem=problem, problem_mark=key_node.start_mark)
            key = self.construct_object(key_node, deep=True)
            if key in result:
                problem = f"key {show(key)} stands twice"
                raise ConstructorError(problem=problem, problem_mark=node.start_mark)
            result[key] = self.construct_object(value_node, deep=deep)
            if result[key] is None and _lacks_space(key_node, value_node):
                name, _, value = key_node.value.partition(":")
                problem = f"found {show(key_node.value)}; write a space after the colon: "
                problem += f"{name}: {value}"
                raise ConstructorError(problem=problem, problem_mark=key_node.start_mark)
        return result


def _lacks_space(key: yaml.ScalarNode, value: yaml.Node) -> bool:
    """Return whether a key without a value is `name:value`, written without the space."""
    plain = key.style is None and value.start_mark.index == value.end_mark.index
    return plain and re.fullmatch(r"[^:]+:[^:]+", key.value) is not None


def _count_values(node: yaml.Node, counts: dict[int, int | None]) -> int:
    """Count the values below a node as if every alias were written out.

    Args:
        node: the node.
        counts: the counts of nodes so far, by the id of the node. None marks a node that is being
            counted.
    """
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in counts:
        counts[id(node)] = None
        children = node.value
        if isinstance(node, yaml.MappingNode):
            children = [child for pair in node.value for child in pair]
        counts[id(node)] = 1 + sum(_count_values(child, counts) for child in children)
    count = counts[id(node)]
    if count is None:
        problem = "an alias stands inside what it is the alias of"
        raise ConstructorError(problem=problem, problem_mark=node.start_mark)
    return count


class _Dumper(yaml.SafeDumper):
    yaml_implicit_resolvers: dict = {}  # noqa: RUF012, typed so by the base

    def ignore_aliases(self, data: Any) -> bool:
        return True


for _tag, _pattern, _first_letters in _SCALARS:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            tag=f"tag:yaml.org,2002:{_tag}",
            regexp=re.compile(f"^(?:{_pattern})$"),
            first=list(_first_letters),
        )


_CONVERT: dict[str, Callable[[str], Any]] = {
    "null": lambda text: None,
    "bool": lambda text: text == "true",
    "int": int,  # 010 is ten, not eight
    "float": lambda text: float(text.replace(".inf", "inf").replace(".nan", "nan")),
}


def _construct_scalar(loader: _Loader, node: yaml.Node) -> Any:
    """Read a scalar that is not text, whether its tag was written out or follows from its form."""
    name = node.tag.rpartition(":")[2]
    pattern = next(pattern for tag, pattern, _ in _SCALARS if tag == name)
    if not isinstance(node, yaml.ScalarNode) or not re.fullmatch(pattern, node.value):
        found = show(node.value) if isinstance(node, yaml.ScalarNode) else "a collection"
        problem = f"found {found} after the tag !!{name}"
        raise ConstructorError(problem=problem, problem_mark=node.start_mark)
    return _CONVERT[name](node.value)


def _construct_text(loader: _Loader, node: yaml.ScalarNode) -> str:
    """Read a text. Refuse control characters and surrogates, which are halves of characters.

    An escape can write such characters, but no file name or terminal takes them.
    """
    text = loader.construct_scalar(node)
    categories = [unicodedata.category(letter) for letter in text if letter not in "\t\n"]
    if "Cc" in categories or "Cs" in categories:
        problem = f"found a control character in {show(text)}"
        raise ConstructorError(problem=problem, problem_mark=node.start_mark)
    return text


for _tag in _CONVERT:
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _construct_scalar)
_Loader.add_constructor("tag:yaml.org,2002:str", _construct_text)
_Loader.add_constructor("tag:yaml.org,2002:seq", _Loader.construct_yaml_seq)
_Loader.add_constructor("tag:yaml.org,2002:map", _Loader.construct_yaml_map)
_Loader.yaml_constructors[None] = _Loader.construct_undefined  # every other tag


class _TextLoader(_Loader):
    """Loader that reads every scalar as text."""

    yaml_implicit_resolvers: dict = {}  # noqa: RUF012, typed so by the base


def parse(text: str, place: str, as_text: bool = False) -> Any:
    """Read one YAML document from a string.

    Args:
        text: the document.
        place: where the text comes from. Error messages begin with it.
        as_text: whether every scalar is read as text, for names that may look like numbers.

    Raises:
        ConfigError: the text is too long or not YAML. The message gives the line.
    """
    if len(text) > MAX_LETTERS:
        raise ConfigError(f"{place}: expected at most {MAX_LETTERS:,} letters")
    try:
        return yaml.load(text, _TextLoader if as_text else _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "cannot be read"
        raise ConfigError(f"{place}{line}: not valid YAML: {problem}") from None
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
        reason = getattr(error, "strerror", None) or "not a text file"
        raise ConfigError(f"{path}: cannot be read: {reason}") from None
    return parse(text, str(path))


def write(value: Any, ascii_only: bool = False) -> str:
    """Return plain data as YAML.

    Mappings are in block style, and a list of scalars stands on one line. With `ascii_only` letters
    that are not ASCII are written as escapes.
    """
    return yaml.dump(
        value,
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        width=100,
        allow_unicode=not ascii_only,
    )
