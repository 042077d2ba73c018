"""What the state means: statuses, safety constraints, ends of an episode, rewards and observations (Figs. 8, 10 and 11)."""
