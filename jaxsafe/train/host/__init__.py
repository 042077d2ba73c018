"""The host's side of training: options, the run directory with its logs and checkpoints, and the session that fills it."""
