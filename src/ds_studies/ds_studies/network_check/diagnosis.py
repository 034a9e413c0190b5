# SPDX-License-Identifier: Apache-2.0
"""Finds out what is wrong with the description of a network, by comparing its answers with the autopilot's steering."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ds_base.progress import SILENT
from ds_base.words import multiple
from ds_driver.control.command_habits import command_habits
from ds_driver.networks.described_network import DescribedNetworkPilot
from ds_driver.networks.description import DescribedNetwork, InputSpec, OutputSpec
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.network_driver import load_pilot
from ds_driver.networks.pilot import Frame, Pilot
from ds_sim.registry import SimulatorName
from ds_studies.network_check.agreement import AGREES, FOUND, Agreement, agreement, readings
from ds_studies.network_check.recording import AutopilotDrives, record, speeds_of_throttle

Kind = Literal[
    "degrees",
    "radians",
    "scale",
    "offset",
    "lane",
    "sign",
    "colour",
    "crop",
    "pixels",
    "output",
    "bins",
    "crawls",
    "constant",
    "saturated",
    "unrelated",
]
FAINTEST = 0.58
"""Slope against the autopilot below which the scale is wrong; chosen: the geometric middle of the weakest shipped
network's, 0.73, and of one that answers in radians up to 25 degrees, 0.46 at most."""
STRONGEST = 1 / FAINTEST
"""Slope from which it is wrong on the other side."""
DEGREES = (10.0, 90.0)
"""Slopes at which an answer is taken to be in degrees; chosen: full lock of any car, with an error of a half."""
RADIANS = (0.2, FAINTEST)
"""Slopes at which an answer is taken to be in radians; chosen: full lock from 12 degrees, as above."""
OFF_CENTRE = 0.2
"""Steering while the autopilot drives straight on from which there is an offset; chosen: ten times a good network's."""
ELSEWHERE = 0.5
"""Part of an offset that may remain in the lane that a network wants; chosen: it is nearer to none than to all."""
SHARE_TRIED = 4
"""One image of so many is shown to other descriptions, about 30 for each simulator."""
SHARE_SCREENED = 3
"""One of so many of these is, where all combinations are tried."""
ASKED = {"file": 20, "description": 10, "other": 1}
"""What is checked -> times that a network is asked about each image, other descriptions included, at most."""
LIKELY: tuple[Kind | None, ...] = (None, "degrees", "radians", "scale")
"""What a network answers in, see `scale_kind`, the likeliest first."""
FINALISTS = 4
"""Combinations that are shown the former again."""
PIXELS: tuple[tuple[Any, Any], ...] = (
    (0.0, 255.0),
    (127.5, 127.5),
    (0.0, 1.0),
    ([123.675, 116.28, 103.53], [58.395, 57.12, 57.375]),
)
"""What is subtracted from a pixel and what it is divided by, tried: 0 to 1, -1 to 1, 0 to 255, and ImageNet's."""
CROPS: tuple[Any, ...] = ("simulator", "none", {"top": 60, "bottom": 25}, {"top": 60, "bottom": 0}, {"top": 80})
"""Crops tried: the paper's, none, Udacity's on images of this size, and the lower half and a little more."""
INPUT_KINDS: dict[str, tuple[Kind, str]] = {
    "colour": ("colour", "Its colours are in another order"),
    "crop": ("crop", "It expects another part of the image"),
    "subtract": ("pixels", "Its pixels are scaled otherwise"),
}


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, a sentence with the numbers that show it, and the line of YAML that fixes it, or ""."""

    kind: Kind
    text: str
    line: str = ""

    def __str__(self) -> str:
        return f"{self.text}: write `{self.line}`" if self.line else self.text


@dataclass(frozen=True)
class AnswerStatistics:
    """Answers of the network on one simulator, as described."""

    simulator: SimulatorName
    correlation: float
    slope: float
    lowest: float
    highest: float
    at_full_lock: float
    milliseconds: float


@dataclass(frozen=True, kw_only=True)
class NetworkCheck:
    """What was found out about a network."""

    driver: DriverName
    images: int
    correlation: float  # of its steering with the autopilot's
    answers: Sequence[AnswerStatistics]
    findings: Sequence[Finding]  # what is wrong
    steering: dict[SimulatorName, NDArray[np.float64]]  # simulator -> its answers to all images
    # The description with every line applied; None without a description, or without a line.
    fixed: DescribedNetwork | None

    @property
    def verdict(self) -> str:
        """One line."""
        if any(one.kind == "unrelated" for one in self.findings):
            reading = f"correlation {self.correlation:.2f} with the autopilot, below {FOUND:g}"
            return f"{self.driver} is not connected, or was trained on another world: {reading}."
        if self.findings:
            return f"{self.driver} is not connected correctly."
        weak = [one.simulator for one in self.answers if one.correlation < FOUND]
        but = f", but does not answer with the road on {', '.join(weak)}" if weak else ""
        return f"{self.driver} is connected correctly{but}: correlation {self.correlation:.2f} with the autopilot."

    def document(self) -> dict[str, Any]:
        """Convert to JSON values."""
        return {
            "driver": str(self.driver),
            "connected_rightly": not self.findings and self.correlation >= FOUND,
            "verdict": self.verdict,
            "images": self.images,
            "correlation": self.correlation,
            "simulators": [asdict(one) for one in self.answers],
            "findings": [asdict(one) for one in self.findings],
        }


def check_network(
    driver: DriverName,
    recordings: Sequence[AutopilotDrives],
    seed: int,
    *,
    search: bool = True,
    loaded: DescribedNetworkPilot | None = None,
) -> NetworkCheck:
    """Ask a network about recorded images, and diagnose how it is connected; `DriverError` if it gives no valid answer.

    With `search`, other descriptions are tried, which takes many more images, and its throttle, on a road of this seed.
    `loaded` is the same network file, which remembers its answers.
    """
    pilot = best_pilot = load_pilot(driver)
    if loaded is not None and isinstance(pilot, DescribedNetworkPilot):
        pilot = best_pilot = loaded.described_as(pilot.description)
    steering, throttle, milliseconds = ask_open_loop(pilot, recordings)
    answers = best_answers = np.concatenate(list(steering.values()))
    described = best = pilot.description if isinstance(pilot, DescribedNetworkPilot) else None
    # Single images say nothing about a network with memory.
    if search and isinstance(pilot, DescribedNetworkPilot) and not pilot.has_memory:
        best = best_description(pilot, recordings)
        if best != described:
            best_pilot = pilot.described_as(best)
            best_answers = steering_of(best_pilot, recordings)
    whole = agreement(answers, recordings)
    findings, fixed = findings_of(described, best, best_answers, recordings, abs(whole.correlation))
    kinds, offset = [one.kind for one in findings], agreement(best_answers, recordings).offset
    if search and offset < 0.0 and only_offset(findings):
        other = record([one.simulator for one in recordings], seed, SILENT, whole=pilot.has_memory, lane="left")
        if lane := lane_finding(offset, steering_of(best_pilot, other), other, driver):
            findings[kinds.index("offset")], fixed = lane, None
    if search and throttle is not None and (crawling := _crawling(pilot, throttle, recordings, seed, described)):
        findings.append(crawling[0])
        if fixed is not None:
            outputs = fixed.outputs.model_copy(update={"throttle": crawling[1]})
            fixed = fixed.model_copy(update={"outputs": outputs})
    rows = []
    for one in recordings:
        here, part = steering[one.simulator], agreement(steering[one.simulator], [one])
        ends = float(here.min()), float(here.max()), float(np.mean(np.abs(here) >= 1.0))
        fit = part.correlation, part.slope
        rows.append(AnswerStatistics(one.simulator, *fit, *ends, milliseconds[one.simulator]))
    return NetworkCheck(
        driver=driver,
        images=len(answers),
        correlation=whole.correlation,
        answers=rows,
        findings=findings,
        steering=steering,
        fixed=fixed if findings else None,
    )


def pace_of(pilot: Pilot, frame: Frame) -> float:
    """Measure how long a network, which has seen an image before, takes for one, s."""
    pilot.start()
    began = time.monotonic()
    pilot.predict(frame)
    return time.monotonic() - began


def ask_open_loop(
    pilot: Pilot, recordings: Sequence[AutopilotDrives]
) -> tuple[dict[SimulatorName, NDArray[np.float64]], NDArray[np.float64] | None, dict[SimulatorName, float]]:
    """Return unclipped steering by simulator, all throttles, and ms of processor time per image by simulator."""
    steering, throttle, milliseconds = {}, [], {}
    for one in recordings:
        began = time.process_time()
        answers = []
        before = np.inf
        for frame in one.frames:
            if frame.step <= before:
                pilot.start()
            before = frame.step
            answers.append(pilot.predict(frame))
        milliseconds[one.simulator] = 1e3 * (time.process_time() - began) / len(one.frames)
        steering[one.simulator] = np.array([each.steering for each in answers])
        throttle += [each.throttle for each in answers if each.throttle is not None]
    return steering, np.array(throttle) if throttle else None, milliseconds


def steering_of(pilot: Pilot, recordings: Sequence[AutopilotDrives]) -> NDArray[np.float64]:
    """(images,) unclipped steering for all images in their order."""
    return np.concatenate(list(ask_open_loop(pilot, recordings)[0].values()))


Fitted = tuple[DescribedNetwork, Agreement]
"""A description, and how well the network agrees with the autopilot under it."""


def best_description(pilot: DescribedNetworkPilot, recordings: Sequence[AutopilotDrives]) -> DescribedNetwork:
    """Return the description under which a network agrees best with the autopilot, whatever sign, scale and offset.

    Parts of the input whose change does not matter stay as described; colours, too, unless it is beyond chance.
    """
    tried = [one.sample(SHARE_TRIED) for one in recordings]
    best = current = ranked(pilot, recordings)[0]
    for part, values in inputs(pilot.description.input).items():
        restored = best_reading(pilot.described_as(changed(current[0], values[0])), tried)
        decided = part != "colour" or best[1].surely_above(restored[1])
        current = current if decided and _matters(best[1], restored[1]) else restored
    return current[0]


def _matters(best: Agreement, restored: Agreement) -> bool:
    """Whether a change helps the agreement, or makes a scale right, and spoils none; see `Agreement.beats`.

    A network without bounds answers 255 times as much to pixels of 255, and correlates all the same.
    """
    wrong, was_wrong = scale_kind(best.slope), scale_kind(restored.slope)
    if wrong and not was_wrong and abs(restored.correlation) >= FOUND:
        return False
    rescaled = wrong is None and was_wrong == "scale" and not restored.beats(best)
    return best.beats(restored) or (rescaled and abs(best.correlation) >= AGREES)


def scale_kind(slope: float) -> Kind | None:
    """Return in what a network answers, by its slope against the autopilot, without sign; None if as it should."""
    size = abs(slope)
    if FAINTEST <= size <= STRONGEST:
        return None
    if DEGREES[0] <= size <= DEGREES[1]:
        return "degrees"
    return "radians" if RADIANS[0] <= size <= RADIANS[1] else "scale"


def ranked(pilot: DescribedNetworkPilot, recordings: Sequence[AutopilotDrives]) -> list[Fitted]:
    """Try all combinations of the parts of the input; return the `FINALISTS`, the best first."""
    tried = [one.sample(SHARE_TRIED) for one in recordings]
    few = [one.sample(SHARE_SCREENED) for one in tried]
    candidates = [pilot.description]
    for values in inputs(pilot.description.input).values():
        candidates = [changed(one, value) for one in candidates for value in values]
    for images in (few, tried):
        fits = [best_reading(pilot.described_as(one), images) for one in candidates]
        # Of equal ones, that with the likeliest scale comes first, and then the first.
        fits.sort(key=lambda one: (-round(abs(one[1].correlation), 3), LIKELY.index(scale_kind(one[1].slope))))
        candidates = [one for one, _ in fits[:FINALISTS]]
    return fits


def best_reading(pilot: DescribedNetworkPilot, recordings: Sequence[AutopilotDrives]) -> Fitted:
    """Return the description with the number among the outputs that agrees best; the described one unless beaten."""
    rated = [(spec, agreement(answers, recordings)) for spec, answers in readings(pilot, recordings)]
    nothing = Agreement(0.0, 0.0, 0.0, (0.0,) * len(recordings))
    if not rated:
        return pilot.description, nothing
    described, *others = rated
    better = [one for one in others if one[1].beats(described[1])]
    spec, fit = max(better, key=lambda one: abs(one[1].correlation)) if better else described
    return with_steering(pilot.description, spec), fit


def with_steering(network: DescribedNetwork, spec: OutputSpec) -> DescribedNetwork:
    """Return a description with another steering."""
    return network.model_copy(update={"outputs": network.outputs.model_copy(update={"steering": spec})})


def inputs(spec: InputSpec) -> dict[str, list[dict[str, Any]]]:
    """List what can be unknown about an input of known shape: the values of each part, the given one first."""
    colours = ("grey",) if spec.colour == "grey" else ("rgb", "bgr", "yuv")
    pixels = PIXELS if spec.type == "float32" else ()
    if spec.colour == "grey":
        pixels = tuple(one for one in pixels if isinstance(one[0], float))
    parts: dict[str, list[dict[str, Any]]] = {
        "colour": [{"colour": one} for one in colours],
        "crop": [{"crop": one} for one in CROPS],
        "subtract": [{"subtract": one, "divide": other} for one, other in pixels],
    }
    raw = spec.model_dump()
    for part, values in parts.items():
        mine = {key: raw[key] for key in (("subtract", "divide") if part == "subtract" else (part,))}
        parts[part] = [mine, *(one for one in values if with_input(spec, one) != spec)]
    return parts


def with_input(spec: InputSpec, values: dict[str, Any]) -> InputSpec:
    """Return an input with some keys changed."""
    return InputSpec.model_validate({**spec.model_dump(), **values})


def changed(network: DescribedNetwork, values: dict[str, Any]) -> DescribedNetwork:
    """Return a description with some keys of its input changed."""
    return network.model_copy(update={"input": with_input(network.input, values)})


def findings_of(
    described: DescribedNetwork | None,
    best: DescribedNetwork | None,
    answers: NDArray[np.float64],
    recordings: Sequence[AutopilotDrives],
    before: float = 0.0,
) -> tuple[list[Finding], DescribedNetwork | None]:
    """Say what is wrong: how the best description differs, then scale, sign and offset of its answers to all images.

    `before` is the correlation under the given description.
    """
    fit = agreement(answers, recordings)
    habits = command_habits(np.clip(answers, -1.0, 1.0), np.full(len(answers), np.inf))
    kinds = {habit.kind: habit.text for habit in habits}
    if np.ptp(answers) == 0.0 or ("constant" in kinds and abs(fit.correlation) < AGREES and "saturated" not in kinds):
        return [
            Finding("constant", f"It answers {answers[0]:.3g} to every image: train it again, or look at its file")
        ], best
    if abs(fit.correlation) < FOUND and any(abs(one) < FOUND for one in fit.by_simulator):
        agreeing = [one.simulator for one, its in zip(recordings, fit.by_simulator, strict=True) if abs(its) >= FOUND]
        return [_unrelated(fit, agreeing, described is not None)], best
    findings: list[Finding] = []
    steering, agree = OutputSpec(), f"correlation {abs(fit.correlation):.2f}"
    if described is not None and best is not None:
        findings += _differences(described, best, f"{agree} then, {before:.2f} now")
        steering = best.outputs.steering
    texts: list[tuple[Kind, str]] = []
    size, kind = abs(fit.slope), scale_kind(fit.slope)
    shift = fit.offset if abs(fit.offset) >= OFF_CENTRE * size else 0.0
    if shift and kind == "radians":
        kind = "scale"  # more likely 0 to 1 with the middle at a half
    scale = fit.slope if kind else float(np.sign(fit.slope))
    if kind is not None:
        side = "weakly" if size < 1.0 else "strongly"
        unit = "" if kind == "scale" else f", as in {kind}"
        texts.append((kind, f"It answers too {side}{unit}: {multiple(size)} the autopilot's steering ({agree})"))
    if fit.slope < 0.0:
        texts.append(("sign", f"It steers right where the autopilot steers left ({agree})"))
    if shift:
        texts.append(("offset", f"It answers {shift:.3g} where the autopilot drives straight on ({agree})"))
    if not texts:
        if "saturated" in kinds:
            findings.append(Finding("saturated", f"In the mean it agrees with the autopilot, but {kinds['saturated']}"))
        return findings, best
    repaired = _times(steering, 1.0 / scale, shift)
    if described is None:
        line = f"steering * {repaired.scale:g}" + (f" + {repaired.offset:g}" if repaired.offset else "")
    else:
        line = output_line("steering", repaired)
    findings += [Finding(kind, text, line) for kind, text in texts]
    return findings, with_steering(best, repaired) if best is not None else None


def _unrelated(fit: Agreement, agreeing: Sequence[str], described: bool) -> Finding:
    """Say how little answers follow the road, and what to do."""
    if abs(fit.correlation) < AGREES:
        how = "not with the road"
    else:
        how = f"only weakly with the road{', and to the other side' if fit.slope < 0.0 else ''}"
    tried = ", under no description that was tried better" if described else ""
    advice = "Its input is described wrongly, or it was trained on other images: train it here, or test it on its own, "
    advice += "recording@FOLDER (docs/recordings.md)"
    if agreeing:
        advice = f"It does on {', '.join(agreeing)}: check it there alone, --sims {','.join(agreeing)}"
    text = f"It answers, but {how}: correlation {fit.correlation:.2f} with the autopilot{tried}. {advice}"
    return Finding("unrelated", text)


def only_offset(findings: Sequence[Finding]) -> bool:
    """Whether answers are off by a number alone, which may be a lane, too."""
    kinds = {one.kind for one in findings}
    return "offset" in kinds and not {"scale", "degrees", "radians", "sign"} & kinds


def lane_finding(
    offset: float, steering: NDArray[np.float64], other: Sequence[AutopilotDrives], driver: DriverName
) -> Finding | None:
    """Say which lane a network wants that steers to one side in the right lane; None if its offset is everywhere.

    `offset` is its answer there while the autopilot drives straight on; `steering` those to `other` drives, left.
    """
    there = agreement(steering, other).offset
    begins = f"ds drive --sim {other[0].simulator} --driver {driver}"
    images = (
        f"It answers {offset:.2g} where the autopilot drives straight on in the right lane, {there:.2g} in the left one"
    )
    if offset < 0.0 and abs(there) < ELSEWHERE * abs(offset):
        return Finding("lane", f"{images}: it wants the left lane; test it there, `{begins} --lane left`")
    if offset < 0.0 < there:
        return Finding("lane", f"{images}: it wants the middle of the road; test it there, `{begins} --lane middle`")
    return None


def _differences(described: DescribedNetwork, best: DescribedNetwork, agree: str) -> Iterator[Finding]:
    before, after = described.input.model_dump(), best.input.model_dump()
    for key, (kind, text) in INPUT_KINDS.items():
        keys = ("subtract", "divide") if key == "subtract" else (key,)
        if any(before[one] != after[one] for one in keys):
            yield Finding(kind, f"{text} than described ({agree})", f"input: {flow({one: after[one] for one in keys})}")
    old, new = described.outputs.steering, best.outputs.steering
    if old != new:
        text = f"{'It answers scores of bins' if new.bins else 'Its steering is another number'} ({agree})"
        yield Finding("bins" if new.bins else "output", text, output_line("steering", new))


def _crawling(
    pilot: Pilot,
    throttle: NDArray[np.float64],
    recordings: Sequence[AutopilotDrives],
    seed: int,
    described: DescribedNetwork | None,
) -> tuple[Finding, OutputSpec | None] | None:
    """Try the network's throttle while the autopilot steers; return what is wrong, and the throttle to describe."""
    speeds = np.concatenate([speeds_of_throttle(pilot, one.simulator, seed) for one in recordings])
    crawls = [habit for habit in command_habits(np.linspace(-0.5, 0.5, len(speeds)), speeds) if habit.kind == "crawls"]
    if not crawls:
        return None
    wanted, mean = float(np.mean(np.concatenate([one.throttle for one in recordings]))), float(throttle.mean())
    text = (
        f"Its throttle crawls: {3.6 * speeds.mean():.1f} km/h, as it answers {mean:.3g} in the mean and the autopilot "
        f"{wanted:.2f}"
    )
    spec = described.outputs.throttle if described else None
    if mean <= 0.0:
        return Finding("crawls", f"{text}; leave throttle out, and the paper's equation 2 drives"), None
    if spec is None:
        return Finding("crawls", text, f"throttle * {_digits(wanted / mean):g}"), None
    repaired = _times(spec, wanted / mean)
    return Finding("crawls", text, output_line("throttle", repaired)), repaired


def _times(spec: OutputSpec, factor: float, shift: float = 0.0) -> OutputSpec:
    """Return an output whose value, less a shift, is multiplied by a factor."""
    return spec.model_copy(
        update={"scale": _digits(spec.scale * factor), "offset": _digits((spec.offset - shift) * factor)}
    )


def _digits(value: float) -> float:
    """Round to two significant digits, as more are not known, and avoid -0."""
    return float(f"{value:.2g}") + 0.0


def flow(value: Any) -> str:
    """Write a value as YAML in one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {flow(part)}" for key, part in value.items()) + "}"
    return value if isinstance(value, str) and value.isidentifier() else json.dumps(value)


def output_line(name: str, spec: OutputSpec) -> str:
    """Write one output of a description as a line of YAML, without defaults."""
    return f"outputs: {flow({name: spec.model_dump(exclude_defaults=True)})}"
