"""`python -m jaxsafe.report` names its successor."""

import sys

if __name__ == "__main__":
    sys.exit(
        "error: jaxsafe.report: in a clone of jaxsafe, python benchmarks/baselines trains, "
        "evaluates and reports"
    )
