"""Who may import whom, and how large code may grow: checked on the syntax tree, nothing is imported."""

from __future__ import annotations

import ast
import graphlib
import statistics
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "bodycap_batch"

# A room is a module or package directly below bodycap_batch. Each may import the rooms named and no other.
GROUND = {"errors", "arrays", "context", "geometry", "memory", "shares"}
TYPES = GROUND | {"camera", "scene", "skeleton", "body"}
MATERIAL = TYPES | {
    "capture", "config", "formats", "skeleton_presets", "tracking", "rolling_shutter", "overlay", "rig",
}  # fmt: skip
STAGES = {
    "keyframes", "mapping", "registration", "merging", "export", "report", "evaluate", "synthetic", "check",
    "calibration", "preview",
}  # fmt: skip
KEEPING = {"errors", "digests", "identity", "progress", "disk_room"}
MAY_IMPORT: dict[str, set[str]] = {
    "errors": set(),
    "arrays": set(),
    "memory": set(),
    "shares": set(),
    "context": {"errors"},
    "geometry": {"errors", "arrays"},
    "camera": GROUND,
    "scene": GROUND | {"camera"},
    "skeleton": GROUND,
    "body": GROUND | {"camera", "scene", "skeleton"},
    "skeleton_presets": GROUND | {"skeleton"},
    "tracking": GROUND | {"camera"},
    "rolling_shutter": GROUND | {"camera", "scene"},
    "rig": GROUND | {"camera", "scene"},
    "overlay": TYPES | {"skeleton_presets"},
    "formats": TYPES,
    "config": TYPES | {"formats", "skeleton_presets"},
    "capture": TYPES | {"config", "formats"},
    **dict.fromkeys(STAGES, MATERIAL),
    "check": MATERIAL | {"disk_room"},
    "digests": {"errors"},
    "progress": {"errors"},
    "identity": set(),
    "disk_room": {"errors"},
    "presets": set(),
    "store": KEEPING,
    "references": KEEPING | {"store"},
    "tasks": MATERIAL | STAGES | KEEPING | {"store"},
    "runner": KEEPING | {"context", "memory", "store", "tasks"},
    "cluster": KEEPING | {"context", "store", "runner"},
    "pipeline": MATERIAL | STAGES | KEEPING | {"store", "references", "tasks", "runner"},
    "watch": MATERIAL | KEEPING | {"store", "references", "runner", "cluster", "pipeline"},
    "cli": MATERIAL
    | STAGES
    | KEEPING
    | {"store", "references", "tasks", "runner", "cluster", "pipeline", "watch"},
}
# Libraries that only these rooms may import.
LIBRARY_ROOMS = {
    "gtsam": {"merging"},
    "gtsam_unstable": set(),
    "distributed": {"cluster"},
    "dask": {"cluster"},
}
MAPPER = {
    "incremental_mapping", "global_mapping", "hierarchical_mapping", "IncrementalMapper",
    "IncrementalMapperOptions", "IncrementalPipeline", "IncrementalPipelineOptions", "GlobalMapper",
    "GlobalPipelineOptions",
}  # fmt: skip
MAY_CATCH_ALL = {"cli", "runner", "watch"}

MAX_FILE_LINES, MEDIAN_FILE_LINES = 400, 150
MAX_FUNCTION_LINES, MEDIAN_FUNCTION_LINES = 70, 12
MAX_PARAMETERS = 6


@dataclass(frozen=True)
class Module:
    """One source file of the package."""

    name: str
    room: str
    tree: ast.Module
    lines: int

    def __str__(self) -> str:
        return self.name


def _read(path: Path) -> Module:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    text = path.read_text(encoding="utf-8")
    name = ".".join(("bodycap_batch", *(part for part in parts if part != "__init__")))
    return Module(name, parts[0], ast.parse(text, str(path)), len(text.splitlines()))


MODULES = [_read(path) for path in sorted(PACKAGE.rglob("*.py"))]
each_module = pytest.mark.parametrize("module", MODULES, ids=str)


def imports(module: Module) -> Iterator[tuple[int, str]]:
    """Yield the line and dotted name of everything imported, inside functions too."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}:{node.lineno}: imports are absolute here"
            source = node.module or ""
            # Both `from bodycap_batch import store` and `from bodycap_batch.store import Store` name a package.
            yield from ((node.lineno, f"{source}.{alias.name}") for alias in node.names)


def functions(module: Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(module.tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def length(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    return (function.end_lineno or function.lineno) - function.lineno + 1


def is_command(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """A console command: its parameters are the flags a user types."""
    calls = (node.func if isinstance(node, ast.Call) else node for node in function.decorator_list)
    return any(isinstance(call, ast.Attribute) and call.attr in {"command", "callback"} for call in calls)


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    arguments = function.args
    named = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    return sum(argument.arg not in {"self", "cls"} for argument in named)


def catches_all(handler: ast.ExceptHandler) -> bool:
    if handler.type is None:
        return True
    names = {node.id for node in ast.walk(handler.type) if isinstance(node, ast.Name)}
    return bool(names & {"Exception", "BaseException"})


def test_the_table_itself_has_no_cycle() -> None:
    tuple(graphlib.TopologicalSorter(MAY_IMPORT).static_order())


@each_module
def test_imports_only_the_rooms_it_may(module: Module) -> None:
    if module.name == "bodycap_batch":
        assert not [name for _, name in imports(module) if name.startswith("bodycap_batch")]
        return
    assert module.room in MAY_IMPORT, f"give the new room {module.room!r} its place in MAY_IMPORT"
    allowed = MAY_IMPORT[module.room] | {module.room}
    wrong = [
        f"line {line}: {name}"
        for line, name in imports(module)
        if name.startswith("bodycap_batch.")
        and (room := name.split(".")[1]) not in allowed
        and room in MAY_IMPORT
    ]
    assert not wrong, f"{module} may import {sorted(allowed)}"


@each_module
def test_libraries_stay_in_their_rooms(module: Module) -> None:
    wrong = [
        f"line {line}: {name}"
        for line, name in imports(module)
        if module.room not in LIBRARY_ROOMS.get(name.split(".")[0], {module.room})
    ]
    assert not wrong


@each_module
def test_only_mapping_runs_the_mapper(module: Module) -> None:
    if module.room == "mapping":
        return
    used = {node.attr for node in ast.walk(module.tree) if isinstance(node, ast.Attribute)}
    used |= {name.rsplit(".", 1)[-1] for _, name in imports(module)}
    assert not used & MAPPER


@each_module
def test_functions_keep_their_budget(module: Module) -> None:
    long = [f"{f.name}: {length(f)} lines" for f in functions(module) if length(f) > MAX_FUNCTION_LINES]
    wide = [
        f"{f.name}: {parameters(f)} parameters"
        for f in functions(module)
        if parameters(f) > MAX_PARAMETERS and not is_command(f)
    ]
    assert not long + wide


def test_files_keep_their_budget() -> None:
    assert not [f"{m}: {m.lines} lines" for m in MODULES if m.lines > MAX_FILE_LINES]


def test_the_typical_file_and_function_are_small() -> None:
    assert statistics.median(module.lines for module in MODULES) <= MEDIAN_FILE_LINES
    assert statistics.median(length(f) for m in MODULES for f in functions(m)) <= MEDIAN_FUNCTION_LINES


def test_everything_is_caught_in_one_place_a_process() -> None:
    handlers = [
        (module, node.lineno)
        for module in MODULES
        for node in ast.walk(module.tree)
        if isinstance(node, ast.ExceptHandler) and catches_all(node)
    ]
    assert not [f"{module}:{line}" for module, line in handlers if module.room not in MAY_CATCH_ALL]
    several = Counter(module.room for module, _ in handlers)
    assert not [f"{room}: {count} broad excepts" for room, count in several.items() if count > 1], handlers
