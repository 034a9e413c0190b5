# SPDX-License-Identifier: Apache-2.0
"""Simulator whose parts come from several simulators: the vehicle of one, the camera of another, and so on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ds_base.errors import InputError
from ds_road import Road
from ds_sim.camera.rendered_scene import PaintedScene
from ds_sim.conditions.actuation import Actuation
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.parts import Scene
from ds_sim.registry import HYBRID, SimulatorName, make_simulator
from ds_sim.road_simulator import RoadSimulator
from ds_sim.simulator import Command, Observation, Simulator

PARTS = ("camera", "look", "vehicle", "delays")
"""Parts in which simulators differ. camera: lens, field of view, mounting, rows that the network gets. look: colours,
textures and light of the world, and the sensor's response, exposure, blur and noise. vehicle: physics, and the
autopilot's gains for it. delays: camera latency and dead time of commands."""
SENSOR_LOOK = ("gain", "gamma", "exposure", "blur", "noise", "noise_blur", "noise_colour")
"""Fields of a `CameraSpec` that belong to the look; `latency` belongs to the delays, all others to the camera."""


class HybridError(InputError):
    """Parts that cannot be combined."""


class HybridSimulator(RoadSimulator):
    """Simulator of the parts of other simulators, which it makes for itself.

    A hybrid of one simulator's parts alone drives as that simulator does, byte for byte.

    Args:
        names: for each of `PARTS`, the name of a simulator; `whole_scene` ones give camera and look together.

    Raises:
        HybridError: a part is missing, or a simulator cannot give it.
        ds_sim.registry.UnknownSimulatorError: there is no such simulator.

    Examples:
        >>> from ds_sim.hybrid import HybridSimulator
        >>> made = HybridSimulator({"camera": "bullet", "look": "bullet", "vehicle": "softbody", "delays": "donkey"})
        >>> made.spec.camera.height, made.spec.camera.latency, round(made.spec.wheelbase, 2)
        (1.35, 1, 2.53)
    """

    def __init__(self, names: Mapping[str, str]) -> None:
        if set(names) != set(PARTS):
            raise HybridError(f"parts {', '.join(names) or 'none'}: expected {', '.join(PARTS)}")
        simulators = {name: exchangeable(name) for name in sorted(set(names.values()))}
        camera, look, vehicle, delays = (simulators[names[part]] for part in PARTS)
        spec = replace(
            vehicle.spec,
            name=look.spec.name,  # by which a network that translates images knows its generator
            camera=replace(
                camera.spec.camera,
                latency=delays.spec.camera.latency,
                **{field: getattr(look.spec.camera, field) for field in SENSOR_LOOK},
            ),
            look=look.spec.look,
            crop_top=camera.spec.crop_top,
            crop_bottom=camera.spec.crop_bottom,
        )
        whole = whole_scene(camera) or whole_scene(look)
        if whole and camera is not look:
            raise HybridError(
                f"camera of {names['camera']} with the look of {names['look']}: one of them draws its scene as a "
                "whole, so take both from the same simulator"
            )
        scene: Scene = camera.scene if whole else PaintedScene(spec.camera, spec.look)
        super().__init__(spec, vehicle.vehicle, scene=scene, limits=vehicle.limits)
        self._dead_time = delays.vehicle.command_delay
        if self.vehicle.delays_commands:
            self.vehicle.command_delay, self._dead_time = self._dead_time, 0.0
        self._sent: Actuation | None = None

    @classmethod
    def named(cls, name: SimulatorName) -> HybridSimulator:
        """Make the hybrid that `hybrid_name` names."""
        return cls(name.parts)

    def load(self, road: Road, *, seed: int, conditions: Conditions = DEFAULT) -> Observation:
        """Build the world from scratch; see `Simulator.load`."""
        self._sent = None
        if self._dead_time:
            self._sent = Actuation(Conditions(command_delay=self._dead_time), self.spec.max_steering_angle)
        return super().load(road, seed=seed, conditions=conditions)

    def step(self, command: Command) -> Observation:
        """Advance by one step; see `Simulator.step`."""
        # Actuation keeps dead times only here, for which the speed does not matter.
        return super().step(command if self._sent is None else self._sent.reached(command, 0.0))


def hybrid_name(names: Mapping[str, str]) -> SimulatorName:
    """Name a hybrid; HybridError if a simulator's name holds a comma.

    Examples:
        >>> from ds_sim.hybrid import hybrid_name
        >>> str(hybrid_name({"camera": "bullet", "look": "bullet", "vehicle": "donkey@a.yaml", "delays": "bullet"}))
        'ds_sim.hybrid:HybridSimulator@camera=bullet,look=bullet,vehicle=donkey@a.yaml,delays=bullet'
    """
    for name in names.values():
        if "," in name:
            raise HybridError(f"simulator {name}: a name with a comma cannot give parts: rename the file")
    return SimulatorName(f"{HYBRID}@{','.join(f'{part}={names[part]}' for part in PARTS)}")


def exchangeable(name: str) -> RoadSimulator:
    """Make a simulator whose parts can be exchanged; HybridError if it is not made of a vehicle and a scene."""
    simulator: Simulator = make_simulator(name)
    if not isinstance(simulator, RoadSimulator):
        raise HybridError(f"{name} is no RoadSimulator, so its parts cannot be exchanged: docs/add_a_simulator.md")
    return simulator


def whole_scene(simulator: RoadSimulator) -> bool:
    """Whether camera and look can be exchanged only together, as in a world drawn by another engine."""
    return type(simulator.scene) is not PaintedScene


def differing_parts(one: RoadSimulator, other: RoadSimulator) -> Sequence[tuple[str, ...]]:
    """Parts in which two simulators differ, each as one or more of `PARTS` that can be exchanged only together.

    Physics always count as different, as they cannot be compared.
    """
    a, b = one.spec, other.spec
    sensor = {field: getattr(b.camera, field) for field in (*SENSOR_LOOK, "latency")}
    differ = {
        "camera": (replace(a.camera, **sensor), a.crop_top, a.crop_bottom) != (b.camera, b.crop_top, b.crop_bottom),
        "look": (a.look, *(getattr(a.camera, f) for f in SENSOR_LOOK)) != (b.look, *(sensor[f] for f in SENSOR_LOOK)),
        "vehicle": True,
        "delays": (a.camera.latency, one.vehicle.command_delay) != (b.camera.latency, other.vehicle.command_delay),
    }
    if whole_scene(one) or whole_scene(other):
        return [("camera", "look"), *((part,) for part in PARTS[2:] if differ[part])]
    return [(part,) for part in PARTS if differ[part]]
