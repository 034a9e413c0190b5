"""Writes the description of a network file: what the file says, and what agrees best with the autopilot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ds_driver.networks.backends import NetworkInput
from ds_driver.networks.pilot import DriverError
from ds_driver.networks.user_networks import (
    GUIDE,
    DescribedNetwork,
    DescribedNetworkPilot,
    InputSpec,
    limited_memory,
    runner_of,
)
from ds_sim.installation import ds_command
from ds_studies.network_check.agreement import FOUND, GAIN, Agreement
from ds_studies.network_check.diagnosis import (
    SHARE_TRIED,
    ask_open_loop,
    best_reading,
    changed,
    findings_of,
    flow,
    inputs,
    ranked,
)
from ds_studies.network_check.recording import Recording

SIZES = ((160, 320), (66, 200), (120, 160), (80, 160), (224, 224), (128, 128), (64, 64))
"""Rows and columns tried where the file names none: this camera's, Nvidia's Dave-2's, Donkey Car's, and others."""
QUESTIONS = {"colour": "Colours", "crop": "Part of the image", "subtract": "Scale of the pixels"}
Ask = Callable[[str, list[str], str], str]
"""Asks a person to choose: question, choices and proposed choice."""


def form_of(file: Path) -> list[InputSpec]:
    """Look at a network file: list the inputs that it may take, as far as the file says.

    Raises:
        DriverError: it cannot be loaded, takes no image, or has a description already.
    """
    described = file.with_suffix(".yaml")
    if described.exists():
        raise DriverError(f"{described} describes {file.name} already: `{ds_command('check', described)}` checks it")
    with limited_memory():
        runner = runner_of(file)
    if len(runner.inputs) > 1:
        names = ", ".join(one.name for one in runner.inputs)
        raise DriverError(
            f"{file} has {len(runner.inputs)} inputs ({names}): write {described.name} as {GUIDE} shows, then "
            f"`{ds_command('check', described)}`"
        )
    image = runner.inputs[0] if runner.inputs else NetworkInput()
    shape = image.shape or (None,) * 4
    found = []
    for layout, place in (("nchw", 1), ("nhwc", 3)) if len(shape) == 4 else ():
        rows, columns = (shape[2], shape[3]) if layout == "nchw" else (shape[1], shape[2])
        if shape[place] not in (1, 3, None):
            continue
        for size in SIZES if rows is None or columns is None else ((rows, columns),):
            if (rows, columns) in ((None, None), size):
                colour = "grey" if shape[place] == 1 else "rgb"
                kind = "uint8" if image.type == "uint8" else "float32"
                scaled = {"divide": 255.0} if kind == "float32" else {}
                form = {"size": size, "layout": layout, "colour": colour, "type": kind, **scaled}
                found.append(InputSpec.model_validate(form))
    if not found:
        shown = "x".join("any" if size is None else str(size) for size in shape)
        raise DriverError(f"{file} expects an input of {shown}: expected one image of 1 or 3 channels, 4 numbers")
    return found


def describe(file: Path, forms: Sequence[InputSpec], recordings: Sequence[Recording], ask: Ask | None) -> str:
    """Choose what a file does not say, and return its description with comments that say why.

    Args:
        file: the network.
        forms: inputs that it may take; see `form_of`.
        recordings: drives of the autopilot, by which is chosen.
        ask: asks about what they do not decide; None takes what agrees best.

    Raises:
        DriverError: the network takes none of the inputs.
    """
    pilot = _load(file, forms)
    tried = [one.sample(SHARE_TRIED) for one in recordings]
    chosen, fit = ranked(pilot, recordings)[0]
    comments = {}
    for part, others in inputs(chosen.input).items():
        fits = [(_shown(one), best_reading(pilot.described_as(changed(chosen, one)), tried)[1]) for one in others]
        comments[part] = _why(fits)
        undecided = [name for name, other in fits if other.unexplained * GAIN < fit.unexplained]
        if ask is not None and len(undecided) > 1:
            answer = ask(f"{QUESTIONS[part]}, which the drives do not decide", undecided, undecided[0])
            if answer not in undecided:
                raise DriverError(f"{answer!r} was not offered: expected one of {', '.join(undecided)}")
            chosen = changed(chosen, others[[name for name, _ in fits].index(answer)])
            comments[part] = "as you answered"
    chosen, fit = best_reading(pilot.described_as(chosen), tried)
    answers = np.concatenate(list(ask_open_loop(pilot.described_as(chosen), recordings)[0].values()))
    findings, fixed = findings_of(chosen, chosen, answers, recordings)
    described = fixed or chosen
    steering = described.outputs.steering.model_dump(exclude_defaults=True) or {"output": 0}
    why = "; ".join(one.text for one in findings) or f"it answers as it has to, correlation {fit.correlation:.2f}"
    given = described.input
    lines = [
        f"# Written by ds check for {file.name}: it compared its answers with the autopilot's steering.",
        *([] if abs(fit.correlation) >= FOUND else ["# Nothing agrees well: what is undecided below is a guess."]),
        f"file: {file.name}",
        "input:",
        f"  size: {flow(list(given.size))}  # rows, columns, from the file or the first that it takes",
        f"  layout: {given.layout}",
        f"  type: {given.type}",
        f"  colour: {given.colour}  # {comments['colour']}",
        f"  crop: {flow(given.model_dump()['crop'])}  # {comments['crop']}",
    ]
    if given.type == "float32":
        lines += [f"  subtract: {flow(given.subtract)}  # {comments['subtract']}", f"  divide: {flow(given.divide)}"]
    lines += ["outputs:", f"  steering: {flow(steering)}  # {why}"]
    lines += [f"  # throttle: {{output: {k}}}  # if that is its throttle" for k in _others(pilot, tried, steering)]
    return "\n".join(lines) + "\n"


def _load(file: Path, forms: Sequence[InputSpec]) -> DescribedNetworkPilot:
    problem = None
    for form in forms:
        try:
            return DescribedNetworkPilot(file, described=DescribedNetwork(file=file.name, input=form))
        except DriverError as error:
            problem = problem or error
    raise DriverError(f"{problem}: describe its input in {file.with_suffix('.yaml').name}")


def _shown(values: dict[str, Any]) -> str:
    return flow(values if len(values) > 1 else next(iter(values.values())))


def _why(fits: Sequence[tuple[str, Agreement]]) -> str:
    """Say how well a value agrees, and the best of the others."""
    (_, best), *others = fits
    if not others:
        return "the only one possible"
    name, second = max(others, key=lambda one: abs(one[1].correlation))
    clear = "chosen" if best.unexplained <= GAIN * second.unexplained else "undecided"
    return f"{clear}: correlation {abs(best.correlation):.2f}, with {name} {abs(second.correlation):.2f}"


def _others(pilot: DescribedNetworkPilot, recordings: Sequence[Recording], steering: dict[str, Any]) -> list[int]:
    """Return positions of outputs with one number that are not the steering."""
    outputs = pilot.outputs(recordings[0].frames[0])
    return [k for k, one in enumerate(outputs) if one.size == 1 and k != steering.get("output", 0)]
