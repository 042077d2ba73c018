"""Prove policies from a box of starts, and check the certificates.

    python benchmarks/verification.py [published=docking2d_published.onnx] [out=FILE]

`published` is the network of the verification community's docking benchmark, which does not come
with this package. Without it, its rows are left out. Each proof runs twice in one process. The
second run is timed, so that compiling is not counted.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from isolated import words

import jaxsafe
from jaxsafe.agents.imported_policy import read_foreign
from jaxsafe.agents.policy_file import find_policy, read_policy
from jaxsafe.devices.seed_mapper import usable_cores
from jaxsafe.storage import provenance
from jaxsafe.verify import check
from jaxsafe.verify.certificate import save_certificate
from jaxsafe.verify.verify import verify

BOX = {"position": [70.0, 106.0], "velocity": [-0.28, 0.28]}
"""The starts of the community's docking benchmark [m, m/s]."""

RAW = {
    "observation": ["position", "velocity"],
    "observation.position.scale": 1.0,
    "observation.velocity.scale": 1.0,
}
"""What the published network sees: position and velocity as they are."""

MAX_SECONDS = 240.0
"""How long a search may take."""


def cases(published: str) -> Iterator[tuple[str, Any, Any, dict[str, Any]]]:
    """Yield the name, the environment and the policy of each row, and the options of its proof."""
    if published:
        env = jaxsafe.make("docking2d", overrides=RAW)
        foreign = read_foreign(Path(published), env)
        policy = foreign.agent.policy(env, foreign.params, True)
        yield "published network", env, policy, {}
        yield "published network", env, policy, {"arithmetic": "real"}
    saved = read_policy(find_policy("docking2d"))
    policy = saved.agent.policy(saved.env, saved.params, True)
    yield "pretrained/docking2d", saved.env, policy, {}
    heavy = jaxsafe.override(saved.env, {"deputy.mass": 300.0})
    yield "the same at 300 kg", heavy, policy, {}
    yield "pretrained/docking2d", saved.env, policy, {"steps": 80}


def main() -> None:
    """Prove, check and write."""
    options = words(published="", out="benchmarks/results/verification.json")
    rows = []
    for name, env, policy, proof_options in cases(options["published"]):
        verify(env, policy, BOX, seconds=MAX_SECONDS, **proof_options)
        proof = verify(env, policy, BOX, seconds=MAX_SECONDS, **proof_options)
        row = {
            "policy": name,
            "steps": proof.steps,
            "arithmetic": proof_options.get("arithmetic", "float32"),
            "result": proof.result,
            "proved": proof.shares()["proved"],
            "seconds": proof.seconds,
            "bounded": proof.bounded,
            "boxes": len(proof.proved.low),
            "margin": proof.margin if len(proof.proved.low) else None,
            "violation": proof.counterexample and proof.counterexample._asdict(),
            "check_seconds": _checked(proof) if proof.result == "proved" else None,
        }
        rows.append(row)
        print(json.dumps(row), flush=True)
        content = {
            "commit": provenance.commit(),
            "versions": provenance.versions(),
            "cores": usable_cores(),
            "rows": rows,
        }
        text = json.dumps(content, indent=1, ensure_ascii=False)
        Path(options["out"]).write_text(f"{text}\n", encoding="utf-8")


def _checked(proof: Any) -> float:
    """Return how many seconds the check of a proof's certificate takes.

    Raises:
        CalledProcessError: the certificate is refused.
    """
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "proof.npz"
        save_certificate(path, proof, {})
        began = time.monotonic()
        subprocess.run([sys.executable, check.__file__, path], check=True, stdout=sys.stderr)
        return time.monotonic() - began


if __name__ == "__main__":
    main()
