"""The plan of a comparison: integrators, options and substeps on a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from clothgym import integrators
from clothgym.lab.compare_scenes import Scene, scene_named
from clothgym.simulation import Simulation

Row = dict[str, Any]

LANES = 64  # sheets in the batch that is timed
# options of an integrator to try, its default first
CHOICES: dict[str, tuple[dict[str, int], ...]] = {
    "implicit_euler": ({"newton_iterations": 1}, {"newton_iterations": 3}),
    "projective_dynamics": ({"iterations": 10}, {"iterations": 3}),
    "pbd": ({"iterations": 10},),
    "xpbd": ({"iterations": 1}, {"iterations": 4}),
}


class Setting(NamedTuple):
    """One configuration to measure: integrator, options, substeps of a control step, and a variant of the scene or ""."""

    integrator: str
    options: Mapping[str, int]
    substeps: int
    variant: str

    def matches(self, row: Row) -> bool:
        return self == Setting(*(row[name] for name in self._fields))

    def simulation(self, scene: Scene, num_envs: int = 1) -> Simulation:
        return scene.simulation({"name": self.integrator, **self.options}, self.substeps, self.variant, num_envs)

    def in_substeps(self, scene: Scene) -> Simulation:
        """The same, each of whose steps is one of these substeps."""
        return scene.simulation(
            {"name": self.integrator, **self.options}, 1, self.variant, time_step=scene.seconds / scene.frames / self.substeps
        )


class Plan(NamedTuple):
    """A scene and the integrators to try on it.  With ``quick``, fewer settings are tried."""

    scene: Scene
    names: tuple[str, ...]
    quick: bool = False

    def settings(self) -> list[Setting]:
        """All settings by integrator, option and substeps.  The scene's variants follow, with the substeps of the picture."""
        scene = self.scene
        tried = [n for place, n in enumerate(scene.substeps) if n == scene.shown or place % 2 or not self.quick]
        of = {name: CHOICES.get(name, ({},))[: 1 if self.quick else None] for name in self.names}
        return [Setting(name, options, n, "") for name in self.names for options in of[name] for n in tried] + [
            Setting(name, of[name][0], scene.shown, variant) for variant in scene.variants for name in self.names
        ]

    def shown(self) -> list[Setting]:
        """The settings in the picture."""
        settings = [s for s in self.settings() if s.substeps == self.scene.shown]
        return [s for s in settings if s.options == CHOICES.get(s.integrator, ({},))[0]]


def plan(scene: str, names: Sequence[str] | None = None, quick: bool = False) -> Plan:
    """The plan for a scene, with all integrators if no names are given.

    Raises:
        ValueError: an unknown scene or integrator; the message lists the known ones.
    """
    names = tuple(dict.fromkeys(names or integrators.INTEGRATORS))
    return Plan(scene_named(scene), tuple(integrators.get(name).name for name in names), quick)


def sheet_name(setting: Setting) -> str:
    return setting.integrator + (f", {setting.variant}" if setting.variant else "")


def described(options: Mapping[str, int], variant: str = "") -> str:
    """Options and variant, as a table shows them."""
    return ", ".join([f"{name.replace('_', ' ')} {value}" for name, value in options.items()] + [variant] * bool(variant))
