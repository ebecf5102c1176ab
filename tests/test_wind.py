"""The air: drag and lift against the formula worked out here, terminal velocity, gusts' statistics, and wind in environments."""

import gymnasium as gym
import numpy as np
import pytest
from test_envs import every_task, two_tasks

from clothgym import INTEGRATORS, Material, Simulation, State, Wind, grid
from clothgym.mesh import STRUCTURAL_X, ClothMesh, Springs, colored_hinges

NAMES = list(INTEGRATORS)
RHO, CD, CF = 1.2, 1.2, 0.02
SHEET = grid(6, 7, 0.3, 0.25)
AREA = 0.3 * 0.25


def formula(corners, velocity, wind, rho=RHO, cd=CD, cf=CF):
    """Force on one triangle [N]: along its normal ``rho/2 C_D A |u| u_n``, within its plane ``rho/2 C_F A |u| u_t``."""
    doubled = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    area, n = np.linalg.norm(doubled) / 2, doubled / np.linalg.norm(doubled)
    u = wind - velocity
    normal = (u @ n) * n
    return rho / 2 * area * np.linalg.norm(u) * (cd * normal + cf * (u - normal))


def accelerated(mesh, positions, velocities, wind, air_density, material, h=1e-6):
    """Momentum that one tiny substep gives to each particle, over its time [N]."""
    s = Simulation(
        mesh, material, air_density=air_density, wind=wind, gravity=(0, 0, 0), time_step=h, substeps=1, dtype="float64"
    )  # fmt: skip
    s.reset(positions=positions, velocities=velocities)
    before = s.velocities[0]
    s.step()
    return (s.velocities[0] - before) / s.get_state().free_inverse_mass[0][:, None] / h


def air(mesh, positions, velocities, wind, air_density=RHO, **properties):
    """Force of the air on each particle [N]: what is there with air, less what is there without."""
    with_air, without = Material(**properties), Material(**{**properties, "air_drag": 0.0})
    args = (mesh, positions, np.broadcast_to(velocities, positions.shape), wind)
    return accelerated(*args, air_density, with_air) - accelerated(*args, 0.0, without)


def tilted(angle):
    """The sheet turned about y: the edge at -x is the higher one, the normal leans from z towards +x."""
    x, y, _ = SHEET.rest_positions.T
    return np.stack([x * np.cos(angle), y, -x * np.sin(angle)], axis=1)


def one_triangle():
    positions = np.array([[0.0, 0, 0], [0.2, 0.03, 0.01], [-0.02, 0.1, 0.08]])
    ends = np.array([[0, 1]], np.int32)
    length = np.linalg.norm(positions[1] - positions[0], keepdims=True)
    springs = Springs(ends, length, np.array([STRUCTURAL_X], np.int32), np.ones(1))
    triangles = np.array([[0, 1, 2]], np.int32)
    return ClothMesh((1.0, 1.0), positions, springs, triangles, np.full(3, 0.003), colored_hinges(positions, triangles))


# --- the force ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_the_air_force_on_a_triangle_matches_the_formula(seed):
    rng = np.random.default_rng(seed)
    mesh = one_triangle()
    velocities, wind = rng.normal(size=(3, 3)), rng.normal(scale=3, size=3)
    force = air(mesh, mesh.rest_positions, velocities, wind)
    expected = formula(mesh.rest_positions, velocities.mean(axis=0), wind)
    assert force == pytest.approx(np.tile(expected / 3, (3, 1)), rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("properties", [{}, {"drag_coefficient": 0.7, "skin_friction": 0.1}, {"drag_coefficient": 0.0}])
@pytest.mark.parametrize("density", [1.2, 0.4])
def test_a_crumpled_sheet_feels_the_sum_over_its_triangles(properties, density):
    rng = np.random.default_rng(1)
    x = tilted(0.4) + rng.normal(scale=0.005, size=(SHEET.num_particles, 3))
    velocity, wind = np.array([0.3, -1.0, 0.5]), np.array([2.0, 0.7, -0.4])
    expected = sum(
        formula(x[t], velocity, wind, density, properties.get("drag_coefficient", CD), properties.get("skin_friction", CF))
        for t in SHEET.triangles
    )
    force = air(SHEET, x, velocity, wind, air_density=density, **properties).sum(axis=0)
    assert force == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("degrees", [0, 10, 30, 45, 70, 90])
def test_drag_and_lift_of_a_flat_plate(degrees):
    """At an angle of attack a: drag rho/2 A U^2 (C_D sin^2 + C_F cos^2), lift rho/2 A U^2 (C_D - C_F) sin cos."""
    a, speed = np.radians(degrees), 2.5
    fx, fy, fz = air(SHEET, tilted(a), 0.0, (speed, 0, 0)).sum(axis=0)
    push = RHO / 2 * AREA * speed**2
    assert fx == pytest.approx(push * (CD * np.sin(a) ** 2 + CF * np.cos(a) ** 2), rel=1e-5)
    # the edge that the wind meets is the higher one: the lift is upwards, as a kite's, and there is none face or edge on
    assert fz == pytest.approx(push * (CD - CF) * np.sin(a) * np.cos(a), rel=1e-5, abs=1e-8)
    assert abs(fy) < 1e-9
    assert (fz > 1e-3) == (0 < degrees < 90)
    # either face meets the wind alike
    assert air(SHEET, tilted(a), 0.0, (-speed, 0, 0)).sum(axis=0) == pytest.approx([-fx, 0, -fz], rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("mesh", [SHEET, grid(5, 5, 0.3, 0.3), grid(2, 3, 0.2, 0.1)])
def test_the_air_force_is_distributed_by_particle_area(mesh):
    """So the wind moves it as a whole, border and corners too."""
    force = air(mesh, mesh.rest_positions, 0.0, (0, 0, 3.0))
    assert force[:, 2] / mesh.area == pytest.approx(RHO / 2 * CD * 9.0, rel=1e-5)
    assert np.abs(force[:, :2]).max() < 1e-9


def test_there_is_no_force_at_zero_relative_velocity():
    wind = np.array([1.5, -0.5, 0.3])
    assert np.abs(air(SHEET, tilted(0.7), wind, wind)).max() < 1e-9
    # and only the difference of velocities counts
    moving = air(SHEET, tilted(0.7), wind + (1, 0, 2), wind)
    assert moving == pytest.approx(air(SHEET, tilted(0.7), 0.0, (-1, 0, -2)), rel=1e-5, abs=1e-9)


@pytest.mark.parametrize("substeps", [1, 8])
@pytest.mark.parametrize("num_envs", [1, 16])
@pytest.mark.parametrize("stretch", [1.0, 4.0])
@pytest.mark.parametrize("speed", [0.5, 2.0, 50.0])
def test_air_brings_a_sheet_to_a_stop_at_most(speed, stretch, num_envs, substeps):
    """A sheet with hardly any stiffness is thrown face on; speed: in units of that which the law stops in one step.

    Without the bound on the force the fastest sheet would fly back at 49 times its speed.  The force is the same in all substeps of
    2 ms, and the bound is of all of them together.
    """
    material, h = Material(density=0.15, stretch_stiffness=1e-3, shear_stiffness=1e-4, bend_rigidity=0, damping_time=1e-3), 2e-3
    stopped = 2 * material.density / (RHO * CD * h * stretch**2)
    s = Simulation(SHEET, material, num_envs, time_step=h, substeps=substeps, air_density=RHO, gravity=(0, 0, 0))
    s.reset(positions=SHEET.rest_positions * stretch, velocities=(0, 0, speed * stopped))
    s.step()
    assert s.velocities[..., 2] / (speed * stopped) == pytest.approx(max(1 - speed, 0.0), abs=1e-3)


def test_drag_grows_with_the_square_and_the_linear_drag_with_the_speed():
    def lift_off(speed, **kwargs):
        return air(SHEET, SHEET.rest_positions, 0.0, (0, 0, speed), **kwargs).sum(axis=0)[2]

    assert lift_off(2.0) == pytest.approx(4 * lift_off(1.0), rel=1e-6)
    assert lift_off(2.0, air_density=0.0) == 0
    # the linear drag is against still air, and asks for no normal
    linear = {"air_density": 0.0, "air_drag": 0.5}
    assert lift_off(2.0, **linear) == 0
    for velocity in ((0, 0, -1.0), (0, 0, -2.0), (-2.0, 0, 0)):
        slowed = air(SHEET, SHEET.rest_positions, velocity, (0, 0, 0), **linear).sum(axis=0)
        assert slowed == pytest.approx(-0.5 * AREA * np.array(velocity), rel=1e-4, abs=1e-9)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("density", [0.15, 0.05])
def test_a_flat_sheet_falls_at_the_terminal_velocity(name, density):
    """sqrt(2 m g/(rho C_D A)), 1.43 m/s for 0.15 kg/m2, after the time in which it is approached to a thousandth."""
    terminal = np.sqrt(2 * density * 9.81 / (RHO * CD))
    s = Simulation(grid(5, 5, 0.3, 0.3), Material(density=density), integrator=name, time_step=1 / 60, dtype="float64")
    s.step(int(5 * terminal / 9.81 * 60))
    mass = 1 / s.get_state().free_inverse_mass[0]
    mean = mass @ s.velocities[0] / mass.sum()
    assert mean[2] == pytest.approx(-terminal, rel=0.03)
    assert np.abs(mean[:2]).max() < 0.01 * terminal


@pytest.mark.parametrize("name", NAMES)
def test_a_free_sheet_drifts_with_the_wind(name):
    """Without weight, face on: v = w - w/(1 + k w t), k = rho C_D/(2 density)."""
    density, w = 0.05, 1.5
    s = Simulation(
        grid(5, 5, 0.3, 0.3), Material(density=density), integrator=name, gravity=(0, 0, 0), wind=(0, 0, w), time_step=1 / 60
    )
    s.step(30)
    expected = w - w / (1 + RHO * CD / (2 * density) * w * 0.5)
    assert s.velocities[0, :, 2] == pytest.approx(np.full(25, expected), rel=0.02)


def test_wind_differs_by_environment_and_is_part_of_the_state(tmp_path):
    winds = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0.0]])
    s = Simulation(grid(5, 5, 0.3, 0.3), num_envs=3, anchors=[0, 4])
    s.set_wind(winds)
    s.step(10)
    for env in range(3):
        alone = Simulation(grid(5, 5, 0.3, 0.3), anchors=[0, 4], wind=winds[env])
        alone.step(10)
        assert np.array_equal(alone.positions[0], s.positions[env])
    assert s.positions[1, :, 0].mean() > 5e-4 and s.positions[2, :, 1].mean() > s.positions[0, :, 1].mean() + 5e-4
    s.get_state().save(tmp_path / "state.npz")
    other = Simulation(grid(5, 5, 0.3, 0.3), num_envs=3, anchors=[0, 4])
    other.set_state(State.load(tmp_path / "state.npz"))
    s.step(5)
    other.step(5)
    assert np.array_equal(s.positions, other.positions)
    s.set_parameters([1], wind=(0, 0, 1))
    assert s.get_state().wind.tolist() == [[0, 0, 0], [0, 0, 1], [0, 3, 0]]


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: Simulation(SHEET, air_density=-1), "air_density=-1"),
        (lambda: Simulation(SHEET, air_density="thick"), "air_density='thick'"),
        (lambda: Simulation(SHEET, wind=(1, 0)), "wind"),
        (lambda: Simulation(SHEET, wind=(1, 0, np.nan)), "wind"),
        (lambda: Simulation(SHEET).set_wind((np.inf, 0, 0)), "wind"),
        (lambda: Simulation(SHEET, num_envs=3).set_wind(np.zeros((2, 3))), "wind has shape"),
        (lambda: Material(drag_coefficient=-0.1), "drag_coefficient=-0.1"),
        (lambda: Material(skin_friction=np.nan), "skin_friction"),
    ],
)
def test_bad_air_is_named(call, name):
    with pytest.raises(ValueError, match=name):
        call()


# --- wind and gusts -------------------------------------------------------------------------------------------------------


def test_gusts_have_the_mean_the_strength_and_the_memory_that_they_are_said_to_have():
    steps, time_step, gust, gust_time = 400_000, 1 / 30, 0.8, 0.5
    wind = Wind(speed=(2.0, 2.0), direction=(np.pi / 2, np.pi / 2), gust=gust, gust_time=gust_time)
    series = wind.series(np.random.default_rng(0), steps, time_step)
    assert series.shape == (steps, 3)
    assert series.mean(axis=0) == pytest.approx([0, 2, 0], abs=0.03)
    gusts = series - [0, 2, 0]
    assert np.sqrt(np.mean(gusts**2, axis=0)) == pytest.approx([gust] * 3, rel=0.02)
    lag = round(gust_time / time_step)
    for k, expected in ((1, np.exp(-time_step / gust_time)), (lag, np.exp(-1)), (3 * lag, np.exp(-3))):
        correlation = np.mean(gusts[:-k] * gusts[k:], axis=0) / gust**2
        assert correlation == pytest.approx([expected] * 3, abs=0.03)
    # the components know nothing of each other, and the properties are a normal distribution's
    assert np.corrcoef(gusts.T) == pytest.approx(np.eye(3), abs=0.03)
    assert np.mean(np.abs(gusts) < gust) == pytest.approx(0.6827, abs=0.01)


def test_gusts_are_as_strong_in_the_first_step_as_later():
    wind, rng = Wind(gust=1.5, gust_time=2.0), np.random.default_rng(0)
    several = np.array([wind.series(rng, 3, 0.1) for _ in range(4000)])
    assert np.sqrt(np.mean(several**2, axis=(0, 2))) == pytest.approx([1.5] * 3, rel=0.03)


def test_steady_winds_are_horizontal_and_from_the_ranges():
    wind, rng = Wind(speed=(1.0, 3.0), direction=(0.2, 0.5)), np.random.default_rng(0)
    several = np.array([wind.series(rng, 4, 0.1) for _ in range(500)])
    assert np.array_equal(several, np.repeat(several[:, :1], 4, axis=1)) and not several[:, :, 2].any()
    speed, angle = np.hypot(several[:, 0, 0], several[:, 0, 1]), np.arctan2(several[:, 0, 1], several[:, 0, 0])
    assert 1 <= speed.min() < 1.05 and 2.95 < speed.max() <= 3
    assert 0.2 <= angle.min() < 0.21 and 0.49 < angle.max() <= 0.5
    assert abs(np.corrcoef(speed, angle)[0, 1]) < 0.15
    assert not Wind().series(rng, 5, 0.1).any()


BAD_WINDS = [
    ({"speed": (2, 1)}, "speed"),
    ({"speed": (-1, 1)}, "speed"),
    ({"speed": 3.0}, "speed"),
    ({"speed": (0, np.nan)}, "speed"),
    ({"direction": (0, 1, 2)}, "direction"),
    ({"direction": "north"}, "direction"),
    ({"gust": -0.1}, "gust=-0.1"),
    ({"gust": "strong"}, "gust"),
    ({"gust_time": 0.0}, "gust_time=0.0"),
    ({"gust_time": np.inf}, "gust_time"),
]


@pytest.mark.parametrize(("properties", "name"), BAD_WINDS)
def test_bad_winds_are_named(properties, name):
    with pytest.raises(ValueError, match=name):
        Wind(**properties)


# --- in environments ------------------------------------------------------------------------------------------------------

BREEZE = {"speed": [1.0, 2.0], "gust": 0.5}


def make_vec(env_id, num_envs, **kwargs):
    return gym.make_vec(f"clothgym:{env_id}", num_envs=num_envs, **({"autoreset_mode": "SameStep", "wind": BREEZE} | kwargs))


def winds(env, steps):
    """Wind and positions of each environment in successive steps of still attachments."""
    seen = []
    for _ in range(steps):
        env.step(np.zeros(env.action_space.shape))
        state = env.get_state().simulation
        seen.append(np.concatenate([state.wind, state.positions[:, 5]], axis=1))
    return np.array(seen)


@every_task
def test_wind_blows_in_every_environment(env_id):
    windless, own, windy = (
        make_vec(env_id, 2, wind=wind) for wind in ({}, None, {"speed": [3, 3], "direction": [np.pi / 2, np.pi / 2]})
    )
    for env in (windless, own, windy):
        env.reset(seed=0)
    start = windy.get_state().simulation.positions
    assert np.array_equal(start, windless.get_state().simulation.positions)
    still, moved = winds(windless, 8), winds(windy, 8)
    assert not still[:, :, :3].any()
    assert moved[:, :, :3] == pytest.approx(np.broadcast_to([0, 3, 0], (8, 2, 3)), abs=1e-6)
    drift = windy.get_state().simulation.positions - windless.get_state().simulation.positions
    # a sheet that lies on the floor stays there: skin friction is less than the floor's
    lies = start[:, :, 2].max(axis=1) < 0.09  # rumpled silk, which is higher, is blown away
    along = drift[:, :, 1].mean(axis=1)
    assert np.all(np.where(lies, np.abs(along) < 1e-3, along > 2e-3))
    # with the keyword there is air about; without it, as the id says
    assert windless.unwrapped.task.simulation.air_density == RHO
    assert own.unwrapped.task.simulation.air_density == own.unwrapped.task.physics.air_density


@two_tasks
def test_winds_differ_within_a_batch_and_are_the_same_for_the_same_seed(env_id):
    env, single = make_vec(env_id, 4), gym.make(f"clothgym:{env_id}", wind=BREEZE).unwrapped
    env.reset(seed=7)
    first = winds(env, 6)
    assert all(len(np.unique(first[0, :, c])) == 4 for c in range(3))
    assert len(np.unique(first[:, 0, 0])) == 6  # gusts
    speed = np.linalg.norm(env.get_state().episode["wind"].mean(axis=1)[:, :2], axis=1)
    assert np.all(speed > 0.3) and np.all(speed < 3)
    env.reset()
    other = winds(env, 6)
    assert not np.array_equal(first, other)
    env.reset(seed=7)
    assert np.array_equal(winds(env, 6), first)
    single.reset(seed=9)
    for step in range(6):
        single.step(np.zeros(single.action_space.shape))
        state = single.get_state().simulation
        assert np.array_equal(np.concatenate([state.wind, state.positions[:, 5]], axis=1)[0], first[step, 2])


@two_tasks
def test_the_wind_goes_on_bit_for_bit_from_a_restored_state(env_id):
    """Through the end of the episode into the next one, whose wind is drawn again."""
    env, other = make_vec(env_id, 2), make_vec(env_id, 2)
    env.reset(seed=0)
    # most of the time to act is over already
    env.unwrapped.task.episode["step"] += env.unwrapped.task.acting_steps - 20
    winds(env, 5)
    state = env.get_state()
    steps = 20 + env.unwrapped.task.settling_steps
    rest = winds(env, steps)
    other.reset(seed=50)
    other.set_state(state)
    assert np.array_equal(winds(other, steps), rest)
    assert np.array_equal(env.get_state().episode["wind"], other.get_state().episode["wind"])
    assert not np.array_equal(state.episode["wind"], env.get_state().episode["wind"])


@pytest.mark.parametrize(
    ("wind", "name"),
    [BAD_WINDS[0], ({"force": 3}, "speed, direction, gust, gust_time"), (3.0, "wind=3.0"), ("strong", "wind='strong'")],
)
def test_bad_winds_of_environments_are_named(wind, name):
    with pytest.raises(ValueError, match=name):
        gym.make("clothgym:ClothDrape-v0", wind=wind)
