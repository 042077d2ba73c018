"""Certificates: what a verification knows, as an .npz file of numbers and one JSON text.

A certificate holds the closed loop as a list of operations with its numbers, the boxes, and for
each proved box what the proof says of the policy in every step. `check.py` needs nothing else.
"""

from __future__ import annotations

import io
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from jaxsafe.storage.archive import CERTIFICATE, open_archive
from jaxsafe.storage.files import write_bytes
from jaxsafe.verify.loop import Loop, Plant
from jaxsafe.verify.program import RULED, Constant, Op, Program
from jaxsafe.verify.tube import EVERY, Claims
from jaxsafe.verify.verify import Boxes, Counterexample, Verification

PROGRAMS = ("first", "following")
"""The programs of a loop, fields of `Loop`."""

BOXES = ("box", "proved", "refuted", "open")
"""The sets of boxes of a verification, fields of `Verification`."""


def save_certificate(
    path: str | os.PathLike, verification: Verification, about: dict[str, Any]
) -> None:
    """Write a certificate.

    Args:
        path: the file.
        verification: what it holds.
        about: what else the header says, such as the policy and the version.
    """
    arrays = {
        f"{name}/{end}": x
        for name in BOXES
        for end, x in getattr(verification, name)._asdict().items()
    }
    arrays["proved/last"] = verification.last
    arrays |= {f"claims/{name}": x for name, x in verification.claims._asdict().items()}
    programs = {}
    for name in PROGRAMS:
        program = getattr(verification.loop, name)
        rows = []
        for index, op in enumerate(program.ops):
            rows.append([op.kind, list(op.inputs), op.output, op.size, len(op.constants)])
            for number, constant in enumerate(op.constants):
                place = f"{name}/{index}/{number}"
                arrays |= {f"{place}/{key}": x for key, x in constant._asdict().items()}
        programs[name] = {"ops": rows, "input": program.input, "output": program.output}
    violation = verification.counterexample
    header = {
        "format": CERTIFICATE,
        "property": verification.loop.property,
        "result": verification.result,
        "steps": verification.steps,
        "order": verification.order,
        "every": EVERY,
        "unit": verification.loop.following.unit,
        "dimension": verification.loop.dimension,
        "columns": verification.loop.columns,
        "curved": verification.loop.curved,
        "motion": verification.loop.motion,
        "actions": verification.loop.actions,
        "plant": verification.loop.plant._asdict(),
        "programs": programs,
        "margin": verification.margin if math.isfinite(verification.margin) else None,
        "counterexample": None if violation is None else violation._asdict(),
        "seconds": verification.seconds,
        "bounded": verification.bounded,
        **about,
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, header=np.array(json.dumps(header)), **arrays)
    write_bytes(Path(path), buffer.getvalue())


def load_certificate(path: str | os.PathLike) -> Verification:
    """Return the verification that a certificate holds, to look at it or to go on from it.

    Raises:
        ConfigError: the file cannot be read, or is no certificate.
    """
    with open_archive(path, "not a certificate, or a damaged one") as archive:
        header = archive.header("a certificate", CERTIFICATE)
        arrays = {name: archive.read(name) for name in archive.names if name != "header"}
        boxes = {name: Boxes(*(arrays[f"{name}/{end}"] for end in Boxes._fields)) for name in BOXES}
        programs = {name: _program(header, arrays, name) for name in PROGRAMS}
        violation = header["counterexample"]
        return Verification(
            result=header["result"],
            claims=Claims(*(arrays[f"claims/{name}"] for name in Claims._fields)),
            last=arrays["proved/last"],
            margin=math.inf if header["margin"] is None else header["margin"],
            counterexample=None if violation is None else Counterexample(**violation),
            loop=Loop(
                **programs,
                columns=tuple(header["columns"]),
                dimension=header["dimension"],
                actions=header["actions"],
                plant=Plant(**header["plant"]),
                curved=header.get("curved", False),
                motion=header.get("motion", 0),
                property=header["property"],
            ),
            steps=header["steps"],
            order=header.get("order", 0),
            seconds=header["seconds"],
            bounded=header["bounded"],
            **boxes,
        )


def _program(header: dict[str, Any], arrays: dict[str, np.ndarray], name: str) -> Program:
    data = header["programs"][name]
    ops = []
    for index, (kind, inputs, output, size, count) in enumerate(data["ops"]):
        if kind not in RULED:
            raise ValueError(f"unknown operation {kind!r}")
        constants = (
            Constant(*(arrays[f"{name}/{index}/{number}/{key}"] for key in Constant._fields))
            for number in range(count)
        )
        ops.append(Op(kind, tuple(inputs), output, size, tuple(constants)))
    return Program(tuple(ops), data["input"], data["output"], header["unit"])
