"""Sweeps over many settings of one training.

Settings that differ in numbers only are compiled once.
"""
