"""Run time assurance: filters between the agent's desired control and the plant.

They are described in Section 2 and Fig. 2 of the paper.
"""
