"""Export of policies to other tools.

A policy becomes an ONNX or StableHLO file. Verifiers get the closed loop and its safety property.
"""

from jaxsafe.export.functions import Exported, action, closed_loop, control, network

__all__ = [
    "Exported",
    "action",
    "closed_loop",
    "control",
    "network",
]
