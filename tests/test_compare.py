"""``python -m clothgym compare``: one scene, several integrators."""

import json
from dataclasses import replace

import numpy as np
import pytest

from clothgym import INTEGRATORS, Material
from clothgym.lab import compare, compare_pictures, compare_plan
from clothgym.lab.compare_scenes import FRAME, SCENES, Scene

THREE = ("explicit_euler", "verlet", "xpbd")
TINY = Scene(
    name="tiny",
    breaks="a small sheet swings: for tests",
    size=(5, 5, 0.4, 0.4),
    material=Material.preset("penava_cotton"),
    held=(20, 24),
    seconds=0.2,
    substeps=(8, 32),
    shown=8,
    reference_substeps=64,
    eye=(0.8, -1.0, 0.8),
    target=(0.0, 0.0, 0.4),
    altitude=0.5,
)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Folder and results of a run."""
    folder = tmp_path_factory.mktemp("compare")
    return folder, compare.run(compare.Plan(TINY, THREE), folder)


def row_of(results, integrator, substeps, **options):
    return next(
        row
        for row in results["rows"]
        if (row["integrator"], row["substeps"]) == (integrator, substeps) and options.items() <= row["options"].items()
    )


def test_all_results_are_written(tiny):
    """The JSON holds what the table tells: a row for each integrator, choice of options and substeps, and the machine."""
    folder, results = tiny
    written = json.loads((folder / "results.json").read_text())
    assert written["machine"]["versions"]["clothgym"]
    assert len(written["rows"]) == 2 + 2 + 2 * len(compare_plan.CHOICES["xpbd"])
    assert written["rows"] == json.loads(json.dumps(results["rows"]))
    text = (folder / "table.txt").read_text()
    assert text == compare.table(results) + "\n"
    assert all(name in text for name in (*THREE, TINY.breaks, "rk4 in float64"))


def test_an_explosion_is_a_row(tiny):
    """Explicit Euler has no bound below its damping time of 0.1 ms: with 8 substeps of 2 ms each it is unstable, and only that."""
    _, results = tiny
    row = row_of(results, "explicit_euler", 8)
    assert not row["stable"] and "error_mm" not in row and "ms_batch" not in row
    assert row["auto_substeps"] >= FRAME / Material.preset("penava_cotton").damping_time
    assert all(row_of(results, name, n)["stable"] for name in ("verlet", "xpbd") for n in TINY.substeps)


def test_an_explosion_is_pictured_as_it_begins():
    """It is the run of the row, whose substeps are taken one by one; a yarn is torn, and the sheet is not yet out of sight."""
    stable, unstable = (compare_plan.Setting(name, {}, 8, "") for name in ("verlet", "explicit_euler"))
    whole, taken = stable.simulation(TINY), stable.in_substeps(TINY)
    whole.step(2)
    taken.step(16)
    np.testing.assert_allclose(taken.positions, whole.positions, atol=1e-6)
    sheet = compare.shreds(TINY, unstable)
    assert strain_of(TINY.mesh, sheet).max() > compare.SHREDDED and np.abs(sheet).max() < 10


def strain_of(mesh, x):
    ends = x[mesh.springs.particles].astype(float)
    return np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) / mesh.springs.rest_length - 1


def test_errors_shrink_with_the_stated_order(tiny):
    """Four times the substeps: errors fall by about 4^order; the reference, halved, moves by less than 1 % of them."""
    _, results = tiny
    ratio = {
        name: row_of(results, name, 8, **options)["error_mm"] / row_of(results, name, 32, **options)["error_mm"]
        for name, options in (("verlet", {}), ("xpbd", {"iterations": 1}))
    }
    assert ratio["verlet"] > 8 and 2 < ratio["xpbd"] < 16
    assert results["reference"]["half_substeps_mm"] < 0.01 * row_of(results, "verlet", 32)["error_mm"]


def test_costs_are_those_of_the_clock(monkeypatch):
    """A clock that goes on by 0.1 s between two looks: 0.1 s a control step, shared by 64 sheets, is 93.75 ms a second of each."""
    ticks = iter(np.arange(1, 1000) * 0.1)
    monkeypatch.setattr(compare.time, "thread_time", lambda: float(next(ticks)))
    rows = [{"integrator": "xpbd", "options": {"iterations": 4}, "substeps": 8, "variant": ""}]
    compare.add_costs(TINY, rows)
    assert rows[0]["ms_batch"] == pytest.approx(1e3 * 0.1 * 60 / 64)
    assert rows[0]["ms_alone"] == pytest.approx(1e3 * 0.1 * 60)
    assert rows[0]["ns_per_element"] == pytest.approx(1e9 * 0.1 / (64 * 8 * 4 * len(TINY.mesh.springs.kind)))


def colored(picture, color, apart=0.06):
    """Share of pixels with an integrator's hue, whatever the light is: chroma direction within ``apart`` radians and clear."""
    wanted = np.array([int(color[place : place + 2], 16) for place in (1, 3, 5)], float)
    chroma, aim = (a - a.mean(axis=-1, keepdims=True) for a in (picture[..., :3].astype(float), wanted))
    size = np.linalg.norm(chroma, axis=-1)
    along = chroma @ aim / (np.maximum(size, 1e-9) * np.linalg.norm(aim))
    return np.mean((along > np.cos(apart)) & (size > 0.4 * np.linalg.norm(aim)))


def test_the_picture_shows_each_sheet(tiny):
    """Panels in a row: the reference, then one of each integrator in its color, the exploded one in shreds."""
    from matplotlib import pyplot

    folder, _ = tiny
    picture = 255 * pyplot.imread(folder / "sheets.png")
    panels = np.split(picture[: compare_pictures.PANEL], range(300, 1200, 300), axis=1)
    assert picture.shape[1] == 1200 and len(panels) == 4
    room = compare_pictures._picture(TINY, None, "#000000").astype(float)
    assert all(np.mean(np.abs(panel[..., :3] - room).max(axis=-1) > 20) > 0.05 for panel in panels)
    for panel, owner in zip(panels, (None, None, "verlet", "xpbd")):
        seen = [name for name in ("verlet", "xpbd", "implicit_euler", "rk4") if colored(panel, INTEGRATORS[name].color) > 0.02]
        assert seen == ([owner] if owner else [])


def test_an_interrupted_run_goes_on(tmp_path, monkeypatch):
    """Rows that are there are not measured again."""
    measured = []
    real = compare.measure

    def measure(scene, setting, *rest):
        if setting.integrator == "xpbd" and not measured.count("go on"):
            raise KeyboardInterrupt
        measured.append(setting.integrator)
        return real(scene, setting, *rest)

    monkeypatch.setattr(compare, "measure", measure)
    plan = compare.Plan(replace(TINY, seconds=0.05), ("verlet", "xpbd"), quick=True)
    with pytest.raises(KeyboardInterrupt):
        compare.run(plan, tmp_path)
    assert measured == ["verlet"] * 2 and len(json.loads((tmp_path / "results.json").read_text())["rows"]) == 2
    measured[:] = ["go on"]
    compare.run(plan, tmp_path)
    assert measured == ["go on"] + ["xpbd"] * 2
    monkeypatch.setattr(compare, "add_costs", lambda *_: pytest.fail("timed again"))
    compare.run(plan, tmp_path)
    assert len(measured) == 3


def test_the_first_choice_of_options_is_the_default():
    for name, choices in compare_plan.CHOICES.items():
        assert choices[0].items() <= INTEGRATORS[name].options.items()
    assert len({method.color for method in INTEGRATORS.values()}) == len(INTEGRATORS)


@pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)
def test_scenes_match_their_descriptions(scene):
    """They begin above the floor, are shown with substeps that are tried, and heavy particles weigh what is said."""
    s = scene.simulation("semi_implicit_euler", scene.shown)
    assert scene.shown in scene.substeps and scene.reference_substeps % 2 == 0
    assert s.positions[0, :, 2].min() > 0
    mass = 1 / s.get_state().free_inverse_mass[0].astype(float)
    expected = scene.material.density * np.prod(scene.size[2:])
    heavy = list(scene.heavy)
    extra = (scene.heavier - 1) * scene.material.density * scene.mesh.area[heavy].sum()
    assert mass.sum() == pytest.approx(expected + extra, rel=1e-6)
    assert s.attached.sum() == len(scene.held)
    # the spin is rigid: speed is the angular velocity times the distance to the axis
    radius = np.hypot(*scene.mesh.rest_positions[:, :2].T)
    assert np.linalg.norm(s.velocities[0], axis=1) == pytest.approx(scene.spin * radius, rel=1e-6)
