"""Films last as long as what they show: the rate that an environment states is that of its own steps, for all who read it."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecMonitor, VecVideoRecorder
from test_over import SHEET, Count

from clothgym import Material
from clothgym.adapters.sb3 import ClothSB3VecEnv, make_sb3_vec_env
from clothgym.envs import ClothDrapeGripperEnv, ClothEnv, ClothVectorEnv, Physics
from clothgym.playground.exporting import export, stage_named


def kinds(time_step):
    """A single environment and a batch with that time step [s]."""
    physics = Physics(
        mesh=SHEET, material=Material(), time_step=time_step, integrator="semi_implicit_euler", substeps="auto",
        attachment_speed=0.5, anchors=SHEET.corners[2:],
    )  # fmt: skip
    task = type("Timed", (Count,), {"physics": physics})
    return type("TimedEnv", (ClothEnv,), {"task_class": task}), type("TimedVectorEnv", (ClothVectorEnv,), {"task_class": task})


def seconds_of_a_step(env):
    """What a step has lasted, by the simulation's own count of control steps [s]."""
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape, np.float32))
    simulation = env.unwrapped.task.simulation
    return float(simulation.get_state().steps[0]) * simulation.time_step


@pytest.mark.parametrize(
    ("env_id", "kwargs", "rate"),
    [("Reach", {}, 15), ("DrapeGripper", {}, 30), ("DrapeGripper", {"action_mode": "pick_place"}, 0.5)],
)
def test_the_rate_is_that_of_the_steps(env_id, kwargs, rate):
    name = f"clothgym:Cloth{env_id}-v0"
    for env in (gym.make(name, **kwargs), gym.make_vec(name, num_envs=2, **kwargs)):
        assert env.metadata["render_fps"] == rate == pytest.approx(1 / seconds_of_a_step(env))
        assert isinstance(env.metadata["render_fps"], type(rate))


@pytest.mark.parametrize("time_step", [1 / 15, 0.04, 0.03, 0.5])
def test_the_rate_follows_the_time_step_of_a_task(time_step):
    single, batch = kinds(time_step)
    assert single.metadata["render_fps"] == pytest.approx(1 / time_step)
    for env in (single(), batch(2)):
        assert env.metadata["render_fps"] == pytest.approx(1 / time_step) == pytest.approx(1 / seconds_of_a_step(env))


@pytest.mark.parametrize("kwargs", [{}, {"action_mode": "pick_place"}])
def test_all_recorders_read_it(kwargs, tmp_path):
    name, seen = "ClothDrapeGripper-v0", {"render_mode": "rgb_array", "width": 16, "height": 16, **kwargs}
    rate = 0.5 if kwargs else 30
    sb3 = make_sb3_vec_env(name, 2, **seen)
    assert sb3.metadata["render_fps"] == rate and sb3.metadata["render_modes"] == ["rgb_array", "depth_array"]
    recorders = [
        VecVideoRecorder(sb3, str(tmp_path / "a"), lambda step: False),
        VecVideoRecorder(VecMonitor(make_sb3_vec_env(name, 2, **seen)), str(tmp_path / "b"), lambda step: False),
        gym.wrappers.RecordVideo(gym.make(name, **seen), str(tmp_path / "c"), lambda episode: False),
        gym.wrappers.vector.RecordVideo(gym.make_vec(name, num_envs=2, **seen), str(tmp_path / "d"), lambda episode: False),
    ]
    assert [recorder.frames_per_sec for recorder in recorders] == [rate] * 4


def test_sb3_recorder_uses_the_frame_rate_of_a_custom_task(tmp_path):
    single, batch = kinds(0.04)
    env = ClothSB3VecEnv(batch(2, autoreset_mode="SameStep", render_mode="rgb_array", width=16, height=16))
    assert VecVideoRecorder(env, str(tmp_path), lambda step: False).frames_per_sec == 25


def test_an_exported_film_lasts_as_long_as_the_episode(tmp_path):
    if "Picks-v0" not in gym.registry:
        gym.register("Picks-v0", entry_point=ClothDrapeGripperEnv, kwargs={"action_mode": "pick_place"})
    stage = stage_named("Picks-v0", 0, "noop", None)
    while not stage.over:
        frame = stage.advance()
    # four actions and one in which the sheet settles, of two seconds each
    assert stage.recording.time_step == 2.0 and frame.time == 10.0
    assert export("Picks-v0", tmp_path / "a.glb", policy="noop").endswith("6 frames, 12 s")
    assert export("Picks-v0", tmp_path / "b.gif", policy="noop", size=16, seconds=4.0).endswith("2 frames, 4 s")
    with pytest.raises(ValueError, match=r"fps=15: Picks-v0 has 0.5 frames a second"):
        export("Picks-v0", tmp_path / "c.gif", policy="noop", fps=15)


def test_the_film_of_a_training_run_too(tmp_path, monkeypatch, scripts):
    import drawing

    written = {}
    monkeypatch.setattr(drawing, "write_video", lambda path, frames, fps: written.update(frames=len(frames), fps=fps))
    kwargs = {"action_mode": "pick_place", "width": 16, "height": 16}
    drawing.film(
        tmp_path / "a.gif", "clothgym:ClothDrapeGripper-v0", lambda env, seen: np.zeros((2, 10)), kwargs, episodes=2, seed=0
    )
    assert written == {"frames": 6, "fps": 0.5}
