"""Environments on a device are those in lanes, and their arrays stay there."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from support.device_arrays import DeviceArray, KeptApart
from support.targets import needs_compiler

from spacerobot_ros.batch.targets import THREADS_OF_HOST, device_named
from spacerobot_ros.environments import episodes
from spacerobot_ros.environments.tasks import Reorient, Task
from spacerobot_ros.errors import ParameterError, SpaceRobotError

pytestmark = pytest.mark.usefixtures("compiled")

ARM, REACH, OWN = "spacerobot/ReorientArm-v0", "spacerobot/Reach-v0", "spacerobot/Task-v0"

CAMPAIGN = """
campaign:
  scenario: planar_chain
  flights: 5
  seed: 1
  disperse:
    mass.*: {uniform: [0.9, 1.1]}
    initial.position.x: {uniform: [-0.1, 0.1]}
    goal.rotvec.z: {uniform: [-0.1, 0.1]}
"""


@pytest.fixture(params=["host", "kept apart", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a device: that of this processor, also with arrays kept apart, or CUDA."""
    if request.param == "kept apart":
        monkeypatch.setattr(episodes, "device_named", lambda name: KeptApart.of_host())
        return "cuda"
    try:
        device_named(request.param)
    except SpaceRobotError as error:
        pytest.skip(str(error))
    return str(request.param)


def on_host(values: Any) -> Any:
    """Return an array of a device as one of NumPy."""
    if isinstance(values, DeviceArray):
        return values.numbers
    return values.get() if hasattr(values, "get") else values


@needs_compiler
@pytest.mark.parametrize(
    ("name", "count", "arguments"),
    [
        (ARM, 5, {"scenario": "planar_chain", "hold": 2, "time_limit": 0.5}),
        pytest.param(
            REACH, 9, {"hold": 2, "time_limit": 0.5, "tolerance": 0.2}, marks=pytest.mark.slow
        ),
        pytest.param(
            OWN, 5, {"task": "reorient", "scenario": "servicer", "max_force": 20.0,
                     "max_torque": 10.0, "action_scale": [0.1] * 6 + [20.0] * 3 + [10.0] * 3,
                     "hold": 3, "time_limit": 0.4}, marks=pytest.mark.slow
        ),
    ],
)  # fmt: skip
def test_steps_and_ends_on_a_device_are_those_in_lanes(
    device: str, name: str, count: int, arguments: dict[str, Any]
) -> None:
    """The same goals and actions, with resets by a mask, for 120 steps."""
    there, here = (
        gymnasium.make_vec(name, count, autoreset_mode="Disabled", **arguments, **more)
        for more in ({"device": device}, {})
    )
    rng = np.random.default_rng(2)
    mask, seen, ended = np.ones(count, dtype=np.bool_), 0, 0
    for step in range(120):
        if mask.any():
            here.reset(seed=step, options={"reset_mask": mask})
            goals = here.unwrapped.episodes.goals
            observed, _ = there.reset(seed=1, options={"reset_mask": mask, "goal": goals})
            np.testing.assert_allclose(
                on_host(observed), here.unwrapped.episodes.observations, rtol=0.0, atol=1e-12
            )
            seen += 1
        actions = rng.uniform(-1.2, 1.2, here.action_space.shape)
        wanted = here.step(actions)
        made = there.step(there.unwrapped.episodes.flights.arrays.asarray(actions))
        for one, two in zip(made[:4], wanted[:4], strict=True):
            assert type(one) is type(there.unwrapped.episodes.flights.pose)
            np.testing.assert_allclose(
                on_host(one).astype(float), two.astype(float), rtol=1e-12, atol=1e-12
            )
        np.testing.assert_allclose(on_host(made[4]["error"]), wanted[4]["error"], atol=1e-12)
        mask = wanted[2] | wanted[3]
        ended += int(mask.sum())
    assert seen > 5
    assert ended >= 5 * count


@needs_compiler
def test_single_precision_is_that_of_all_arrays() -> None:
    """Steps differ from those with 64 bits by rounding."""
    arguments = {"scenario": "planar_chain", "hold": 20}
    seen = {}
    for device in ("host", "host:single"):
        vector = gymnasium.make_vec(ARM, 8, device=device, **arguments)
        vector.reset(seed=1)
        rng = np.random.default_rng(1)
        for _ in range(10):
            actions = rng.uniform(-0.2, 0.2, vector.action_space.shape)
            observations, rewards, *_ = vector.step(actions)
        seen[device] = observations
        assert observations.dtype == rewards.dtype == vector.action_space.dtype
        assert vector.observation_space.contains(observations)
    assert seen["host:single"].dtype == np.float32
    difference = np.abs(seen["host:single"] - seen["host"]).max()
    assert 1e-9 < difference < 1e-4


@needs_compiler
@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_robots_restart_on_the_device(device: str, mode: str, tmp_path: Path) -> None:
    """Each episode begins at the start and goal of a draw, with its masses."""
    file = tmp_path / "chain.yaml"
    file.write_text(CAMPAIGN, encoding="utf-8")
    arguments = {"campaign": str(file), "hold": 4, "time_limit": 0.8, "tolerance": 1e-9}
    vector = gymnasium.make_vec(ARM, 7, autoreset_mode=mode, device=device, **arguments)
    inner = vector.unwrapped.episodes
    first, _ = vector.reset(seed=5)
    starts = {tuple(np.round(row, 12)) for row in on_host(inner.flights.pose)[:, :3]}
    goals = {tuple(np.round(row, 12)) for row in on_host(inner.goals)}
    again, _ = vector.reset(seed=5)
    np.testing.assert_array_equal(on_host(first), on_host(again))
    actions = inner.flights.arrays.asarray(np.ones(vector.action_space.shape))
    ends = 0
    for _ in range(50):
        seen, _, terminated, truncated, infos = vector.step(actions)
        ended = on_host(terminated) | on_host(truncated)
        ends += int(ended.sum())
        if mode == "SameStep" and ended.any():
            moved = np.abs(on_host(infos["final_obs"]) - on_host(seen)).max(axis=1)
            assert (moved[ended] > 1e-3).all()
            assert on_host(inner.flights.ticks)[ended].max() == 0
        starts |= {
            tuple(np.round(row, 12))
            for row in on_host(inner.flights.pose)[on_host(inner.flights.ticks) == 0, :3]
        }
        goals |= {tuple(np.round(row, 12)) for row in on_host(inner.goals)}
    assert ends >= 14
    # Five draws, of which the seven robots began with the first two twice.
    assert len(starts) == len(goals) == 5


@needs_compiler
def test_random_goals_on_a_device_are_within_their_spread(device: str) -> None:
    vector = gymnasium.make_vec(ARM, 500, scenario="planar_chain", device=device, spread=0.3)
    seen, infos = vector.reset(seed=3)
    errors = on_host(infos["error"])
    np.testing.assert_allclose(np.linalg.norm(on_host(seen)[:, :3], axis=1), errors, rtol=1e-9)
    # Even between zero and the spread, by five standard deviations.
    assert errors.max() <= 0.3
    assert abs(errors.mean() - 0.15) < 5 * 0.3 / np.sqrt(12 * 500)
    other, _ = vector.reset(seed=4)
    assert np.abs(on_host(other) - on_host(seen)).max() > 1e-3
    chain = {"scenario": "planar_chain", "link": "segment_2"}
    link = gymnasium.make_vec(REACH, 50, device=device, spread=0.1, **chain)
    _, infos = link.reset(seed=3)
    assert 0.05 < on_host(infos["error"]).max() <= 0.1


@needs_compiler
def test_sensors_err_on_a_device(device: str, tmp_path: Path) -> None:
    """By the noise of all and the bias of each draw; rewards are of the true states."""
    file = tmp_path / "chain.yaml"
    noise = "set: {plant.sensors.joint_noise: 0.02}"
    biased = "plant.sensors.velocity_noise: {uniform: [0.0, 0.1]}"
    chosen = CAMPAIGN.replace("  seed: 1\n", f"  seed: 1\n  {noise}\n")
    file.write_text(f"{chosen}    {biased}\n", encoding="utf-8")
    vector = gymnasium.make_vec(ARM, 400, campaign=str(file), device=device, time_limit=0.05)
    inner = vector.unwrapped.episodes
    vector.reset(seed=3)
    actions = inner.flights.arrays.asarray(np.zeros(vector.action_space.shape))
    errors, velocities = [], []
    for _ in range(12):
        seen, _, _, _, infos = vector.step(actions)
        flights, n = inner.flights, inner.robot.n
        q, twist = on_host(flights.q), on_host(flights.twist)
        errors.append(on_host(seen)[:, 3 : 3 + n] - q)
        velocities.append(np.std(on_host(seen)[:, 3 + 2 * n :][:, :3] - twist[:, :3]))
        remaining = inner.task.remaining(inner.flights, inner.goals)
        np.testing.assert_allclose(
            on_host(infos["error"]), np.linalg.norm(on_host(remaining), axis=1), rtol=1e-9
        )
    assert len({each[0, 0] for each in errors}) == 12
    assert abs(np.std(errors) / 0.02 - 1.0) < 5.0 / np.sqrt(2 * np.size(errors))
    assert 0.01 < np.mean(velocities) < 0.1


class Alone(Reorient):
    """Draws its goals one by one."""

    name = "alone"
    random_goals = Task.random_goals


@pytest.mark.parametrize(
    ("name", "arguments", "part"),
    [
        (REACH, {"scenario": "faults/noisy_sensors", "link": "mass_1"}, "sensor errors of links"),
        (ARM, {"scenario": "servicer_thrusters"}, "actuator faults, on/off thrusters, dist"),
        (OWN, {"task": Alone}, "task 'alone', which has no random_goals"),
    ],
)
def test_what_devices_do_not_support_is_refused(
    name: str, arguments: dict[str, Any], part: str
) -> None:
    with pytest.raises(ParameterError, match=f"'device' is 'host', but devices do not .* {part}"):
        gymnasium.make_vec(name, 2, device="host", **arguments)


def test_devices_have_many_robots_and_no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ParameterError, match=r"single environments; use gymnasium\.make_vec"):
        gymnasium.make(ARM, device="host")
    with pytest.raises(ParameterError, match="There is no device 'gpu': use cuda, cuda:1, "):
        gymnasium.make_vec(ARM, 2, device="gpu")
    with pytest.raises(TypeError, match="Environments on a device have no pictures"):
        gymnasium.make_vec(ARM, 2, device="host", render_mode="rgb_array")
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    with pytest.raises(SpaceRobotError, match=f"'{THREADS_OF_HOST.name}' has no program: "):
        gymnasium.make_vec(ARM, 2, scenario="planar_chain", device="host")


@pytest.mark.slow
@pytest.mark.gpu
@pytest.mark.parametrize("precision", ["", ":single"], ids=["double", "single"])
@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        (ARM, {}),
        (OWN, {"task": "reorient", "scenario": "servicer", "max_force": 1.0, "max_torque": 1.0}),
    ],
)
def test_a_device_has_its_rate_of_steps(
    name: str, arguments: dict[str, Any], precision: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """With observation, reward and restarts; the rate is printed by `make gpu`."""
    count, steps, given = 131_072, 50, {"hold": 10, "time_limit": 5.0, **arguments}
    try:
        target = device_named(f"cuda{precision}")
    except SpaceRobotError as error:
        pytest.skip(str(error))
    vector = gymnasium.make_vec(
        name, count, autoreset_mode="SameStep", device=f"cuda{precision}", **given
    )
    vector.reset(seed=1)
    arrays = target.arrays
    actions = 0.1 * arrays.random.default_rng(1).random(vector.action_space.shape)
    vector.step(actions)
    began = time.perf_counter()
    for _ in range(steps):
        seen, rewards, *_ = vector.step(actions)
    finite = bool(arrays.isfinite(seen).all() & arrays.isfinite(rewards).all())
    rate = count * steps / (time.perf_counter() - began)
    with capsys.disabled():
        print(f"\n{name} {arguments.get('scenario', '')} {target.name}: {rate:.3g} steps/s")
    assert finite
    assert rate > 1e6
