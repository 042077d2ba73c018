"""Agents: what they see, their networks, the distributions they draw actions from, and files of their weights."""
