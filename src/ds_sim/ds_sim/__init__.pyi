# SPDX-License-Identifier: Apache-2.0
from .camera.atlas import Ground
from .camera.ground import paint_ground
from .camera.lens import project
from .camera.rendered_scene import PaintedScene, Sensor
from .camera.renderer import Camera
from .camera.spec import CameraSpec, Look
from .conditions.actuation import COMMAND_CONDITIONS, Actuation
from .conditions.model import DEFAULT, FIELDS, Condition, Conditions, ConditionsError, NotApplicableError
from .conditions.text import format_conditions, parse_conditions
from .gates.gate import Gate, GateState, gate_of
from .gates.visible_contrast import ContrastProbe, VisibleContrast
from .oracle import LaneTracker, Oracle, OracleLimits
from .parts import Scene, Vehicle
from .registry import (
    BULLET,
    DONKEY,
    PANDA,
    SIMULATORS,
    SOFTBODY,
    SimulatorName,
    UnknownSimulatorError,
    UntrustedSimulatorError,
    make_simulator,
    received_simulator,
    spec_of,
)
from .road_simulator import RoadSimulator
from .run_codec import RunCodecError, decode_run, encode_run
from .scenario import Scenario
from .session import ResimulationError, RunRecord, Session, resimulate
from .simulator import (
    AutopilotGains,
    Command,
    CommandError,
    LaneState,
    Observation,
    Outcome,
    Simulator,
    SimulatorError,
    SimulatorSpec,
    VehicleState,
)
from .video import write_video

__all__ = [
    "BULLET",
    "DONKEY",
    "PANDA",
    "SOFTBODY",
    "Actuation",
    "AutopilotGains",
    "COMMAND_CONDITIONS",
    "Camera",
    "CameraSpec",
    "Command",
    "CommandError",
    "Condition",
    "Conditions",
    "ConditionsError",
    "DEFAULT",
    "FIELDS",
    "Gate",
    "GateState",
    "Ground",
    "LaneState",
    "LaneTracker",
    "VisibleContrast",
    "ContrastProbe",
    "Look",
    "NotApplicableError",
    "Observation",
    "Oracle",
    "OracleLimits",
    "Outcome",
    "PaintedScene",
    "ResimulationError",
    "RoadSimulator",
    "RunCodecError",
    "RunRecord",
    "SIMULATORS",
    "Scenario",
    "Scene",
    "Sensor",
    "Session",
    "Simulator",
    "SimulatorError",
    "SimulatorName",
    "SimulatorSpec",
    "UnknownSimulatorError",
    "UntrustedSimulatorError",
    "Vehicle",
    "VehicleState",
    "decode_run",
    "encode_run",
    "format_conditions",
    "gate_of",
    "make_simulator",
    "paint_ground",
    "parse_conditions",
    "project",
    "received_simulator",
    "resimulate",
    "spec_of",
    "write_video",
]
