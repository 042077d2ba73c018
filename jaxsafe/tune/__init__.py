"""Sweeps: many settings of one training, compiled once wherever they differ in numbers only."""
