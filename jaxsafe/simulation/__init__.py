"""The plant: platforms and their dynamics, controllers, geometry and initializers.

Figs. 8 and 9 of the paper show these parts.
"""
