from .camera.look import Look
from .camera.painted_scene import PaintedScene
from .camera.spec import CameraSpec
from .lane_tracker import LaneTracker
from .oracle import Oracle, OracleLimits
from .registry import (
    SIMULATORS,
    UnknownSimulatorError,
    UntrustedSimulatorError,
    make_simulator,
    received_simulator,
    spec_of,
)
from .resimulation import ResimulationError, resimulate
from .road_simulator import RoadSimulator
from .run_codec import RunCodecError, decode_run, encode_run
from .scene import Scene
from .session import RunRecord, Session
from .simulator import (
    AutopilotGains,
    Command,
    CommandError,
    DrawsRows,
    LaneState,
    Observation,
    Outcome,
    Simulator,
    SimulatorError,
    SimulatorSpec,
    VehicleState,
)
from .vehicle import Vehicle
from .video import write_video

__all__ = [
    "AutopilotGains",
    "CameraSpec",
    "Command",
    "CommandError",
    "DrawsRows",
    "LaneState",
    "LaneTracker",
    "Look",
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
    "Scene",
    "Session",
    "Simulator",
    "SimulatorError",
    "SimulatorSpec",
    "UnknownSimulatorError",
    "UntrustedSimulatorError",
    "Vehicle",
    "VehicleState",
    "decode_run",
    "encode_run",
    "make_simulator",
    "received_simulator",
    "resimulate",
    "spec_of",
    "write_video",
]
