"""The documentation site: `make docs` builds it into out/docs, with warnings as errors."""

from __future__ import annotations

import re
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import generate  # noqa: E402 - beside this file

import reem  # noqa: E402

project = "REEM"
author = "The authors of REEM"
copyright = "the authors of REEM"  # noqa: A001 - Sphinx's name
release = reem.__version__

extensions = ["myst_parser", "sphinx.ext.napoleon", "sphinx.ext.autodoc"]
myst_enable_extensions = ["colon_fence", "deflist", "attrs_block"]
myst_heading_anchors = 4
suppress_warnings = ["myst.header"]  # the reports of past runs begin where they begin
default_role = "code"
nitpicky = False
exclude_patterns = ["**/README.md"]
add_module_names = False

html_theme = "furo"
html_title = f"REEM {release}"
html_static_path = ["static"]
html_css_files = ["reem.css"]
html_show_sourcelink = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#0b5fa5", "color-brand-content": "#0b5fa5"},
    "dark_css_variables": {"color-brand-primary": "#6fb3e8", "color-brand-content": "#6fb3e8"},
}

_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(((?:\.\./)+[^)\s]+)\)")


def _name_files(app: object, name: str, source: list[str]) -> None:
    """Links to files of the repository that are no pages become the name of the file."""
    folder = (HERE / name).parent

    def shown(found: re.Match[str]) -> str:
        target = (folder / found[2].partition("#")[0]).resolve()
        if HERE in target.parents:
            return found[0]
        text, path = found[1].strip("`"), target.relative_to(HERE.parent)
        return f"`{path}`" if text in (str(path), path.name) else f"{found[1]} (`{path}`)"

    source[0] = _LINK.sub(shown, source[0])


def setup(app: object) -> None:
    """Write the generated pages, then let Sphinx read them."""
    generate.write_all()
    app.connect("source-read", _name_files)  # type: ignore[attr-defined]
