"""The meaning of the state, as in Figs. 8, 10 and 11 of the paper.

These are statuses, safety constraints, ends of an episode, rewards and observations.
"""
