"""Components and their fields, dotted paths into them, and how they are read and written.

Nothing in this package knows a task.
"""
