"""One call scores a policy or a function on a task; its network as ONNX; actions between those of the grid."""

import json
from pathlib import Path

import gymnasium
import numpy as np
import pytest

import envs
from dqn import policy as policies
from experiments import score
from experiments.cli import frame

SHIPPED = Path(policies.__file__).parent / "shipped"
TASKS = [("relative", "policy"), ("coculture", "coculture"), ("coculture_preview", "coculture_preview")]


def scored(folder: Path, *words: str) -> dict[str, float]:
    score.score(score.main.config(words), folder)
    return json.loads((folder / "summary.json").read_text())


def test_a_file_and_a_function_that_acts_like_it_have_one_score(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    file = str(SHIPPED / "policy.npz")
    source = f"import dqn.policy, pathlib\nact = dqn.policy.load(pathlib.Path({file!r})).act"
    Path("as_shipped.py").write_text(source)
    by_file, by_function = (
        scored(tmp_path, f"policy={name}", "env=relative") for name in (SHIPPED / "policy.npz", "as_shipped:act")
    )
    assert {**by_file, "policy": ""} == {**by_function, "policy": ""}
    assert 0.0 <= by_file["regret_pct"] < 1.0
    assert (tmp_path / "figures").is_dir()
    assert (tmp_path / "report.html").is_file()


@pytest.mark.parametrize(
    "words",
    [[], ["policy=nobody:act"], ["policy=json:nothing"], ["policy=os:sep"], ["policy=none.npz"],
     ["policy=json:dumps"], ["policy=json:dumps", "onnx=a.onnx"], [f"policy={SHIPPED / 'policy.npz'}"]],
    ids=str,
)  # fmt: skip
def test_what_cannot_be_scored_is_refused(tmp_path, words):
    with pytest.raises((frame.UserError, TypeError)):
        score.score(score.main.config(words), tmp_path)
    assert not (tmp_path / "summary.json").exists()


@pytest.mark.parametrize("name", [policy for _, policy in TASKS])
def test_the_network_as_onnx_gives_the_same_values(tmp_path, name):
    """Also far outside the limits of the observation."""
    runtime = pytest.importorskip("onnxruntime")
    onnx = pytest.importorskip("dqn.onnx")
    policy = policies.load(SHIPPED / f"{name}.npz")
    onnx.write(policy, tmp_path / "policy.onnx")
    session = runtime.InferenceSession(tmp_path / "policy.onnx")
    seen = np.random.default_rng(7).normal(scale=30.0, size=(301, policy.low.size)).astype(np.float32)
    expected = policy.q_values(seen)
    np.testing.assert_allclose(session.run(None, {"observation": seen})[0], expected, rtol=1e-4, atol=1e-3)
    assert json.loads(session.get_modelmeta().custom_metadata_map["actions"]) == policy.actions.tolist()


@pytest.mark.parametrize("name", envs.gym_adapter.REGISTERED)
def test_a_number_between_the_actions_lies_between_their_ends(name):
    """On the grid it is the action itself, in one copy as in several; anything outside 0 to 1 is refused."""
    n = 17
    grid = gymnasium.make(name, episode_steps=n + 1).unwrapped
    one = gymnasium.make(name, continuous=True, episode_steps=n + 1).unwrapped
    many = gymnasium.make_vec(name, num_envs=1, continuous=True, episode_steps=n + 1)
    for env in (grid, one, many):
        env.reset(seed=5)
    for k in range(n):
        share = np.array([k / (n - 1)])
        expected = grid.step(k)[0]
        np.testing.assert_allclose(one.step(share)[0], expected, rtol=1e-6)
        np.testing.assert_allclose(many.step(share[None])[0][0], expected, rtol=1e-6)
    for wrong in (1.1, -0.1, np.nan):
        with pytest.raises(ValueError, match="action"):
            one.step(np.array([wrong]))
    with pytest.raises(ValueError, match="action"):
        many.step(np.array([0.5]))
