"""Bounds that no policy can beat, from theory: least length and Δv of a success, largest return.

`best_possible(env, states)` returns them for each start. docs/possible.md has the derivations.
"""

from jaxsafe.bounds.best_possible import best_possible

__all__ = ["best_possible"]
