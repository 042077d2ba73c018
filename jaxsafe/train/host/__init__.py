"""The host's side of training.

The package has options, the run directory with its logs and checkpoints, and the session that fills
it.
"""
