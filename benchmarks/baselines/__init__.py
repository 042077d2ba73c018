"""The baselines: train and evaluate all tasks in every way of the suite, and write the pages."""
