# SPDX-License-Identifier: Apache-2.0
"""Writes the description of a network file: what the file says, and what agrees best with the autopilot."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ds_base.bounded_memory import limited_memory
from ds_base.installation import ds_command
from ds_driver.networks.backends import NetworkInput
from ds_driver.networks.described_network import DescribedNetworkPilot, sizes
from ds_driver.networks.description import GUIDE, DescribedNetwork
from ds_driver.networks.network_file import NETWORK_MEMORY, backends_for, runner_of
from ds_driver.networks.pilot import DriverError
from ds_sim.camera.spec import IMAGE_HEIGHT
from ds_studies.network_check.agreement import FOUND, GAIN, Agreement, agreement
from ds_studies.network_check.diagnosis import (
    LIKELY,
    SHARE_TRIED,
    best_reading,
    changed,
    findings_of,
    flow,
    inputs,
    only_offset,
    ranked,
    scale_kind,
    steering_of,
)
from ds_studies.network_check.recording import AutopilotDrives

SIZES = ((160, 320), (66, 200), (120, 160), (80, 160), (224, 224), (128, 128), (64, 64))
"""Rows and columns tried where the file names none: this camera's, Nvidia's Dave-2's, Donkey Car's, and others."""
MOST_STACKED = 16
"""Images that an input with more channels than three is taken for at most."""
OUTPUT_NAMES = {
    "steering": r"steer|angle|^n_outputs0$|^out_0$|partitionedcall(_\d+)?:0$",
    "throttle": r"throttle|gas|^n_outputs1$|^out_1$",
}
"""What an output is -> names that it has, Donkey Car's (maker's `n_outputs0`, TensorFlow Lite's numbers) among them."""
DONKEY_BINS = {"angle_out": (-1.0, 1.0), "throttle_out": (0.0, 0.475)}
"""Centres of the first and the last bin of Donkey Car's `categorical`: 15, and 20 up to a range of 0.5."""
DONKEY_CAR = re.compile(r"img_in|n_outputs\d|^angle_out$")
"""Inputs and outputs that only Donkey Car names so; its pilots see RGB, divided by 255."""
DONKEY_IMAGE = (120, 160)
"""Rows and columns of Donkey Car's image; one with fewer rows lost them at its top (its `ROI_CROP_TOP`)."""
QUESTIONS = {"colour": "Colours", "crop": "Part of the image", "subtract": "Scale of the pixels"}
ORDER = ("crop", "colour", "crop", "colour", "subtract")
"""Parts of the input of a network with memory, as they are chosen: colours look alike on a wrong part of the image."""
NOTHING = Agreement(0.0, 0.0, 0.0, ())
"""Agreement of a network that refuses an input."""
Ask = Callable[[str, list[str], str], str]
"""Asks a person to choose: question, choices and proposed choice."""


def forms_of(file: Path) -> list[DescribedNetwork]:
    """List how a network file may be described, as far as shapes and names of inputs and outputs say.

    `DriverError` if it cannot be loaded, takes no image or several, or has a description already.
    """
    described = file.with_suffix(".yaml")
    if described.exists():
        raise DriverError(f"{described} describes {file.name} already: `{ds_command('check', described)}` checks it")
    with limited_memory(NETWORK_MEMORY):
        runner = runner_of(file, backends_for(file)[-1])
    network_inputs = list(runner.inputs) or [NetworkInput(shape=(None,) * 4)]
    images = {place: forms_of_image for place, one in enumerate(network_inputs) if (forms_of_image := _images(one))}
    if len(images) != 1:
        shown = " and ".join(f"{one.name or 'an input'} of {sizes(one.shape or ())}" for one in network_inputs)
        raise DriverError(
            f"{file} takes {shown}: expected one image of 1 or 3 channels, 4 numbers, or several of them; describe "
            f"other networks in {described.name} as {GUIDE} shows, then `{ds_command('check', described)}`"
        )
    (place, forms_of_image), states = next(iter(images.items())), set()
    described_inputs: dict[int | str, dict[str, Any]] = {}
    for other, one in enumerate(network_inputs):
        if other != place:
            values = _given(one, [name for name in runner.outputs if name not in states])
            states |= {values["state"]} if "state" in values else set()
            described_inputs[one.name or other] = values
    outputs = _named_outputs([one for one in runner.outputs if one not in states])
    if any(values.get("value") == "commands" for values in described_inputs.values()):
        outputs.setdefault("throttle", {"output": next((one for one in runner.outputs if one.endswith(":1")), 1)})
    forms = (
        {"file": file.name, "input": image, "inputs": described_inputs, "outputs": outputs} for image in forms_of_image
    )
    return [DescribedNetwork.model_validate(one) for one in forms]


def _images(network_input: NetworkInput) -> list[dict[str, Any]]:
    """List the images that an input may take; none if it takes no image."""
    shape, images = network_input.shape or (None,) * 4, []
    time = {} if len(shape) != 5 else {"frames": shape[1] or 1, "stacked": "time"}
    shape = shape if len(shape) != 5 else (shape[0], *shape[2:])
    for layout, place in (("nchw", 1), ("nhwc", 3)) if len(shape) == 4 else ():
        rows, columns = (shape[2], shape[3]) if layout == "nchw" else (shape[1], shape[2])
        channels = shape[place] or 3
        stack = channels // 3 if channels % 3 == 0 and not time else 1
        if channels // stack not in (1, 3) or stack > MOST_STACKED:
            continue
        for size in SIZES if rows is None or columns is None else ((rows, columns),):
            if (rows, columns) in ((None, None), size):
                kind = "uint8" if network_input.type == "uint8" else "float32"
                form = {"size": size, "layout": layout, "colour": "grey" if channels == 1 else "rgb", "type": kind}
                scaled: dict[str, Any] = {"divide": 255.0} if kind == "float32" else {}
                if "img_in" in network_input.name and size[0] < DONKEY_IMAGE[0] and size[1] == DONKEY_IMAGE[1]:
                    scaled["crop"] = {"top": round(IMAGE_HEIGHT * (1 - size[0] / DONKEY_IMAGE[0]))}
                images.append({**form, **scaled, **time, **({"frames": stack} if stack > 1 else {})})
    return images


def _given(one: NetworkInput, outputs: Sequence[str]) -> dict[str, Any]:
    """Guess what an input beside the image is, by its name and size; see `GivenInput`."""
    name, size = one.name.lower(), math.prod(n or 1 for n in one.shape or (1,))
    back = [name for name in outputs if one.name and name.lower().strip("_").startswith(one.name.lower())]
    back += [f"{word}{one.name}" for word in ("new_", "next_", "out_") if f"{word}{one.name}" in outputs]
    if back:
        return {"state": back[0]}
    if size == 1 and ("speed" in name or "vel" in name):
        return {"value": "speed"}
    if "mem" in name and size % 2 == 0:  # Donkey Car's `memory`
        return {"value": "commands", "last": size // 2}
    if "behavior" in name:  # Donkey Car's, one of several
        return {"constant": [1.0, *[0.0] * (size - 1)]}
    return {"constant": 0.0}


def _named_outputs(names: Sequence[str]) -> dict[str, Any]:
    """Find steering and throttle by the names of outputs, or by the order in which Keras numbers them for TF Lite."""
    outputs: dict[str, Any] = {}
    for what, pattern in OUTPUT_NAMES.items():
        for name in names:
            if re.search(pattern, name.lower()):
                bins = {"bins": DONKEY_BINS[name]} if name in DONKEY_BINS else {}
                outputs.setdefault(what, {"output": name, **bins})
    return outputs


def describe_network(
    file: Path,
    forms: Sequence[DescribedNetwork],
    recordings: Sequence[AutopilotDrives],
    ask: Ask | None,
    *,
    search: bool = True,
    loaded: DescribedNetworkPilot | None = None,
) -> str:
    """Choose what a file does not say, and return its description with comments that say why.

    The autopilot's drives choose among `forms` of `forms_of`. `ask` asks about what they leave open; None takes the
    convention of the file's maker, or the commonest; without `search`, nothing else is tried.
    """
    pilot = loaded or load(file, forms)
    remembers, comments = pilot.has_memory, {}
    maker = "Donkey Car" if any(map(DONKEY_CAR.search, (*pilot.input_names, *pilot.output_names))) else ""
    # A network with memory is asked about whole drives: few, one part of its input after the other, no combinations.
    tried = [one.first_drives(2) if remembers else one.sample(SHARE_TRIED) for one in recordings]
    agreements: dict[str, Agreement] = {}

    def fitted(one: DescribedNetwork) -> Agreement:
        if not remembers:
            return best_reading(pilot.described_as(one), tried)[1]
        key = one.model_dump_json()
        if key not in agreements:
            with suppress(DriverError):
                agreements[key] = agreement(steering_of(pilot.described_as(one), tried), tried)
        return agreements.setdefault(key, NOTHING)

    chosen = pilot.description
    if not search:
        fit = fitted(chosen)
    elif remembers:
        for part in ORDER:
            tries = [changed(chosen, one) for one in inputs(chosen.input)[part]]
            chosen = max(tries, key=lambda one: round(abs(fitted(one).correlation), 3))
        fit = fitted(chosen)
    else:
        chosen, fit = ranked(pilot, recordings)[0]
    # What the drives do not decide is as the maker of the file has it, or as most have it.
    best, conventions = fit, []
    for part, values in inputs(pilot.description.input).items():
        usual = changed(chosen, values[0])
        if usual != chosen and not _decides(best, fitted(usual), bool(maker)):
            chosen = usual
        if all(getattr(usual.input, key) == getattr(chosen.input, key) for key in values[0]):
            conventions.append(part)
    fit = fitted(chosen)
    for part, others in inputs(chosen.input).items():
        if not search:
            comments[part] = f"not tried, so as in {maker or 'most networks'}"
            continue
        names = [flow(one if len(one) > 1 else next(iter(one.values()))) for one in others]
        fits = [(name, fitted(changed(chosen, one))) for name, one in zip(names, others, strict=True)]
        comments[part] = _why(fits, maker or "most networks" if part in conventions else "")
        undecided = [name for name, other in fits if other.unexplained * GAIN < fit.unexplained]
        if ask is not None and len(undecided) > 1:
            answer = ask(f"{QUESTIONS[part]}, which the drives do not decide", undecided, undecided[0])
            if answer not in undecided:
                raise DriverError(f"{answer!r} was not offered: expected one of {', '.join(undecided)}")
            chosen = changed(chosen, others[names.index(answer)])
            comments[part] = "as you answered"
    if search and not remembers:
        chosen = best_reading(pilot.described_as(chosen), tried)[0]
    answers = steering_of(pilot.described_as(chosen), recordings)
    findings, fixed = findings_of(chosen, chosen, answers, recordings)
    fit = agreement(answers, recordings)
    described = chosen if fixed is None or only_offset(findings) else fixed
    steering = described.outputs.steering.model_dump(exclude_defaults=True) or {"output": 0}
    throttle = described.outputs.throttle
    why = "; ".join(one.text for one in findings) or f"it answers as it has to, correlation {fit.correlation:.2f}"
    image_input = described.input
    lines = [
        f"# Written by ds check for {file.name}: it compared its answers with the autopilot's steering.",
        *([] if abs(fit.correlation) >= FOUND else ["# Nothing agrees well: what is undecided below is a guess."]),
        f"file: {file.name}",
        "input:",
        f"  size: {flow(list(image_input.size))}  # rows, columns, from the file or the first that it takes",
        f"  layout: {image_input.layout}",
        f"  type: {image_input.type}",
        f"  colour: {image_input.colour}  # {comments['colour']}",
        f"  crop: {flow(image_input.model_dump()['crop'])}  # {comments['crop']}",
    ]
    if image_input.type == "float32":
        lines += [
            f"  subtract: {flow(image_input.subtract)}  # {comments['subtract']}",
            f"  divide: {flow(image_input.divide)}",
        ]
    if image_input.frames > 1:
        lines += [
            f"  frames: {image_input.frames}  # if they are {image_input.order}",
            f"  stacked: {image_input.stacked}",
        ]
    if described.inputs:
        lines += ["inputs:  # by their names and sizes: correct what is not so"]
        lines += [f"  {name}: {flow(one.model_dump(exclude_defaults=True))}" for name, one in described.inputs.items()]
    lines += ["outputs:", f"  steering: {flow(steering)}  # {why}"]
    if throttle is not None:
        lines += [f"  throttle: {flow(throttle.model_dump(exclude_defaults=True))}  # by its name"]
    elif not described.inputs:
        lines += [f"  # throttle: {{output: {k}}}  # if that is its throttle" for k in _others(pilot, tried, steering)]
    return "\n".join(lines) + "\n"


def load(file: Path, forms: Sequence[DescribedNetwork]) -> DescribedNetworkPilot:
    """Load a network file by the first of the descriptions that it takes."""
    problem = None
    for form in forms:
        try:
            return DescribedNetworkPilot(file, described=form)
        except DriverError as error:
            problem = problem or error
    raise DriverError(f"{problem}: describe its input in {file.with_suffix('.yaml').name}")


def _decides(best: Agreement, usual: Agreement, maker: bool) -> bool:
    """Whether drives decide against the usual convention, or against a maker's, which takes better evidence."""
    clear, sure = best.beats(usual), best.surely_above(usual)
    if maker:
        return clear and sure
    likelier = LIKELY.index(scale_kind(best.slope)) < LIKELY.index(scale_kind(usual.slope))
    return abs(best.correlation) >= FOUND and (clear or sure or likelier)


def _why(fits: Sequence[tuple[str, Agreement]], convention: str) -> str:
    """Say how well a value agrees, and the best of the others, and whose convention it is."""
    (_, best), *others = fits
    if not others:
        return "the only one possible"
    name, second = max(others, key=lambda one: abs(one[1].correlation))
    clear = "chosen" if best.unexplained <= GAIN * second.unexplained else "undecided"
    if convention and clear == "undecided":
        clear = f"undecided, so as in {convention}"
    return f"{clear}: correlation {abs(best.correlation):.2f}, with {name} {abs(second.correlation):.2f}"


def _others(pilot: DescribedNetworkPilot, recordings: Sequence[AutopilotDrives], steering: dict[str, Any]) -> list[int]:
    """Return positions of outputs with one number that are not the steering."""
    outputs, place = pilot.outputs(recordings[0].frames[0]), steering.get("output", 0)
    place = pilot.output_names.index(place) if isinstance(place, str) else place
    return [k for k, one in enumerate(outputs) if one.size == 1 and k != place]
