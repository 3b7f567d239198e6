"""Options of earlier versions that have no effect any more.

Job files, and the ``job.yaml`` of earlier results, may still state them.
"""

from __future__ import annotations

from dataclasses import replace

from bodycap_batch.config.yaml_source import YamlSource

RETIRED_OPTIONS = {
    "registration": ("wearer_mask",),
    "telemetry": ("search", "blur", "clocks"),
}
"""Names of the options that have no effect any more, by the name of their block."""


def without_retired_options(source: YamlSource | None) -> tuple[YamlSource | None, tuple[str, ...]]:
    """Return a job file without the options that have no effect any more, and a note about each of them.

    Args:
        source: The parsed job file; None for a folder of videos.
    """
    if source is None or not isinstance(source.data, dict):
        return source, ()
    data, notes = dict(source.data), list[str]()
    for block, names in RETIRED_OPTIONS.items():
        stated = data.get(block)
        if not isinstance(stated, dict):
            continue
        notes += [
            f"the option {block}.{name} has no effect any more; you can remove it from the job file"
            for name in names
            if name in stated
        ]
        data[block] = {key: value for key, value in stated.items() if key not in names}
    return replace(source, data=data), tuple(notes)
