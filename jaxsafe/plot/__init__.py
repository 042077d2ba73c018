"""Figures of the paper, from the log files of a run, and animations of episodes."""
