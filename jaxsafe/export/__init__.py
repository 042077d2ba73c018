"""Export of policies to other tools.

A policy becomes ONNX or StableHLO. For verifiers there is the closed loop with its safety property.
"""
