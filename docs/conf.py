"""Settings of Sphinx. `make docs` builds the pages; a warning is an error."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
sys.path.insert(0, str(HERE / "reference"))

import generate  # noqa: E402

import bodycap_batch  # noqa: E402 - found through the path above

project = "bodycap"
author = "bodycap_batch contributors"
release = version = bodycap_batch.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "reference/generated/README.md"]
html_theme = "furo"
html_title = f"bodycap {release}"
html_show_copyright = False
html_static_path = ["static"]
html_css_files = ["narrow.css"]
default_role = "code"
myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence"]
autodoc_typehints = "description"
autodoc_member_order = "bysource"
napoleon_numpy_docstring = False
# Names of types from other libraries have no page here.
nitpicky = False


def setup(app: object) -> None:
    """Write the generated part of the reference before Sphinx reads the pages."""
    app.connect("builder-inited", lambda _: generate.write_all(HERE / "reference" / "generated"))  # type: ignore[attr-defined]
