"""Policies for other tools: ONNX, StableHLO, and the closed loop with its safety property for verifiers."""
