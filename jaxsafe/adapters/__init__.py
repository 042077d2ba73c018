"""The tasks in other libraries: each adapter is one file over `reset` and `step`, and nothing in the core knows of it."""
