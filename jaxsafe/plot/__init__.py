"""The paper's figures from the log files of a run."""
