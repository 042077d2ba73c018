"""Evaluation: whole episodes of policies and their metrics, and adversaries that try a filter."""
