"""Open3D as we need it: without the drawing in web pages, which takes most of the time it loads."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from types import ModuleType
from typing import Any

# `import open3d` loads dash and plotly for these functions: three quarters of the time, nothing we use.
_PLOTLY_MODULE = "open3d.visualization.draw_plotly"


class _LazyModule(ModuleType):
    """Stands for a module; a function taken from it loads the module at its first call."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):
            raise AttributeError(name)

        def call(*arguments: Any, **named: Any) -> Any:
            if isinstance(sys.modules.get(self.__name__), _LazyModule):
                del sys.modules[self.__name__]
            return getattr(import_module(self.__name__), name)(*arguments, **named)

        return call


def load_open3d() -> Any:
    """Import Open3D; its `draw_plotly` functions load what they need when they are called."""
    if "open3d" not in sys.modules:
        sys.modules[_PLOTLY_MODULE] = _LazyModule(_PLOTLY_MODULE)
    return import_module("open3d")
