"""Networks are parts: the perceptron, a memory that PPO trains through time, and a user's own."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probe_environments import recall

import jaxsafe
from jaxsafe.agents.agent import Agent
from jaxsafe.agents.networks import GRU, MLP, from_one_draw, unroll
from jaxsafe.agents.policy_file import find_policy, load_policy, read_policy, save_policy
from jaxsafe.commands.export import main as export
from jaxsafe.commands.train import main as train
from jaxsafe.schema.component import normalise
from jaxsafe.schema.errors import ConfigError
from jaxsafe.train import ppo as ppo_module
from jaxsafe.train.host.options import resolve
from jaxsafe.train.hyperparameters import PPO
from jaxsafe.train.ppo import collect, init, update

KEY = jax.random.key(3)
RESIDUAL = """
from flax import linen
from jaxsafe.parts import Network


class Block(linen.Module):
    width: int
    num_outputs: int
    output_gain: float

    @linen.compact
    def __call__(self, inputs):
        x = linen.Dense(self.width)(inputs)
        x = x + linen.tanh(linen.Dense(self.width)(x))
        start = linen.initializers.orthogonal(self.output_gain)
        return linen.Dense(self.num_outputs, kernel_init=start)(x)


class Residual(Network, type="residual"):
    width: int = 8

    def module(self, num_outputs, output_gain):
        return Block(self.width, num_outputs, output_gain)
"""
TINY = [
    "env=docking2d",
    "steps=64",
    "ppo.num_envs=4",
    "ppo.num_steps=8",
    "ppo.num_epochs=1",
    "ppo.num_minibatches=2",
    "episodes=2",
    "eval_episodes=2",
    "env.terminal.timeout.limit=20",
    "out=run",
]
RECURRENT = normalise(Agent(actor=GRU(hidden=(16,), units=16)))
SMALL = normalise(
    PPO(num_envs=16, num_steps=12, num_epochs=8, num_minibatches=2, gamma=0.9, gae_lambda=0.95)
)


@pytest.mark.parametrize("hidden", [(), (5,), (7, 3)])
def test_a_perceptron_is_the_formula_and_starts_orthogonal(hidden: tuple[int, ...]) -> None:
    network = MLP(hidden=hidden)
    module = network.module(2, 0.01)
    x = jax.random.normal(KEY, (6, 4))
    params = from_one_draw(KEY, lambda normal: network.init(KEY, normal, module, x[0]))
    expected = np.asarray(x)
    for index, layer in enumerate(params.values()):
        kernel = np.asarray(layer["kernel"])
        gain = 0.01 if index == len(hidden) else np.sqrt(2.0)
        short = kernel if kernel.shape[0] <= kernel.shape[1] else kernel.T
        np.testing.assert_allclose(short @ short.T, gain**2 * np.eye(len(short)), atol=1e-5)
        np.testing.assert_array_equal(layer["bias"], 0.0)
        expected = expected @ kernel
        expected = np.tanh(expected) if index < len(hidden) else expected
    np.testing.assert_allclose(module.apply({"params": params}, x), expected, rtol=1e-4, atol=1e-6)


def test_actor_and_critic_may_differ() -> None:
    agent = Agent(actor=MLP(hidden=(8,)), critic=MLP(hidden=(4, 4), layer_norm=True))
    params = normalise(agent).init(KEY, jaxsafe.make("docking2d"))
    assert params["actor"]["hidden_0"]["kernel"].shape == (6, 8)
    assert params["critic"]["hidden_1"]["kernel"].shape == (4, 4)
    np.testing.assert_array_equal(params["critic"]["norm_0"]["scale"], 1.0)


def test_unrolling_is_a_loop_that_begins_anew_with_each_episode() -> None:
    x = jax.random.normal(KEY, (3, 7, 2))
    done = jax.random.bernoulli(KEY, 0.3, (3, 7))
    add = lambda memory, x: (memory + x, 2.0 * memory + x)  # noqa: E731
    memory, outputs = unroll(add, jnp.ones((3, 2)), jnp.full(2, 5.0), x, done)
    for n in range(3):
        expected = jnp.ones(2)
        for t in range(7):
            np.testing.assert_allclose(outputs[n, t], 2.0 * expected + x[n, t], rtol=1e-5)
            expected = jnp.full(2, 5.0) if done[n, t] else expected + x[n, t]
        np.testing.assert_allclose(memory[n], expected, rtol=1e-5)


@pytest.mark.thorough
@pytest.mark.parametrize("critic", [None, MLP(hidden=(8,))])
def test_sequences_are_replayed_as_they_were_flown(critic: MLP | None) -> None:
    """Before anything is learnt, every probability is the one that the action was drawn with."""
    env = recall(steps=5)
    agent = RECURRENT.replace(critic=critic)
    state = init(env, agent, SMALL, KEY)
    for index in range(2):  # the second batch begins in the middle of episodes
        memory = state.memory
        state, transitions = collect(env, agent, SMALL, state, jax.random.key(index))
        gamma = jnp.asarray(0.9)
        state, batch, _ = ppo_module._to_batch(
            agent, SMALL, gamma, state, transitions, memory, None
        )
        policy = agent.distribution(env, state.params, batch.inputs, batch.sequences)
        np.testing.assert_allclose(policy.log_prob(batch.action), batch.log_prob, atol=1e-5)
        target = ppo_module.gae(
            transitions.reward,
            *ppo_module._judge(
                agent,
                state.params,
                "critic",
                memory["critic"],
                agent.critic_inputs(transitions.inputs, {}),
                agent.critic_inputs(transitions.next_inputs, {}),
                transitions.done,
            )[:2],
            transitions.terminated,
            transitions.done,
            gamma,
            SMALL.gae_lambda,
        )
        value = agent.critic_output("critic", state.params, batch.inputs, batch.sequences)
        np.testing.assert_allclose(value + target.T, batch.value_target, atol=1e-5)


@pytest.mark.thorough
@pytest.mark.parametrize(("actor", "solves"), [(GRU(hidden=(16,), units=16), True), (MLP(), False)])
def test_only_a_memory_learns_what_was_seen_at_the_start(actor: Any, solves: bool) -> None:
    """Episodes of 5 steps cross the 12 steps of a batch, so memory must last between updates."""
    env, agent, updates = recall(steps=5), normalise(Agent(actor=actor)), 120
    ppo = SMALL.replace(learning_rate=jnp.asarray(5e-3), final_learning_rate=jnp.asarray(1e-3))

    def run(key: jax.Array) -> Any:
        start = init(env, agent, ppo, key)
        return jax.lax.fori_loop(
            0, updates, lambda _, state: update(env, agent, ppo, updates, state)[0], start
        )

    state = jax.jit(run)(KEY)
    policy = agent.policy(env, state.params, True)
    metrics = jaxsafe.evaluate(env, policy, KEY, num_episodes=64)
    # Without a memory the best push after the first step is 0, which costs 0.25 on each of four.
    assert (metrics["average_return"] > 4.9) == solves  # type: ignore[operator]
    assert metrics["average_return"] > 3.8  # type: ignore[operator]
    steps = jaxsafe.rollout(env, policy, KEY, num_steps=20, num_envs=8)
    single = jaxsafe.rollout(env, policy, KEY, num_steps=20)
    assert (float(steps.reward.mean()) > 0.96) == solves
    assert (float(single.reward.mean()) > 0.96) == solves


@pytest.mark.thorough
def test_a_run_with_a_memory_is_trained_evaluated_kept_and_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert train([*TINY, "agent.actor={type: gru, hidden: [8], units: 4}"]) == 0
    policy = load_policy("run/policy/seed_0.npz")
    env = jaxsafe.make("docking2d")
    steps = jaxsafe.rollout(env, policy, KEY, num_steps=3, num_envs=2)
    assert np.isfinite(steps.reward).all()
    assert read_policy("run/policy/seed_0.npz").agent.actor == GRU(hidden=(8,), units=4)
    for form in ("onnx", "stablehlo"):
        with pytest.raises(ConfigError, match="which remembers; an exported function has no"):
            export(["run=run/policy/seed_0.npz", f"format={form}"])


@pytest.mark.thorough
def test_a_network_of_a_users_module_is_trained_and_read_in_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("residual_network.py").write_text(RESIDUAL, encoding="utf-8")
    words = [*TINY, "agent.actor={type: 'residual_network:Residual', width: 6}"]
    again = [word for word in TINY if not word.startswith("out=")]
    for command in (
        ["train", *words],
        ["evaluate", "run=run", "episodes=2"],
        ["train", *again, "from=run", "out=again"],
    ):
        done = subprocess.run(
            [sys.executable, "-m", f"jaxsafe.{command[0]}", *command[1:]],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    assert "residual_network" in Path("run/config.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"agent.actor": "mpl"},
            r"agent.actor: found 'mpl'. Did you mean 'mlp'\? Choose from mlp, directional, gru",
        ),
        ({"agent.actor.width": 3}, "agent.actor.width: unknown option 'width'; choose from"),
        (
            {"agent.actor.activation": "tan"},
            r"agent.actor.activation: found 'tan'. Did you mean 'tanh'\? Choose from",
        ),
        ({"agent.critic": {"type": "mlp", "hidden": [0]}}, r"agent.critic.hidden.\[0\]: expected"),
        ({"agent.actor": "nowhere:Net"}, "cannot import 'nowhere'"),
        ({"agent.actor": "math:Net"}, "agent.actor: math has no Network with a type called 'Net'"),
        (
            {"agent.actor": "gru", "ppo.num_envs": 6, "ppo.num_minibatches": 4},
            "expected a divisor of ppo.num_envs = 6, because a network remembers, found 4",
        ),
        (
            {"agent.hidden": [8]},
            r"agent.hidden: unknown option 'hidden'. Did you mean 'agent.actor.hidden'\?",
        ),
    ],
)
def test_what_no_network_can_be_is_told_in_one_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        resolve({"env": "docking2d", **options})


def test_policies_of_the_first_format_are_read(tmp_path: Path) -> None:
    saved = read_policy(find_policy("docking2d"))
    file = tmp_path / "new.npz"
    save_policy(file, saved.env, saved.agent, saved.params, saved.about)
    arrays = dict(np.load(file))
    names = {"hidden_0": "0", "hidden_1": "1", "output": "2"}
    old = {}
    for name, array in arrays.items():
        parts = name.split("/")
        old["/".join(names.get(part, part) for part in parts)] = array
    header = str(old["header"]).replace("jaxsafe policy 2", "jaxsafe policy 1")
    actor = (
        '"actor": {"type": "mlp", "hidden": [64, 64], "activation": "tanh", "layer_norm": false}'
    )
    assert actor in header
    header = header.replace(actor, '"hidden": [64, 64]').replace('"critic": null, ', "")
    header = header.replace('{"type": "approach"}', '"approach"')
    np.savez(tmp_path / "old.npz", **{**old, "header": np.array(header)})
    read = read_policy(tmp_path / "old.npz")
    jax.tree.map(np.testing.assert_array_equal, read.params, saved.params)
    assert read.agent == saved.agent


def test_a_policy_file_never_imports_what_it_names(tmp_path: Path) -> None:
    saved = read_policy(find_policy("docking2d"))
    save_policy(tmp_path / "new.npz", saved.env, saved.agent, saved.params, saved.about)
    arrays = dict(np.load(tmp_path / "new.npz"))
    header = str(arrays["header"]).replace('"type": "mlp"', '"type": "antigravity:Net"')
    np.savez(tmp_path / "bad.npz", **{**arrays, "header": np.array(header)})
    with pytest.raises(ConfigError, match=r"agent.actor.imports: names .*antigravity"):
        read_policy(tmp_path / "bad.npz")
    assert "antigravity" not in sys.modules


def test_the_package_is_imported_without_flax() -> None:
    code = "import sys, jaxsafe; jaxsafe.make('docking2d'); print('flax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_a_network_that_does_not_fit_is_told() -> None:
    class Wrong(MLP, type="wrong_size"):
        def module(self, num_outputs: int, output_gain: float) -> Any:
            return super().module(num_outputs + 1, output_gain)

    message = r"agent.actor: expected 2 outputs, found \(3,\)"
    with pytest.raises(ConfigError, match=message):
        resolve({"env": "docking2d", "agent.actor": Wrong()})
