"""Whole episodes of policies and their metrics, and the adversaries that a filter is evaluated against."""
