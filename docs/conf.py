# SPDX-License-Identifier: LGPL-3.0-or-later
"""Sphinx: ``pip install -e '.[docs]'``, then ``sphinx-build -W docs docs/_build``."""

from importlib.metadata import version as installed_version

project = "fenicsx_hmcontact"
author = "The fenicsx_hmcontact developers"
version = release = installed_version(project)

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.napoleon",
]
myst_enable_extensions = ["dollarmath"]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
exclude_patterns = ["_build"]
html_theme = "furo"
