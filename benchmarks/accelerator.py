"""Measure what a GPU is worth to jaxsafe, by one command within ten minutes.

Each part is a process of its own with a share of the time. The most important part comes first.
Time that a part does not use goes to the parts after it. A measurement for which there was no time
is named in the results and on standard error.

- `numbers`: tests of numbers on this device: recorded steps and episodes in double precision, laws
  of the tasks, run time assurance, and a training that goes on from a checkpoint.
- `environments`: steps a second of the five tasks and of gymnax's Pendulum-v1, with random actions
  and automatic reset.
- `ppo`: samples a second of PPO with the settings of `ppo.py`, beside `usual_ppo.py` and, where it
  runs, rejax.
- `learning`: seconds until ten seeds of each task have 95 % success in training, by the recipe with
  the most environments.
- `filters`: calls a second of the filters of `make(…, rta=…)`.

Every row also has the memory that its programs need and the seconds that they took to compile,
several side by side. Rows are written to `benchmarks/results/accelerator.json` as they are found,
so a run that is stopped keeps what it has. On a CPU the sizes are small and say little. They are
there so that the script is tested.

    python benchmarks/accelerator.py [minutes=10] [parts=numbers,environments,…]
        [tasks=docking3d,…] [sizes=1,1024,…] [seeds=10] [repeats=3] [out=FILE]

`sizes` are the numbers of environments of `environments`.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

from isolated import several, words

from jaxsafe.devices.seed_mapper import usable_cores
from jaxsafe.envs import TASKS

HERE = Path(__file__).parent
OUT = HERE / "results" / "accelerator.json"
LEVEL = 0.95
"""The success rate in training that `learning` waits for."""

PEER = "gymnax:Pendulum-v1"
"""The environment of another library that `environments` measures beside the tasks."""


class Sizes(NamedTuple):
    """How large the measurements are on a kind of device."""

    environments: str
    ppo: Sequence[int]  # environments
    filters: Sequence[int]  # states in a batch


ACCELERATOR = Sizes("1,1024,16384,262144,1048576", ppo=(2048, 32768), filters=(4096, 65536))
"""PPO has as many environments as in `ppo.py`, and then as many as an accelerator has room for."""

CPU = Sizes("1,64,1024", ppo=(64,), filters=(64,))

STEPS = 1000
"""Steps of each environment in one measurement, so that resets have their share."""

FEWER_STEPS_FROM = 2**17
"""From so many environments on, a quarter of the steps takes long enough to be measured."""

COMPILING = 0.75
"""The share of the time left in which the programs of a round must compile. Others are skipped."""

GRACE = 5.0
"""How many seconds a part may take beyond its time before it is killed."""

TESTS = (
    "tests/envs/test_golden.py",
    "tests/train/test_train.py::test_a_crashed_run_resumes_to_the_same_end",
    "tests/devices/test_seed_mapper.py::test_a_seed_is_to_rounding_the_same_run_under_vmap",
    "tests/rta/test_rta.py::test_no_adversary_breaks_the_filter",
    "tests/rta/test_rta.py::test_a_control_that_is_certified_passes_unaltered",
    "tests/rta/test_rta.py::test_what_is_not_a_number_never_reaches_the_plant",
    "tests/rta/test_rta.py::test_in_float32_every_projection_is_certified",
    "tests/envs/test_task_laws.py::test_everything_stays_finite",
    "tests/envs/test_task_laws.py::test_everything_stays_finite_at_the_edges_of_space",
    "tests/envs/test_task_laws.py::test_limits_are_reached_and_never_exceeded",
    "tests/envs/test_task_laws.py::test_cost_is_one_exactly_where_a_margin_is_negative",
    "tests/envs/test_task_laws.py::test_planar_docking_is_spatial_docking_with_z_zero",
    "tests/envs/test_task_laws.py::test_planar_rejoin_is_spatial_rejoin_in_straight_level_flight",
    "tests/simulation/test_cwh.py::test_in_float32_the_error_is_at_most_five_parts_in_ten_million",
    "tests/simulation/test_dubins.py::test_in_float32_the_way_flown_has_six_digits",
    "tests/simulation/test_trig.py",
)
"""The tests of `numbers`, the most telling first."""

WORKERS = 8
"""Processes that run tests side by side, if there are as many cores and pytest-xdist."""


class Request(NamedTuple):
    """What a part is asked for."""

    until: float  # its end, on the monotonic clock [s]
    tasks: Sequence[str]
    sizes: Sequence[int]
    seeds: int
    repeats: int

    @property
    def left(self) -> float:
        """The seconds that are left."""
        return self.until - time.monotonic()


class Job(NamedTuple):
    """One row to be measured."""

    row: dict[str, Any]  # what the row says about the measurement itself
    prepare: Callable[[], Any]  # compiles on a thread, and returns a `Built`
    measure: Callable[[Any, Request], dict[str, Any]]  # returns the numbers of the row


def main() -> None:
    """Run the parts, write the results and print the tables."""
    options = words(
        minutes="10",
        parts=",".join(PARTS),
        tasks=",".join(TASKS),
        sizes="",
        seeds="10",
        repeats="3",
        out=str(OUT),
        seconds="",
    )
    chosen = several("parts", options["parts"], PARTS)
    tasks = several("tasks", options["tasks"], TASKS)
    if "probe" in options:
        probe(options, tasks)
        return
    inherited = dict(os.environ)
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"  # this process computes nothing
    import jax
    import tables
    from machine import about

    until = time.monotonic() + 60.0 * float(options["minutes"])
    options["sizes"] = options["sizes"] or sizes_here().environments
    content: dict[str, Any] = {
        **about(__file__),
        "platform": jax.default_backend(),
        "minutes": float(options["minutes"]),
        "parts": {},
    }
    out = Path(options["out"])
    out.parent.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(chosen):
        share = PARTS[name].share / sum(PARTS[later].share for later in chosen[i:])
        part = content["parts"][name] = {"seconds": 0.0, "rows": [], "skipped": []}
        begin = time.monotonic()
        for row in rows_of(name, options, max(share * (until - begin), 0.0), inherited):
            print(f"{name}: {json.dumps(row)}", file=sys.stderr, flush=True)
            part["skipped" if "skipped" in row else "rows"].append(row.get("skipped", row))
            part["seconds"] = round(time.monotonic() - begin, 1)
            out.write_text(json.dumps(content, indent=1) + "\n")
    for table in tables.accelerator_tables(content):
        print(f"{table}\n")


def rows_of(
    name: str, options: dict[str, str], seconds: float, environment: dict[str, str]
) -> Iterator[dict[str, Any]]:
    """Run a part in a process of its own and yield its rows as it prints them.

    If the part ended early, a last row says why.
    """
    arguments = [f"{key}={options[key]}" for key in ("tasks", "sizes", "seeds", "repeats")]
    command = [sys.executable, __file__, f"probe={name}", f"seconds={seconds}", *arguments]
    with tempfile.TemporaryFile("w+") as errors:
        with subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            start_new_session=True,
            env=environment,
        ) as process:
            overdue = threading.Timer(seconds + GRACE, os.killpg, (process.pid, signal.SIGKILL))
            overdue.start()
            for line in process.stdout or ():
                if line.startswith("{"):
                    yield json.loads(line)
        overdue.cancel()
        errors.seek(0)
        messages = errors.read()
    sys.stderr.write(messages)
    if process.returncode == -signal.SIGKILL:
        yield {"skipped": f"{name}: the rest, out of time"}
    elif process.returncode:
        yield {"skipped": f"{name}: the rest, exit code {process.returncode}: {messages[-1500:]}"}


def probe(options: dict[str, str], tasks: Sequence[str]) -> None:
    """Measure one part and print its rows."""
    until = time.monotonic() + float(options["seconds"])
    sizes = [int(size) for size in options["sizes"].split(",")]
    request = Request(until, tasks, sizes, int(options["seeds"]), int(options["repeats"]))
    for row in PARTS[options["probe"]].run(request):
        print(json.dumps(row), flush=True)
    sys.stderr.flush()
    os._exit(0)  # without waiting for programs that still compile


def numbers(request: Request) -> Iterator[dict[str, Any]]:
    """Run the tests. Yield a row for each that did not pass, and one with all counts."""
    # With `-W default` warnings about other versions of packages are no errors.
    options = "-v --tb=short -rN -p no:cacheprovider -p no:benchmark -W default"
    command = [sys.executable, "-m", "pytest", *options.split(), *TESTS]
    workers = min(WORKERS, usable_cores())
    if workers > 2 and importlib.util.find_spec("xdist"):
        command += [f"-n{workers}", f"--maxprocesses={workers}"]
    environment = {
        **os.environ,
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
        "XLA_FLAGS": os.environ.get("XLA_FLAGS", " "),
    }
    counts: dict[str, int] = {}
    with subprocess.Popen(
        command,
        cwd=HERE.parent,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        overdue = threading.Timer(max(request.left, 0.0), os.killpg, (process.pid, signal.SIGKILL))
        overdue.start()
        for line in process.stdout or ():
            print(line, end="", file=sys.stderr)
            outcome = re.search(r"\b(PASSED|FAILED|ERROR|SKIPPED)\b", line)
            name = re.search(r"tests/\S+::\S+", line)
            if outcome and name:
                counts[outcome.group()] = counts.get(outcome.group(), 0) + 1
                if outcome.group() in ("FAILED", "ERROR"):
                    yield {"test": name.group(), "outcome": outcome.group().lower()}
    overdue.cancel()
    yield {outcome.lower(): number for outcome, number in sorted(counts.items())}
    if process.returncode == -signal.SIGKILL:
        yield {"skipped": "numbers: tests that had not run, out of time"}


def environments(request: Request) -> Iterator[dict[str, Any]]:
    """Measure steps a second. Large batches of all tasks are measured before small ones."""
    import environments as peers
    import jax

    import jaxsafe

    runs: dict[str, Any] = {
        task: partial(peers.episode_steps, jaxsafe.make(task)) for task in request.tasks
    }
    try:
        runs[PEER] = peers.gymnax_steps("Pendulum-v1")
    except ImportError as error:
        yield {"skipped": f"{PEER}: {error}"}

    def prepare(run: Any, size: int, steps: int) -> Any:
        program = jax.jit(run, static_argnums=(1, 2)).lower(jax.random.key(0), size, steps)
        return Built(program.compile)

    def measure(built: Built, request: Request, size: int, steps: int) -> dict[str, Any]:
        seconds = timed(lambda seed: built.program(jax.random.key(seed)), request.repeats)
        return {
            "steps_per_s": size * steps / statistics.median(seconds),
            "s_per_step": statistics.median(seconds) / steps,
        }

    jobs = []
    for size in sorted(request.sizes, reverse=True):
        steps = STEPS if size < FEWER_STEPS_FROM else STEPS // 4
        for name, run in runs.items():
            row = {"task": name, "environments": size}
            jobs.append(
                Job(
                    row,
                    partial(prepare, run, size, steps),
                    partial(measure, size=size, steps=steps),
                )
            )
    yield from measured(jobs, request)


def ppo(request: Request) -> Iterator[dict[str, Any]]:
    """Measure samples a second of one seed and of several at once."""
    import jax
    import ppo as settings

    task = "docking2d" if "docking2d" in request.tasks else request.tasks[0]

    def ours(seeds: int, num_envs: int) -> Any:
        fresh, advance, keys, shared = settings.our_programs(
            task, seeds, settings.UPDATES, num_envs
        )
        like = jax.eval_shape(fresh, shared, keys)
        built = Built(advance.lower(shared, like).compile)
        state = fresh(shared, keys)
        return built.calling(lambda _: built.program(shared, state))

    def usual(seeds: int, num_envs: int) -> Any:
        run, start = settings.usual_program(task, num_envs)
        keys = jax.random.split(jax.random.key(0), seeds)
        carry = jax.block_until_ready(jax.jit(jax.vmap(start))(keys))
        built = Built(jax.jit(jax.vmap(run)).lower(carry).compile)
        return built.calling(lambda _: built.program(carry))

    def rejax(seeds: int, num_envs: int) -> Any:
        train = jax.vmap(settings.rejax_trainer(task, settings.UPDATES, num_envs))
        keys = jax.random.split(jax.random.PRNGKey(0), seeds)
        built = Built(jax.jit(train).lower(keys).compile)
        return built.calling(lambda _: built.program(keys))

    def measure(built: Built, request: Request, samples: int) -> dict[str, Any]:
        seconds = timed(built.call, request.repeats)
        return {"samples_per_s": samples / statistics.median(seconds)}

    jobs = []
    peers = {"jaxsafe": ours, "rejax": rejax, "usual way": usual}
    small, *large = sizes_here().ppo
    for num_envs, seeds in ((small, 1), (small, request.seeds), *((size, 1) for size in large)):
        for peer, prepare in peers.items():
            if peer == "usual way" and (num_envs, seeds) != (small, 1):
                continue
            row = {"peer": peer, "task": task, "seeds": seeds, "environments": num_envs}
            samples = seeds * settings.UPDATES * num_envs * settings.NUM_STEPS
            jobs.append(
                Job(row, partial(prepare, seeds, num_envs), partial(measure, samples=samples))
            )
    yield from measured(jobs, request)


def learning(request: Request) -> Iterator[dict[str, Any]]:
    """Measure the seconds until all seeds of a task have reached `LEVEL`."""
    import jax
    import numpy as np

    from jaxsafe.devices.seed_mapper import SeedMapper, claim_cores
    from jaxsafe.train.host.options import configs, resolve
    from jaxsafe.train.train import STATE, programs

    claim_cores()

    def prepare(task: str, preset: str) -> Any:
        config, env, _ = resolve({"env": task, "preset": preset, "seeds": request.seeds})
        mapper = SeedMapper(config.seeds, config.shares)
        shared = mapper.replicate((env, config.agent, config.ppo))
        keys = mapper.keys(config.seed)
        fresh, advance = programs(mapper, 1, config.num_updates)
        built = Built(
            advance.lower(shared, mapper.like(jax.eval_shape(fresh, shared, keys), STATE)).compile
        )
        start = fresh(shared, keys)
        jax.block_until_ready(built.program(shared, start))  # the first call also loads the program
        built.config = config
        return built.calling(lambda state: built.program(shared, start if state is None else state))

    def measure(built: Built, request: Request) -> dict[str, Any]:
        config = built.config
        state = None
        begin = time.monotonic()
        reached: list[float | None] = [None] * config.seeds
        mean = 0.0
        updates = 0
        seconds = 0.0
        while updates < config.num_updates and mean < LEVEL and request.left > 0.0:
            state, curves = built.call(state)
            rates = np.asarray(curves["success_rate"])[: config.seeds, -1]
            updates += 1
            mean = float(rates.mean())
            seconds = time.monotonic() - begin
            reached = [
                at if at is not None or rate < LEVEL else seconds
                for at, rate in zip(reached, rates, strict=True)
            ]
        return {
            "environments": config.ppo.num_envs,
            "reached": mean >= LEVEL,
            "success": mean,
            "seconds": seconds,
            "each_seed": reached,
            "steps": updates * config.ppo.batch_size,
            "samples_per_s": config.seeds * updates * config.ppo.batch_size / max(seconds, 1e-9),
        }

    jobs = []
    for task in request.tasks:
        preset = largest(configs() / f"{task}.yaml")
        jobs.append(
            Job(
                {"task": task, "preset": preset, "seeds": request.seeds},
                partial(prepare, task, preset),
                measure,
            )
        )
    yield from measured(jobs, request)


def filters(request: Request) -> Iterator[dict[str, Any]]:
    """Measure calls a second. The recommended filter of each task is measured first."""
    import jax
    import rta

    import jaxsafe
    from jaxsafe.envs import TASKS

    batches = sizes_here().filters
    pool = ThreadPoolExecutor(len(request.tasks))
    met = {task: pool.submit(rta.met, jaxsafe.make(task), max(batches)) for task in request.tasks}

    def prepare(task: str, preset: str) -> Any:
        env = jaxsafe.make(task, rta=preset)
        sims, _, desired = met[task].result()
        given = (sims, rta.memories(env, sims), desired)
        parts = [jax.tree.map(lambda x, batch=batch: x[:batch], given) for batch in batches]
        built = Built(lambda: [rta.filter_batch.lower(env, *part).compile() for part in parts])
        return built.calling(lambda index: built.programs[index](env, *parts[index]))

    def measure(built: Built, request: Request) -> dict[str, Any]:
        seconds = [
            statistics.median(timed(lambda _, index=index: built.call(index), 5 * request.repeats))
            for index in range(len(batches))
        ]
        return {
            "calls_per_s": {
                str(batch): batch / median for batch, median in zip(batches, seconds, strict=True)
            }
        }

    jobs = []
    named = {
        task: [name for name in TASKS[task].filters if name != "default"] for task in request.tasks
    }
    for turn in zip_longest(*named.values()):  # the first filter of each task is its default
        for task, preset in zip(named, turn, strict=True):
            if preset:
                jobs.append(
                    Job({"task": task, "filter": preset}, partial(prepare, task, preset), measure)
                )
    yield from measured(jobs, request, len(request.tasks))


def sizes_here() -> Sizes:
    """Return how large the measurements are on this device."""
    import jax

    return CPU if jax.default_backend() == "cpu" else ACCELERATOR


class Built:
    """Compiled programs and how to call them.

    It also knows how long they took to compile, and how much memory the last of them needs.
    """

    call: Callable[[Any], Any]
    config: Any = None

    def __init__(self, compile_: Callable[[], Any]) -> None:
        """Compile the programs. `compile_` returns one of them or a list."""
        begin = time.monotonic()
        built = compile_()
        self.programs = built if isinstance(built, list) else [built]
        self.compile_s = time.monotonic() - begin
        sizes = [
            getattr(program.memory_analysis(), "temp_size_in_bytes", None)
            for program in self.programs
        ]
        self.temporary = sizes[-1]

    @property
    def program(self) -> Any:
        """The only program."""
        return self.programs[0]

    def calling(self, call: Callable[[Any], Any]) -> Built:
        """Set how the programs are called, and return this object."""
        self.call = call
        return self


def measured(
    jobs: Sequence[Job], request: Request, size: int = sys.maxsize
) -> Iterator[dict[str, Any]]:
    """Measure jobs in rounds. Yield a row for each job, or why it was skipped.

    The jobs of a round compile side by side, at most two a core, and are then measured one after
    another, so that nothing is measured while something compiles. If the time is too short for
    another round as long as the longest one, the rest is skipped. A row is marked if it was
    measured although some program of its round was still compiling.

    Args:
        jobs: the jobs in their order.
        request: what the part is asked for.
        size: the largest number of jobs of a round.
    """
    size = min(size, 2 * usable_cores())
    longest = 0.0
    for first in range(0, len(jobs), size):
        jobs_now = jobs[first : first + size]
        begin = time.monotonic()
        if longest > request.left or request.left <= 0.0:
            yield from ({"skipped": f"{named(job)}: out of time"} for job in jobs[first:])
            return
        pool = ThreadPoolExecutor(len(jobs_now))
        futures = [pool.submit(job.prepare) for job in jobs_now]
        wait(futures, timeout=COMPILING * request.left)
        compiling = not all(future.done() for future in futures)
        for job, future in zip(jobs_now, futures, strict=True):
            if not future.done():
                yield {"skipped": f"{named(job)}: not compiled in time"}
            elif (error := future.exception()) is not None:
                yield {"skipped": f"{named(job)}: {type(error).__name__}: {str(error)[:300]}"}
            elif request.left <= 0.0:
                yield {"skipped": f"{named(job)}: out of time"}
            else:
                yield row_of(job, future.result(), request) | (
                    {"beside_compilation": True} if compiling else {}
                )
        longest = max(longest, time.monotonic() - begin)
        if compiling:
            yield from ({"skipped": f"{named(job)}: out of time"} for job in jobs[first + size :])
            return


def row_of(job: Job, built: Built, request: Request) -> dict[str, Any]:
    """Measure a job that is compiled. If the device fails, only this row is skipped."""
    try:
        measurements = job.measure(built, request)
    except Exception as error:
        return {"skipped": f"{named(job)}: {type(error).__name__}: {str(error)[:300]}"}
    return {
        **job.row,
        **measurements,
        "compile_s": round(built.compile_s, 1),
        "temporary_bytes": built.temporary,
    }


def named(job: Job) -> str:
    """Return what a job that is skipped is called in the results."""
    return ", ".join(f"{key} {value}" for key, value in job.row.items())


def timed(run: Callable[[int], Any], repeats: int) -> list[float]:
    """Return the seconds of some calls. One call before them is not counted."""
    import jax

    seconds = []
    for seed in range(repeats + 1):
        begin = time.perf_counter()
        jax.block_until_ready(run(seed))
        seconds.append(time.perf_counter() - begin)
    return seconds[1:]


def largest(recipes: Path) -> str:
    """Return the name of the recipe with the most environments."""
    from jaxsafe.schema import yaml12

    content = yaml12.read(recipes)
    return max(content, key=lambda name: content[name]["ppo"]["num_envs"])


class Part(NamedTuple):
    """A part of the measurements and its share of the time."""

    run: Callable[[Request], Iterator[dict[str, Any]]]
    share: float


PARTS = {
    "numbers": Part(numbers, 0.27),
    "environments": Part(environments, 0.20),
    "ppo": Part(ppo, 0.22),
    "learning": Part(learning, 0.18),
    "filters": Part(filters, 0.13),
}

if __name__ == "__main__":
    main()
