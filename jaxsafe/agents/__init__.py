"""Agents.

The package has what they see, their networks, the distributions from which they draw actions, and
the files of their weights.
"""
