"""`bodycap synth`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from bodycap_batch.cli.application import app
from bodycap_batch.cli.progress_display import command_context
from bodycap_batch.cli.shared_options import JsonProgressOption, ThreadsOption, parse_size
from bodycap_batch.cli.terminal import print_line
from bodycap_batch.core.context import cores
from bodycap_batch.core.errors import JobError


@app.command()
def synth(  # noqa: PLR0913, PLR0917 - the flags a user types
    out: Annotated[
        Path, typer.Argument(metavar="DIR", help="A new folder for the videos and the true motion.")
    ],
    seconds: Annotated[float | None, typer.Option(help="Duration of each video (default: 12).")] = None,
    cameras: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Mount names of the cameras, separated by commas (default: torso,left_palm,right_palm).",
        ),
    ] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Image size in pixels (default: 640x480).")
    ] = None,
    fps: Annotated[float | None, typer.Option(help="Frames per second (default: 30).")] = None,
    seed: Annotated[
        int | None,
        typer.Option(help="Seed of the random numbers for the body, the walk and the room (default: 0)."),
    ] = None,
    motion: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.bvh", help="BVH file with the motion to use instead of the built-in walk."
        ),
    ] = None,
    poses: Annotated[
        bool, typer.Option("--poses", help="Write only camera poses with noise, and no videos.")
    ] = False,
    more: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Set another option of the synthetic capture, with a YAML value. You can repeat this "
            "option.",
        ),
    ] = None,
    threads: ThreadsOption = None,
    json_progress: JsonProgressOption = False,
) -> None:
    """Render a sample capture, for which the true motion is known.

    A person with body cameras walks through a textured room. The command writes <camera>.mp4, calib.json, and
    the truth in gt/ (camera paths, joints, skeleton, motion).

    \b
    Examples:
      bodycap synth my_test/ --seconds 10
      bodycap synth hard/ --set exposure_s=0.02 --set rolling_shutter_s=0.02 --set body_in_view=true
      bodycap synth hidden/ --set body_in_view=true --set "pressed_s={left_palm: [2, 4]}"
      bodycap synth cloth/ --set body_in_view=true --set clothes=patterned --set hands_inward_deg=80
      bodycap synth paint/ --set texture=0.1 --set auto_exposure=0.8 --set bit_rate_mbps=2
      bodycap synth equal/ --set room=two_rooms
      bodycap synth table/ --set body_in_view=true --set still=true --set "carried_s={left: [2, 6]}"
      bodycap synth apart/ --set clocks=free --set sound=on
      bodycap synth inertial/ --set imu=true
      bodycap synth steps/ --poses --set walk=gait --seconds 30
      bodycap synth other/ --motion walk.bvh --cameras torso,head --size 960x540
    """  # noqa: D301 - \b keeps lines as they are
    from bodycap_batch.synthetic import synthesise

    values: dict[str, Any] = {"seconds": seconds, "fps": fps, "seed": seed, "motion": motion}
    values["cameras"] = cameras.split(",") if cameras else None
    values["poses_only"] = poses or None
    if size is not None:
        hint = "give width x height in pixels, for example 640x480"
        values["width"], values["height"] = parse_size(size, "--size", "an image size", hint)
    options = _synth_options({**values, **_parse_settings(more or [])})
    with command_context("synth", as_json=json_progress, threads=threads or cores()) as context:
        synthesise(options, out, context)
    if not json_progress:
        print_line(f"capture: {out.resolve()}")


def _parse_settings(settings: list[str]) -> dict[str, Any]:
    import yaml

    found: dict[str, Any] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals:
            raise JobError(
                f"{setting!r} does not have the form KEY=VALUE",
                field="--set",
                hint="write KEY=VALUE, for example --set noise=4",
            )
        try:
            found[key.strip()] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            hint = "give a number, a word, or a list in brackets"
            raise JobError(f"{value!r} is not a YAML value", field=f"--set {key}", hint=hint) from error
    return found


def _synth_options(values: Mapping[str, Any]) -> Any:
    from pydantic import ValidationError

    from bodycap_batch.config.explain import job_error, problems_of
    from bodycap_batch.synthetic import SynthOptions

    given = {key: value for key, value in values.items() if value is not None}
    try:
        return SynthOptions.model_validate(given)
    except ValidationError as error:
        problems = problems_of(error, SynthOptions, given, hint="`bodycap synth --help` shows examples")
        raise job_error(problems) from error
