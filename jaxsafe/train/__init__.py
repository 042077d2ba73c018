"""Training: a PPO that maps whole seeds over the cores of a machine, and the run directory that it writes."""
