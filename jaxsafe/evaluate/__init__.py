"""Evaluation: whole episodes of trained policies, their metrics, and a command line over run directories."""
