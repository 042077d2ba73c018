"""Proofs about learned controllers: from a whole box the closed loop keeps its limit, or docks.

`jaxsafe.verify(env, policy, box)` proves or refutes that. It is `jaxsafe.verify.verify.verify`.
"""

from jaxsafe.schema.callable_package import make_callable

make_callable(__name__, "jaxsafe.verify.verify")
