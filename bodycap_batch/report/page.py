"""The page itself: templates filled in, styles, glue and the 3D library written into one file."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from typing import Any

from bodycap_batch.core.errors import StoreError

LIBRARY = "k3d"
"""The package whose browser bundle, with all of three.js in it, is written into the page."""
_BUNDLE = "k3d/static/standalone.js"
_SCRIPTS = (
    "packing.js",
    "timeline.js",
    "orbit.js",
    "splat.js",
    "solid.js",
    "flat.js",
    "film.js",
    "picture.js",
    "main.js",
)


def render(context: Mapping[str, Any], data: Mapping[str, Any]) -> str:
    """Fill in the page.

    Args:
        context: What the templates show.
        data: What the viewer draws; JSON values.

    Returns:
        A whole HTML document that asks nothing of the network.

    Raises:
        StoreError: The 3D library's file is missing from its package.
    """
    import jinja2

    folder = files("bodycap_batch.report") / "templates"
    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8")),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    body = environment.get_template("page.html").render(
        **context,
        style=(folder / "style.css").read_text(encoding="utf-8"),
        script="\n".join((folder / name).read_text(encoding="utf-8") for name in _SCRIPTS),
        library=library() if context["has_solid"] else "",
        library_name=f"{LIBRARY} {metadata.version(LIBRARY)}",
        data=json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
    )
    return body if body.endswith("\n") else f"{body}\n"


def library() -> str:
    """The 3D library's JavaScript, fit to stand inside a script element."""
    path = Path(str(metadata.distribution(LIBRARY).locate_file(_BUNDLE)))
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise StoreError(
            "the 3D library's bundle is missing",
            path=path,
            hint=f"install it again: pip install --force-reinstall {LIBRARY}",
        ) from error
    # In its strings these would end the script element, or begin a comment.
    return re.sub("</(script)", r"<\\/\1", text, flags=re.IGNORECASE).replace("<!--", r"<\!--")
