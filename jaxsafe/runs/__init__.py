"""Runs: training all seeds of a task in a directory, and the figures of what is kept there.

The commands call what is here.
"""
