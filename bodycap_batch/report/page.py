"""Combine templates, styles, scripts and the 3D library into one HTML page."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from importlib import metadata
from importlib.resources import files
from pathlib import Path
from typing import Any

from markupsafe import Markup

from bodycap_batch.core.errors import StoreError

LIBRARY = "k3d"
"""Name of the Python package that contains the 3D library.

The package's bundle for browsers includes all of three.js.
"""
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


def render_page(context: Mapping[str, Any], data: Mapping[str, Any]) -> str:
    """Render the page as one HTML document.

    Args:
        context: The value of each template variable, by variable name.
        data: Data of the 3D viewer as JSON values.

    Returns:
        A complete HTML document that loads nothing from the network.

    Raises:
        StoreError: The 3D library's file is missing from its package.
    """
    return render_template(
        "page.html",
        **context,
        script="\n".join(map(_template, _SCRIPTS)),
        library=viewer_library() if context["has_viewer"] else "",
        library_name=f"{LIBRARY} {metadata.version(LIBRARY)}",
        data=json.dumps(data, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"),
    )


def render_template(template: str, /, **context: Any) -> str:
    """Render a page with the style of the report as one HTML document."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FunctionLoader(_template),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"code": _with_code, "clock": _clock_text}
    text = environment.get_template(template).render(**context, style=_template("style.css"))
    return text if text.endswith("\n") else f"{text}\n"


def _template(name: str) -> str:
    return (files("bodycap_batch.report") / "templates" / name).read_text(encoding="utf-8")


def _clock_text(time_s: float) -> str:
    """Return a time as minutes, seconds and tenths: 1:02.5."""
    tenths = round(10 * time_s)
    return f"{'-' if tenths < 0 else ''}{abs(tenths) // 600}:{abs(tenths) % 600 / 10:04.1f}"


def _with_code(text: str) -> Markup:
    """Return a text as HTML; the parts between backquotes become code."""
    parts = re.split("`([^`]*)`", text)
    tags = ("{}", "<code>{}</code>")
    return Markup("").join(Markup(tags[index % 2]).format(part) for index, part in enumerate(parts))  # noqa: S704


def viewer_library() -> str:
    """Return the 3D library's JavaScript, escaped for a script element.

    Raises:
        StoreError: The file is missing from its package.
    """
    path = Path(str(metadata.distribution(LIBRARY).locate_file(_BUNDLE)))
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise StoreError(
            "a file of the 3D library is missing",
            path=path,
            hint=f"install the library again: pip install --force-reinstall {LIBRARY}",
        ) from error
    # These character sequences in the library's strings would end the script element or start a comment.
    return re.sub("</(script)", r"<\\/\1", text, flags=re.IGNORECASE).replace("<!--", r"<\!--")
