"""Export of policies to other tools.

A policy becomes ONNX or StableHLO. For verifiers there is the closed loop with its safety property.
"""

from jaxsafe.export.functions import Exported, action, closed_loop, control, network

__all__ = [
    "Exported",
    "action",
    "closed_loop",
    "control",
    "network",
]
