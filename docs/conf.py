"""The site: `python -m sphinx -W docs docs/_site` after `pip install -e '.[docs]'`."""

import inspect
from typing import Any

project = "jaxsafe"
author = "The jaxsafe authors"
copyright = "The jaxsafe authors, MIT licence"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_site", "jupyter_execute"]  # a build makes these
nb_execution_mode = "off"  # pages show what is committed, and a test runs the notebook
myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
myst_links_external_new_tab = True

html_theme = "furo"
html_title = "jaxsafe"
html_theme_options = {"navigation_with_keys": True}
html_static_path = ["_static"]
html_css_files = ["site.css"]

autodoc_default_options = {"members": True, "member-order": "bysource", "no-value": True}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_preserve_defaults = True
autodoc_mock_imports = ["brax", "gymnax", "onnx", "stable_baselines3"]
default_role = "py:obj"  # names in docstrings are code
python_use_unqualified_type_names = True
smartquotes = False  # code in docstrings stays as it is written


def setup(app: Any) -> None:
    """Adapt what the extensions read."""
    app.connect("source-read", _link_to_file)
    # Before and after napoleon, which reads docstrings with priority 500.
    app.connect("autodoc-process-docstring", _before_napoleon, priority=100)
    app.connect("autodoc-process-docstring", _after_napoleon, priority=900)


def _link_to_file(_app: Any, _page: str, content: list[str]) -> None:
    """Make a link to a Markdown file that is no page of the site one to the file."""
    content[0] = content[0].replace("](../tests/golden/R", "](path:../tests/golden/R")


_attributes: dict[str, list[str]] = {}
"""Docstrings of attributes, from before napoleon to after it."""


def _before_napoleon(
    _app: Any, what: str, name: str, item: Any, _options: Any, lines: list[str]
) -> None:
    """Give a package that can be called the docstring of its function."""
    if what == "function" and inspect.ismodule(item):
        lines[:] = (inspect.getdoc(item.__wrapped__) or "").splitlines()
    if what in ("attribute", "data", "property"):
        _attributes[name] = lines.copy()


def _after_napoleon(
    _app: Any, _what: str, name: str, _item: Any, _options: Any, lines: list[str]
) -> None:
    """Keep the docstring of an attribute, of which napoleon takes a part for its type."""
    lines[:] = _attributes.pop(name, lines)
