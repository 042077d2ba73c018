"""The devices and processes that share the work of a training.

Seeds are mapped over them, batches are split among them, and programs are compiled for them.
"""
