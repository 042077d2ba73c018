"""`python -m jaxsafe.report` names its successor."""

import sys

if __name__ == "__main__":
    successor = "in a clone of jaxsafe, python benchmarks/baselines trains, evaluates and reports"
    print(f"error: jaxsafe.report: {successor}", file=sys.stderr)
    sys.exit(2)
