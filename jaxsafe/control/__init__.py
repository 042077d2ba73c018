"""Classical controllers: control laws that fly a task without learning.

A law sees the whole state, or what an observation shows of it. `jaxsafe.load_policy` returns a law
as a policy, and `run=controller/NAME` flies it.
"""

from jaxsafe.control.docking import LQR, MPC, PD, Align
from jaxsafe.control.law import ControlLaw, LawPolicy
from jaxsafe.control.observed import observed_sim
from jaxsafe.control.pursuit import Pursuit

__all__ = ["LQR", "MPC", "PD", "Align", "ControlLaw", "LawPolicy", "Pursuit", "observed_sim"]
