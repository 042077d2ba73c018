"""Write a policy to a file for other tools: as ONNX, StableHLO or VNN-LIB.

ONNX needs the extra `export`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeGuard

from jaxsafe.commands import cli
from jaxsafe.commands.options import Count, File, Option, Seed
from jaxsafe.commands.policy_options import PolicyOptions, differences
from jaxsafe.schema.component import Range
from jaxsafe.schema.errors import ConfigError, choices_text, missing

if TYPE_CHECKING:
    from jaxsafe.agents.imported_policy import ForeignPolicy
    from jaxsafe.agents.policy_file import SavedPolicy
    from jaxsafe.environment import Environment
    from jaxsafe.export.functions import Exported

BOX = {"position": (70.0, 106.0), "velocity": (-0.28, 0.28)}
"""Bounds of the starts by field, in m and m/s.

These are the starts of the verification community's closed-loop docking property over 40 s.
"""

MAX_STEPS = 2000
"""Largest number of steps of the closed loop.

A docking episode has at most as many. Each step adds about 350 operators, which take 3 MiB while
they are made.
"""

MAX_BOUND = 1e18
"""Largest absolute value of a bound of a box.

Squares of larger numbers are infinite in single precision, and so is every margin.
"""


class SingleOptions(PolicyOptions):
    """The options of a command that takes one policy."""

    seed: Seed = 0
    """Which policy of a run."""


class Options(SingleOptions):
    """The options of `jaxsafe export`."""

    groups: ClassVar = {
        "The policy.": ("run", "seed", "activation"),
        "The environment in which it acts.": ("env", "env.PATH", "actions", "variant", "rta"),
        "The file.": ("format", "inputs", "batch", "steps", "box.FIELD", "out"),
    }

    format: Literal["onnx", "stablehlo", "vnnlib"] = "onnx"
    """The kind of file.

    onnx is a graph of opset 17 with a fixed batch. stablehlo is an artefact of jax.export for any
    batch. vnnlib gives the closed loop over some steps as ONNX, the property that no safety margin
    is negative from any start in a box, and the worst start that a search finds.
    """
    inputs: Literal["observation", "network", "state"] = "observation"
    """What the file computes, and from what.

    observation leads from the paper's observation to the action, with the features inside. network
    leads from the features to the output of the network, by matrix products and tanh only. state
    leads from the state at a start to the control in physical units.
    """
    batch: Count = 1
    """Number of inputs at once, with format=onnx."""
    steps: Annotated[int, Range(1, largest=MAX_STEPS)] = 40
    """Number of steps of the closed loop, with format=vnnlib."""
    box: Annotated[
        Mapping[str, Any],
        Option(prefix="box.", placeholder="FIELD", lists=True, takes="two numbers low,high"),
    ]
    """Starts of the property, with format=vnnlib.

    By default the position is within [70, 106] m and the velocity within [-0.28, 0.28] m/s.
    """
    out: File | None = None
    """Where to write. By default the file has the name of the policy."""


def main(argv: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    import jax
    import jax.numpy as jnp

    from jaxsafe.export import functions
    from jaxsafe.storage.files import write_bytes
    from jaxsafe.storage.provenance import versions

    options = Options.parse(argv)
    run, form, out = options.run, options.format, options.out
    saved, stem = single_policy(options)
    _require_finite(run, saved)
    kinds = {
        "observation": lambda: functions.action(saved),
        "state": lambda: functions.control(saved),
    }
    if isinstance(saved, functions.SavedPolicy):
        kinds["network"] = lambda: functions.network(saved)
    options.refuse_beside(
        {"onnx": [], "stablehlo": ["batch"], "vnnlib": ["batch", "inputs"]}[form],
        f"with format={form}",
    )
    if form != "vnnlib":
        boxes = [f"box.{name}" for name in options.box]
        options.refuse_beside(["steps", *boxes], "without format=vnnlib")
    if options.inputs not in kinds:
        raise ConfigError(
            f"inputs: {run} has no network of jaxsafe{choices_text(options.inputs, kinds)}"
        )
    about = {"policy": stem, "jaxsafe": versions()["jaxsafe"]}
    if form == "vnnlib":
        target = Path(out or f"{stem}_closed_loop.vnnlib")
        if (
            target.suffix != ".vnnlib"
            or target.with_suffix(".onnx").resolve() == Path(run).resolve()
        ):
            raise ConfigError(
                "out: expected NAME.vnnlib, for which NAME.onnx is written too "
                f"and is not {run}, found {target}"
            )
        if not saved.env.constraints:
            raise ConfigError(
                "format: vnnlib asks whether a safety constraint holds, "
                "and this environment has none"
            )
        loops = (
            functions.closed_loop(saved, options.steps, unrolled=True),
            functions.closed_loop(saved, options.steps),
        )
        with _with_advice(saved.env):
            return _vnnlib(*loops, given=options.box, path=target, about=about)
    exported = kinds[options.inputs]()
    if form == "stablehlo":
        try:
            # jax.export needs flatbuffers but does not require it to be installed.
            import flatbuffers  # noqa: F401
        except ImportError as error:
            raise missing(error, "flatbuffers", "export") from None
        target = Path(out or f"{stem}.stablehlo")
        shape = jax.export.symbolic_shape(f"batch, {len(exported.inputs)}")
        artefact = jax.export.export(jax.jit(exported.function))(
            jax.ShapeDtypeStruct(shape, jnp.float32)
        )
        write_bytes(target, bytes(artefact.serialize()))
    else:
        from jaxsafe.export.onnx import write_onnx

        target = Path(out or f"{stem}.onnx")
        facts = {"inputs": ", ".join(exported.inputs), "outputs": ", ".join(exported.outputs)}
        with _with_advice(saved.env):
            shape = (options.batch, len(exported.inputs))
            write_onnx(target, exported.function, shape, {**about, **facts})
    print(f"{target}: {', '.join(exported.inputs)} -> {', '.join(exported.outputs)}")
    return 0


def single_policy(options: SingleOptions) -> tuple[SavedPolicy | ForeignPolicy, str]:
    """Return the policy that the options name, and the first part of the names of files.

    Raises:
        ConfigError: there is no such policy, or the options do not fit it.
    """
    from jaxsafe.agents.policy_file import find_policy, is_single, read_policy
    from jaxsafe.train.host import run_directory

    run = options.run
    seed = options.seed
    foreign = options.is_foreign()
    single = is_single(run)
    if foreign or single:
        options.refuse_beside(["seed"], f"beside {run}, which is a single policy")
    if foreign:
        return options.read_foreign(), f"{Path(run).stem}_{options.task}"
    if not single:
        # Reading the run imports the modules that a user's environment is made of.
        run_directory.read(Path(run), "run")
        stems = [
            file.stem.removeprefix("seed_") for file in (Path(run) / "policy").glob("seed_*.npz")
        ]
        seeds = {int(stem) for stem in stems if stem.isdecimal()}
        if not seeds:
            raise ConfigError(
                f"run: {run} has no policies yet; finish it with: jaxsafe train resume={run}"
            )
        if seed not in seeds:
            raise ConfigError(
                f"seed: found {seed}; choose from {', '.join(map(str, sorted(seeds)))}"
            )
    path = find_policy(run) if single else Path(run) / "policy" / f"seed_{seed}.npz"
    saved = read_policy(path)
    env = options.change(saved.env, str(saved.about.get("env", path.stem)))
    if difference := differences(saved.env, env):
        print(difference)
    return saved._replace(env=env), path.stem if single else f"{Path(run).name}_{path.stem}"


@contextmanager
def _with_advice(env: Environment) -> Iterator[None]:
    """Add to an error the advice to leave out the filter of the environment, if there is one.

    Most filters have no counterpart in ONNX.
    """
    try:
        yield
    except ConfigError as error:
        raise (
            error
            if env.rta is None
            else ConfigError(f"{error}; leave run time assurance out with rta=none")
        ) from None


def _require_finite(run: str, saved: SavedPolicy | ForeignPolicy) -> None:
    """Refuse a policy that was left by a training that diverged.

    In a network from elsewhere an infinite constant may be a bound, so only NaN is refused there.
    """
    import jax
    import numpy as np

    from jaxsafe.agents.policy_file import SavedPolicy

    wrong = (lambda x: ~np.isfinite(x)) if isinstance(saved, SavedPolicy) else np.isnan
    for path, leaf in jax.tree.leaves_with_path(saved.params):
        if wrong(np.asarray(leaf, np.float64)).any():
            name = jax.tree_util.keystr(path, simple=True, separator="/")
            raise ConfigError(
                f"{run}: {name}: not all parameters are finite numbers, "
                "so there is no policy to export"
            )


def _vnnlib(
    unrolled: Exported,
    looped: Exported,
    given: Mapping[str, object],
    path: Path,
    about: dict[str, str],
) -> int:
    """Write the graph and the property, and print what a search for a counterexample finds.

    Args:
        unrolled: the closed loop with one step after another in its graph, to be written.
        looped: the same closed loop with a loop in its graph, to be searched.
        given: intervals of starts from the command line, by name.
        path: the path of the property. The graph gets the same name with the suffix `.onnx`.
        about: facts about the policy, for the graph.

    Returns:
        The exit code.
    """
    import jax

    from jaxsafe.export.onnx import write_onnx
    from jaxsafe.export.vnnlib import search, write_vnnlib

    box = _box(unrolled.inputs, given)
    graph = write_onnx(
        path.with_suffix(".onnx"), unrolled.function, (1, len(unrolled.inputs)), about
    )
    print(f"{graph}\n{write_vnnlib(path, unrolled, box)}", flush=True)
    worst = search(looped, box, jax.random.key(0))
    start = ", ".join(
        f"{name} {value:.4g}" for name, value in zip(looped.inputs, worst.start, strict=True)
    )
    verdict = (
        f"no counterexample among {worst.tried:,} starts, which proves nothing"
        if worst.margin >= 0.0
        else "violated"
    )
    margin = "not a number" if worst.margin == -math.inf else f"{worst.margin:.4g}"
    print(f"least margin {margin} from {start}: {verdict}")
    return 0


def _box(names: Sequence[str], given: Mapping[str, object]) -> list[tuple[float, float]]:
    """Return the interval of each element of the state at a start.

    An interval is found by the name of the element, by the name of its field, or by the name of the
    field without the platform.

    Args:
        names: the names of the elements.
        given: intervals from the command line, by name. They replace those of `BOX`.

    Raises:
        ConfigError: an element has no proper interval, or an interval belongs to no element.
    """
    bounds = {**BOX, **given}
    used = set()
    box = []
    for name in names:
        parts = name.split(".")
        keys = [name, ".".join(parts[:2]), parts[1]]
        key = next((key for key in keys if key in bounds), None)
        interval = bounds.get(key) if key else None
        if not _is_interval(interval):
            raise ConfigError(
                f"box.{parts[1]}: expected [low, high] for {name}, "
                f"each within ±{MAX_BOUND:.0e}, found {interval!r}"
            )
        used.add(key)
        box.append((float(interval[0]), float(interval[1])))
    for key in given:
        if key not in used:
            raise ConfigError(f"box.{key}: the state has no such field; it has {', '.join(names)}")
    return box


def _is_interval(value: Any) -> TypeGuard[Sequence[float]]:
    is_pair = (
        isinstance(value, (list, tuple))
        and len(value) == 2
        and all(isinstance(bound, (int, float)) for bound in value)
    )
    return is_pair and -MAX_BOUND <= value[0] <= value[1] <= MAX_BOUND


def command() -> None:
    """Run the command on the words of the command line."""
    cli.run(main, Options)
