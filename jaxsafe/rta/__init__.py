"""Run time assurance: filters between the agent's desired control and the plant (Section 2 and Fig. 2 of the paper)."""
