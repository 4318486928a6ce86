"""The documentation site: `make docs` builds it into out/docs, with warnings as errors."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

from sphinx.application import Sphinx

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
exclude_patterns = ["skills"]
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


def _name_files(app: Sphinx, name: str, source: list[str]) -> None:
    """Links to files of the repository that are no pages become the name of the file."""
    folder = (HERE / name).parent

    def shown(found: re.Match[str]) -> str:
        target = (folder / found[2].partition("#")[0]).resolve()
        if HERE in target.parents:
            return found[0]
        text, path = found[1].strip("`"), target.relative_to(HERE.parent)
        return f"`{path}`" if text in (str(path), path.name) else f"{found[1]} (`{path}`)"

    source[0] = _LINK.sub(shown, source[0])


def _copy_for_agents(app: Sphinx, error: Exception | None) -> None:
    """Put llms.txt and the skill at the top of the site; their links lead to the sources of the pages."""
    shutil.copytree(HERE / "skills", app.outdir / "skills", dirs_exist_ok=True)
    text = (HERE / "llms.txt").read_text(encoding="utf-8")
    text = re.sub(r"\]\((?!skills)([\w/-]+\.md)\)", r"](_sources/\1.txt)", text)
    (app.outdir / "llms.txt").write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> None:
    """Write the generated pages, then let Sphinx read them."""
    generate.write_all()
    app.connect("source-read", _name_files)
    app.connect("build-finished", _copy_for_agents)
