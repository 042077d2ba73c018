"""Evaluation: whole episodes of policies and their metrics, and adversaries that try a filter.

`jaxsafe.evaluate(env, policy, key, num_episodes)` returns the metrics of a policy. It is the
function `jaxsafe.evaluate.evaluate.evaluate`.
"""

from jaxsafe.schema.callable_package import make_callable

make_callable(__name__, "jaxsafe.evaluate.evaluate")
