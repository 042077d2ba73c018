"""The baselines: train all tasks in every way that the suite offers, evaluate, and write the page that shows it."""
