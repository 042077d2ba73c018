"""The site: `python -m sphinx -W docs docs/_site` after `pip install -e '.[docs]'`."""

import functools
import re
from collections.abc import Callable
from typing import Any

project = "jaxsafe"
author = "The jaxsafe authors"
copyright = "The jaxsafe authors, MIT licence"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
exclude_patterns = ["_site", "jupyter_execute"]  # a build makes these
nb_execution_mode = "off"  # pages show what is committed, and a test runs the notebook
myst_heading_anchors = 3
myst_links_external_new_tab = True

html_theme = "furo"
html_title = "jaxsafe"
html_theme_options = {"navigation_with_keys": True}

autodoc_default_options = {"members": True, "member-order": "bysource", "no-value": True}
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_preserve_defaults = True
autodoc_mock_imports = ["brax", "gymnax", "onnx", "stable_baselines3"]
add_module_names = False


def setup(app: Any) -> None:
    """Make links that hold in the repository hold on the site.

    The README, one folder up, is its first page.
    """
    app.connect("include-read", lambda _app, _path, _page, content: _each(content, _in_docs))
    app.connect(
        "source-read",
        lambda _app, page, content: _each(content, functools.partial(_to_first_page, page)),
    )


def _each(content: list[str], change: Callable[[str], str]) -> None:
    content[0] = change(content[0])


def _in_docs(readme: str) -> str:
    outside = re.sub(r"\]\((?!https?:|docs/)", "](../", readme).replace("](docs/", "](")
    return outside.replace("](../tests/golden/README.md", "](path:../tests/golden/README.md")


def _to_first_page(page: str, text: str) -> str:
    up = "../" * page.count("/")
    return text.replace(f"]({up}../README.md", f"]({up}index.md").replace(
        "](../tests/golden/R", "](path:../tests/golden/R"
    )
