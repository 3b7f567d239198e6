"""Import Open3D without its Plotly drawing functions, which take most of the import time.

``import open3d`` imports the packages dash and plotly for the module ``open3d.visualization.draw_plotly``.
These packages take three quarters of the import time, and this project does not use them. Open3D has no
option to skip them. Therefore `load_open3d` puts a placeholder for ``draw_plotly`` into ``sys.modules``
before the import. This is a monkeypatch of a third-party package. No other module of this project does this.
If a drawing function is called nevertheless, the placeholder imports the real module. Therefore all functions
of Open3D still work.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from types import ModuleType
from typing import Any

_PLOTLY_MODULE = "open3d.visualization.draw_plotly"
"""Name of the module that the placeholder replaces."""


class _LazyModule(ModuleType):
    """A placeholder for a module. A call of any of its functions imports the real module."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):
            raise AttributeError(name)

        def call(*arguments: Any, **named: Any) -> Any:
            if isinstance(sys.modules.get(self.__name__), _LazyModule):
                del sys.modules[self.__name__]
            return getattr(import_module(self.__name__), name)(*arguments, **named)

        return call


def load_open3d() -> Any:
    """Import and return Open3D. The module `_PLOTLY_MODULE` is replaced by a placeholder.

    If Open3D is already imported, it is returned unchanged.
    """
    if "open3d" not in sys.modules:
        sys.modules[_PLOTLY_MODULE] = _LazyModule(_PLOTLY_MODULE)
    return import_module("open3d")
