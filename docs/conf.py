"""Configuration of the Sphinx site, which ``sphinx-build -W -b html docs docs/_build/html`` builds."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

from impact_posture import __version__

project = "impact-posture"
author = "The impact-posture authors"
release = version = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.mathjax",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "api_reference",
    "cli_reference",
    "package_structure",
]
# Use MathJax from its wheel, so that equations show without a network.  If the wheel is missing, Sphinx uses a CDN.
if importlib.util.find_spec("sphinx-mathjax-offline"):
    extensions.append("sphinx-mathjax-offline")

# Two hyphens must stay hyphens, because they begin an option.
smartquotes = False
html_show_copyright = False
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_title = f"impact-posture {release}"
exclude_patterns = ["_build", "generated"]

myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
myst_dmath_double_inline = True

autodoc_member_order = "bysource"
suppress_warnings = ["ref.python"]
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
# The pages of CasADi and Pinocchio are not linked, because the build must work without a network.
autodoc_class_signature = "mixed"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
