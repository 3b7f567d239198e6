"""Which package may import which, and which may use a library: read from the syntax tree."""

from __future__ import annotations

import ast
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "bodycap_batch"

LAYERS = (
    {"core", "presets"},
    {"model", "store"},
    {"formats", "overlay", "runner"},
    {"config", "results"},
    {"capture"},
    {"telemetry"},
    {"inertial", "tracks"},
    {
        "keyframes", "mapping", "registration", "merging", "export", "report", "preview", "evaluate",
        "synthetic", "check", "calibration", "clocks", "camera_places", "fill",
    },
    {"tasks"},
    {"pipeline"},
    {"watch", "job_places"},
    {"api"},
    {"cli"},
)  # fmt: skip
"""A module or package directly below bodycap_batch imports only those of layers before its own."""

SUBLAYERS: dict[str, Sequence[set[str]]] = {
    "mapping": (
        {"camera_intrinsics"},
        {"matching"},
        {"reconstruction"},
        {"intrinsics", "mapping_context"},
        {"re_registration"},
        {"validation", "initial_models"},
        {"inputs"},
        {"results"},
        {"build", "empty_map", "extend", "further_maps", "refine"},
    ),
    "registration": ({"tracking"}, {"poses"}, {"recovery"}, {"stage"}, {"further_maps"}),
    "fill": (
        {"leg_geometry", "trunk_signals"},
        {"contacts", "head"},
        {"foot_places", "standing_height", "pelvis", "foot_paths"},
        {"leg_poses", "lying"},
        {"stage"},
    ),
    "merging": (
        {"cameras", "projection"},
        {"body"},
        {"graph"},
        {"world"},
        {"body_calibration"},
        {"map_alignment", "reporting"},
        {"main_map", "camera_paths", "rig_priors", "unfit_camera"},
        {"stage"},
    ),
}
"""The same inside a stage."""

LIBRARIES = {
    "gtsam": {"merging"},
    "gtsam_unstable": set[str](),
    "distributed": {"runner"},
    "dask": {"runner"},
}
"""Libraries that only these packages may import."""
MAPPER = {
    "incremental_mapping", "global_mapping", "hierarchical_mapping", "IncrementalMapper",
    "IncrementalMapperOptions", "IncrementalPipeline", "IncrementalPipelineOptions", "GlobalMapper",
    "GlobalPipelineOptions",
}  # fmt: skip
MAY_CATCH_ALL = {"cli", "runner", "watch"}


@dataclass(frozen=True)
class Module:
    """One source file: its dotted name below the package, and its syntax tree."""

    name: str
    tree: ast.Module

    @property
    def parts(self) -> list[str]:
        return self.name.split(".")

    def __str__(self) -> str:
        return self.name or "bodycap_batch"


def _read(path: Path) -> Module:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    name = ".".join(part for part in parts if part != "__init__")
    return Module(name, ast.parse(path.read_text(encoding="utf-8"), str(path)))


MODULES = [_read(path) for path in sorted(PACKAGE.rglob("*.py"))]
NAMES = {module.name for module in MODULES}
each_module = pytest.mark.parametrize("module", MODULES, ids=str)


def imports(module: Module) -> Iterator[tuple[int, str]]:
    """Yield the line and dotted name of everything imported, inside functions too."""
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}:{node.lineno}: imports are absolute here"
            source = node.module or ""
            yield from ((node.lineno, f"{source}.{alias.name}") for alias in node.names)


def own_imports(module: Module) -> Iterator[tuple[int, str]]:
    """Yield the line and the module of this package for each import of one."""
    for line, name in imports(module):
        parts = name.split(".")
        if parts[0] == "bodycap_batch":
            yield (
                line,
                max(
                    ".".join(parts[1:end])
                    for end in range(1, len(parts) + 1)
                    if ".".join(parts[1:end]) in NAMES
                ),
            )


def layer_of(name: str, layers: Sequence[set[str]]) -> int:
    """Number of the layer that a name stands in."""
    found = [number for number, layer in enumerate(layers) if name in layer]
    assert len(found) == 1, f"give {name!r} its place among the layers"
    return found[0]


def upward(module: Module, depth: int, layers: Sequence[set[str]]) -> list[str]:
    """Imports of a module that do not lead to a lower layer, at this depth below the package."""
    own = module.parts[depth]
    wrong = []
    for line, name in own_imports(module):
        parts = name.split(".")
        if parts[:depth] != module.parts[:depth] or len(parts) <= depth or parts[depth] in ("", own):
            continue
        if layer_of(parts[depth], layers) >= layer_of(own, layers):
            wrong.append(f"line {line}: {name}")
    return wrong


def catches_all(handler: ast.ExceptHandler) -> bool:
    if handler.type is None:
        return True
    names = {node.id for node in ast.walk(handler.type) if isinstance(node, ast.Name)}
    return bool(names & {"Exception", "BaseException"})


@each_module
def test_imports_lead_to_lower_layers(module: Module) -> None:
    if not module.name:
        assert {name for _, name in own_imports(module)} == {"api"}  # for type checkers alone
        return
    assert not upward(module, 0, LAYERS)


@pytest.mark.parametrize(
    "module", [m for m in MODULES if len(m.parts) > 1 and m.parts[0] in SUBLAYERS], ids=str
)
def test_imports_inside_a_stage_lead_to_lower_layers(module: Module) -> None:
    assert not upward(module, 1, SUBLAYERS[module.parts[0]])


def test_the_layers_name_what_there_is() -> None:
    assert set().union(*LAYERS) == {module.parts[0] for module in MODULES if module.name}
    for stage, layers in SUBLAYERS.items():
        inside = {module.parts[1] for module in MODULES if module.parts[0] == stage and len(module.parts) > 1}
        assert set().union(*layers) == inside


@each_module
def test_libraries_stay_in_their_packages(module: Module) -> None:
    own = module.parts[0]
    assert not [
        f"line {line}: {name}"
        for line, name in imports(module)
        if own not in LIBRARIES.get(name.split(".")[0], {own})
    ]


@each_module
def test_only_mapping_runs_the_mapper(module: Module) -> None:
    if module.parts[0] == "mapping":
        return
    used = {node.attr for node in ast.walk(module.tree) if isinstance(node, ast.Attribute)}
    used |= {name.rsplit(".", 1)[-1] for _, name in imports(module)}
    assert not used & MAPPER


def test_everything_is_caught_in_one_place_a_process() -> None:
    handlers = [
        (module, node.lineno)
        for module in MODULES
        for node in ast.walk(module.tree)
        if isinstance(node, ast.ExceptHandler) and catches_all(node)
    ]
    assert not [f"{module}:{line}" for module, line in handlers if module.parts[0] not in MAY_CATCH_ALL]
    several = Counter(module.parts[0] for module, _ in handlers)
    assert not [f"{name}: {count} broad excepts" for name, count in several.items() if count > 1], handlers
