from .gate import Gate, GateState, gate_of
from .line_contrast import LineContrast, LineProbe

__all__ = ["Gate", "GateState", "LineContrast", "LineProbe", "gate_of"]
