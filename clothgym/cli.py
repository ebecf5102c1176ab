"""The command line: lists, the playground's page, exports, comparisons of integrators, benchmarks, and compilation.

Options are checked before anything is compiled.  Values are checked during parsing, and names against their tables.  The latter
takes a second.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import clothgym
from clothgym import progress
from clothgym.registration import ACTORS, ENVIRONMENTS, actor_named

STOPPED = 130  # exit status after Ctrl+C, as in shells


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command, and return its exit status.  Wrong arguments print an error and exit with status 2."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    try:
        options.run(options)
    except KeyboardInterrupt as stop:
        progress.clear()
        print("; ".join(["stopped", *getattr(stop, "__notes__", [])]), file=sys.stderr)
        return STOPPED
    except OSError as error:  # a full disk, a folder that has gone
        progress.clear()
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


# --- options --------------------------------------------------------------------------------------------------------------


def _parser() -> argparse.ArgumentParser:
    called = "python -m clothgym" if Path(sys.argv[0]).name == "__main__.py" else "clothgym"
    parser = argparse.ArgumentParser(prog=called, description="Cloth that is fast enough to learn on.")
    parser.add_argument("--version", action="version", version=f"clothgym {clothgym.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")

    def command(run: Callable[[argparse.Namespace], None], name: str, about: str) -> argparse.ArgumentParser:
        made = commands.add_parser(name, help=about, description=f"{about[0].upper()}{about[1:]}.")
        made.set_defaults(run=run, refuse=made.error)
        return made

    command(_list, "list", "environments, scenes, integrators and fabrics")

    view = command(_view, "view", "interactive cloth in the browser")
    view.add_argument(
        "what", nargs="?", default="", metavar="SCENE", help="a scene or an environment's id (default: patch); see list"
    )
    view.add_argument("--host", default="127.0.0.1", help="address to listen on (default: only this machine can reach it)")
    view.add_argument("--port", type=_integer(0, 65535), default=8080, help="port, or the next free one; 0 for any (default: 8080)")
    view.add_argument(
        "--policy", type=_actor, nargs="+", default=[], metavar="POLICY",
        help="policy in an environment: expert (default), noop, random, or folders of training runs",
    )  # fmt: skip
    view.add_argument("--replay", type=_readable, metavar="FILE", help="replay a recording (.npz) saved from the page")

    export = command(_export, "export", "a scene or an environment as a picture, a film or meshes for Blender")
    export.add_argument("name", metavar="NAME", help="a scene or an environment's id, see list")
    export.add_argument(
        "--out", required=True, type=_writable, help=".png, .webp, .gif, .mp4 or .glb; without an extension, a folder of meshes"
    )
    export.add_argument("--kind", choices=("obj", "glb"), default="obj", help="format of the meshes in a folder (default: obj)")
    export.add_argument("--seconds", type=_positive, help="duration (default: 5 s of a scene, or a whole episode)")
    export.add_argument("--fps", type=_positive, help="frames per second (default: 30, or as many as there are)")
    export.add_argument("--size", type=_integer(1), help="side length in pixels")
    export.add_argument("--seed", type=_integer(0), default=0)
    export.add_argument(
        "--color", choices=("fabric", "strain"), default="fabric", help="colors of pictures and films (default: fabric)"
    )
    export.add_argument("--policy", type=_actor, default="expert", help="policy: expert (default), noop, random, or a run's folder")
    export.add_argument(
        "--set",
        nargs="+",
        type=_setting,
        default=[],
        metavar="NAME=VALUE",
        help="settings of a scene, such as gravity=3 fabric=silk wind=4",
    )

    compare = command(_compare, "compare", "one scene, several integrators: errors, costs and pictures")
    compare.add_argument("--scene", default="stiff_sheet", metavar="NAME", help="see --list (default: stiff_sheet)")
    compare.add_argument("--list", action="store_true", help="list the scenes and their difficulties")
    compare.add_argument("--integrators", nargs="+", metavar="NAME", help="integrators to compare (default: all)")
    compare.add_argument("--out", type=_writable, metavar="DIR", help="folder for the results (default: runs/compare_SCENE)")
    compare.add_argument("--quick", action="store_true", help="fewer settings")
    compare.add_argument("--fresh", action="store_true", help="repeat measurements that the folder already has")

    bench = command(_bench, "bench", "measure speed on this machine")
    bench.add_argument("--json", type=_writable, metavar="FILE", help="also write the results to this file")
    bench.add_argument("--quick", action="store_true", help="fewer cases, in a minute or two")

    warmup = command(_warm_up, "warmup", "compile kernels now instead of at first use")
    warmup.add_argument("--all", action="store_true", help="also for each bending model and strain limiting; takes some minutes")
    return parser


def _integer(least: int, most: int | None = None) -> Callable[[str], int]:
    span = f"of at least {least}" if most is None else f"from {least} to {most}"

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least or (most is not None and value > most):
            raise argparse.ArgumentTypeError(f"{text!r}: must be an integer {span}")
        return value

    return parse


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text!r}: must be a positive number")
    return value


def _actor(text: str) -> str:
    try:
        return actor_named(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _setting(text: str) -> tuple[str, Any]:
    """``NAME=VALUE``, with the value parsed as JSON where possible."""
    name, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text!r}: must be NAME=VALUE, for instance gravity=3")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value


def _readable(text: str) -> Path:
    path = Path(text).expanduser()
    if not path.is_file() or not os.access(path, os.R_OK):
        raise argparse.ArgumentTypeError(f"{text!r}: there is no such file that can be read")
    return path


def _writable(text: str) -> Path:
    """A path that can be created or written to."""
    path = Path(text).expanduser()
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r}: there is no folder {str(path.parent)!r}; make it, or name another")
    place = path if path.exists() else path.parent
    if not os.access(place, os.W_OK):
        raise argparse.ArgumentTypeError(f"{text!r}: {str(place)!r} cannot be written; name another place")
    return path


# --- commands -------------------------------------------------------------------------------------------------------------


def _list(options: argparse.Namespace) -> None:
    from clothgym.integrators import INTEGRATORS
    from clothgym.material import PRESETS, rigidity_percentile
    from clothgym.playground.scenes import TITLES

    orders = {name: f"order {method.order}" if method.order else "no order" for name, method in INTEGRATORS.items()}
    sections = {
        "environments": {f"clothgym:{env_id}": about for env_id, (_, about) in ENVIRONMENTS.items()},
        "scenes": TITLES,
        "integrators": {name: f"{orders[name]}; a substep costs {method.cost}" for name, method in INTEGRATORS.items()},
        "fabrics": {
            name: f"{material.density * 1000:.0f} g/m^2, E t = {material.stretch_stiffness:.0f} N/m, "
            f"B = {material.bend_rigidity * 1e6:.3g} uN m (percentile {rigidity_percentile(material.bend_rigidity):.0f})"
            for name, material in PRESETS.items()
        },
    }
    for title, lines in sections.items():
        width = max(map(len, lines))
        print(title, *(f"  {name:<{width}}  {about}" for name, about in lines.items()), sep="\n")


def _warm_up(options: argparse.Namespace) -> None:
    import gymnasium as gym

    from clothgym.bending import BENDING
    from clothgym.integrators import INTEGRATORS
    from clothgym.mesh import grid
    from clothgym.simulation import Simulation

    def episode(env_id: str, **kwargs: Any) -> None:
        """Play to the evaluation, which has its own kernels."""
        env = gym.make(env_id, render_mode="rgb_array", **kwargs)
        env.reset(seed=0)
        while not env.step(env.unwrapped.expert_action())[2]:  # type: ignore[attr-defined]
            pass
        env.render()
        env.close()

    def step(integrator: str, bending: str, limit: float | None) -> None:
        Simulation(grid(3, 3, 0.1, 0.1), integrator=integrator, bending=bending, strain_limit=limit, substeps=1000).step()

    begun = time.perf_counter()
    # wind and slipping have their own kernels
    cases: list[tuple[Callable[..., None], str, dict[str, Any]]] = [(episode, env_id, {}) for env_id in ENVIRONMENTS]
    cases += [(episode, "ClothReach-v0", {"wind": {"gust": 0.5}}), (episode, "ClothDrapeGripper-v0", {"slip_force": 1.0})]
    for integrator in INTEGRATORS:
        for bending in BENDING if options.all else ["springs"]:
            for limit in (None, 0.1) if options.all else [None]:
                cases.append((step, integrator, {"bending": bending, "limit": limit}))
    for place, (run, name, kwargs) in enumerate(cases):
        progress.show(name, place, len(cases))
        run(name, **kwargs)
    progress.clear()
    what = "all kernels are" if options.all else "all kernels of the environments and of every integrator are"
    print(f"{what} ready ({time.perf_counter() - begun:.1f} s)")


def _bench(options: argparse.Namespace) -> None:
    from clothgym import files
    from clothgym.lab import bench

    results = bench.run(options.quick)
    print(bench.table(results))
    if options.json is not None:
        files.write(options.json, json.dumps(results, indent=1) + "\n")
        print(f"written to {options.json}")


def _compare(options: argparse.Namespace) -> None:
    from clothgym.lab import compare

    if options.list:
        print(compare.scene_list())
        return
    try:
        plan = compare.plan(options.scene, options.integrators, options.quick)
    except ValueError as error:
        options.refuse(str(error))
    folder = options.out or Path("runs") / f"compare_{options.scene}"
    print(compare.table(compare.run(plan, folder, options.fresh)))
    print(f"written to {folder}: results.json, table.txt, work_precision.png, sheets.png")


def _view(options: argparse.Namespace) -> None:
    from clothgym.playground.gallery import Gallery, policies_of
    from clothgym.playground.server import check_address, serve

    actor = next((name for name in options.policy if name in ACTORS), "expert")
    try:
        if options.what:
            Gallery().checked(options.what)
        check_address(options.host, options.port)
        start, policies = policies_of(options.policy, options.what)
        playground = serve(start, options.host, options.port, options.replay, policies, actor)
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        options.refuse(str(error))
    try:
        while True:
            time.sleep(3600)
    finally:
        playground.stop()


def _export(options: argparse.Namespace) -> None:
    from clothgym.playground.exporting import export

    given = {name: getattr(options, name) for name in ("seconds", "fps", "size", "seed", "color", "kind", "policy")}
    try:
        said = export(options.name, options.out, settings=dict(options.set), say=_frames, **given)
    except (ValueError, OSError, ImportError) as error:
        options.refuse(str(error))
    except RuntimeError as error:  # the sheet blew up
        progress.clear()
        raise SystemExit("\n".join([str(error), *getattr(error, "__notes__", [])])) from None
    progress.clear()
    print(f"written: {said}")


def _frames(done: int, total: int) -> None:
    progress.show("frames", done, total)
