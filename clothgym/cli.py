"""The command line: what there is, a page to play with it, exports, its speed here, how integrators compare, compiling."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m clothgym", description="Cloth that is fast enough to learn on.")
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("list", help="environments, integrators and fabrics")
    warmup = commands.add_parser("warmup", help="compile kernels now, so that nothing has to later")
    warmup.add_argument("--all", action="store_true", help="also for each bending model and strain limiting; some minutes")
    bench = commands.add_parser("bench", help="measure speed on this machine")
    bench.add_argument("--json", type=Path, metavar="FILE", help="write the results there too")
    bench.add_argument("--quick", action="store_true", help="fewer cases, in a few seconds")
    bench.add_argument(
        "--table", action="store_true", help="what everything costs, beside what is wanted and what the machine allows"
    )
    bench.add_argument("--select", nargs="*", default=[], metavar="GROUP", help="of the table: springs, strict, start, ...")
    compare = commands.add_parser("compare", help="one scene, several integrators: errors, costs and pictures")
    compare.add_argument("--scene", default="stiff_sheet", metavar="NAME", help="see --list (default: stiff_sheet)")
    compare.add_argument("--list", action="store_true", help="the scenes, and what each breaks")
    compare.add_argument("--integrators", nargs="+", metavar="NAME", help="those to compare; all by default")
    compare.add_argument("--out", type=Path, metavar="DIR", help="folder of the results (default: runs/compare_SCENE)")
    compare.add_argument("--quick", action="store_true", help="fewer settings")
    compare.add_argument("--fresh", action="store_true", help="measure again what the folder has")
    view = commands.add_parser("view", help="a page in the browser, where cloth can be touched")
    view.add_argument(
        "what", nargs="?", default="", metavar="SCENE", help="a scene or an environment's id (default: patch); see list"
    )
    view.add_argument("--host", default="127.0.0.1", help="address to listen at (default: this machine alone can reach it)")
    view.add_argument("--port", type=int, default=8080, help="port, or the next that is free; 0 for any (default: 8080)")
    view.add_argument(
        "--policy", nargs="+", default=[], metavar="RUN", help="folders of training runs, which then act in their tasks"
    )
    view.add_argument("--replay", type=Path, metavar="FILE", help="a recording that the page saved (.npz), to be shown again")
    export = commands.add_parser("export", help="a scene or an environment as a picture, a film or meshes for Blender")
    export.add_argument("name", metavar="NAME", help="a scene or an environment id, see list")
    export.add_argument("--out", required=True, help=".png, .gif, .mp4 or .glb; without an ending a folder of meshes")
    export.add_argument("--kind", default="obj", help="of the meshes in a folder: obj (default) or glb")
    export.add_argument("--seconds", type=float, help="5 of a scene, and all of an episode by default")
    export.add_argument("--fps", type=float, help="frames a second (30 by default, or as many as there are)")
    export.add_argument("--size", type=int, help="pixels of a side")
    export.add_argument("--seed", type=int, default=0)
    export.add_argument("--color", default="fabric", help="of pictures and films: fabric (default) or strain")
    export.add_argument("--policy", default="expert", help="who acts: expert (default), nothing, chance, or a run's folder")
    export.add_argument("--set", nargs="+", default=[], metavar="NAME=VALUE", help="settings: gravity=3 fabric=silk wind=4 ...")
    options = parser.parse_args(arguments)
    if options.command == "list":
        _list()
    elif options.command == "export":
        _export(options, export)
    elif options.command == "warmup":
        _warm_up(options.all)
    elif options.command == "compare":
        _compare(options, compare)
    elif options.command == "view":
        _view(options, view)
    else:
        _bench(options, bench)
    return 0


def _list() -> None:
    from clothgym.integrators import INTEGRATORS
    from clothgym.material import PRESETS
    from clothgym.playground.scenes import TITLES
    from clothgym.registration import ENVIRONMENTS

    print("environments")
    for env_id in ENVIRONMENTS:
        print(f"  clothgym:{env_id}")
    print("scenes")
    for name, title in TITLES.items():
        print(f"  {name:<22} {title}")
    print("integrators")
    for name, integrator in INTEGRATORS.items():
        order = f"order {integrator.order}" if integrator.order else "no order"
        print(f"  {name:<22} {order}; a substep costs {integrator.cost}")
    print("fabrics")
    for name, material in PRESETS.items():
        print(f"  {name:<22} {material.density * 1000:.0f} g/m^2, E t = {material.stretch_stiffness:.0f} N/m")


def _warm_up(everything: bool) -> None:
    import gymnasium as gym

    from clothgym.bending import BENDING
    from clothgym.integrators import INTEGRATORS
    from clothgym.mesh import grid
    from clothgym.registration import ENVIRONMENTS
    from clothgym.simulation import Simulation

    begun = time.perf_counter()
    # wind and slipping have kernels of their own
    cases: list[tuple[str, dict[str, Any]]] = [(env_id, {}) for env_id in ENVIRONMENTS]
    cases += [("ClothReach-v0", {"wind": {"gust": 0.5}}), ("ClothDrapeGripper-v0", {"slip_force": 1.0})]
    for env_id, kwargs in cases:
        env = gym.make(env_id, render_mode="rgb_array", **kwargs)
        env.reset(seed=0)
        # to the judgement: it has kernels too
        terminated = False
        while not terminated:
            _, _, terminated, _, _ = env.step(env.unwrapped.expert_action())  # type: ignore[attr-defined]
        env.render()
        env.close()
    for integrator in INTEGRATORS:
        for bending in BENDING if everything else ["springs"]:
            for limit in (None, 0.1) if everything else [None]:
                Simulation(grid(3, 3, 0.1, 0.1), integrator=integrator, bending=bending, strain_limit=limit, substeps=1000).step()
    what = "all kernels are" if everything else "all kernels of the environments and of every integrator are"
    print(f"{what} ready ({time.perf_counter() - begun:.1f} s)")


def _bench(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    from clothgym.lab import bench, bench_table

    if options.table:
        try:
            results = bench_table.run(options.select)
        except ValueError as error:
            parser.error(str(error))
        print(bench_table.table(results))
    else:
        results = bench.run(options.quick)
        print(bench.table(results))
    if options.json is not None:
        options.json.write_text(json.dumps(results, indent=1) + "\n")
        print(f"written to {options.json}")


def _compare(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    from clothgym.lab import compare

    if options.list:
        print(compare.scene_list())
        return
    try:
        plan = compare.plan(options.scene, options.integrators, options.quick)
    except ValueError as error:
        parser.error(str(error))
    folder = options.out or Path("runs") / f"compare_{options.scene}"
    print(compare.table(compare.run(plan, folder, options.fresh)))
    print(f"written to {folder}: results.json, table.txt, work_precision.png, sheets.png")


def _view(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    from clothgym.playground.server import policies_of, serve

    try:
        start, policies = policies_of(options.policy, options.what)
        playground = serve(start, options.host, options.port, options.replay, policies)
    except (ValueError, OSError, ImportError) as error:
        parser.error(str(error))
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        print("closing")
    finally:
        playground.stop()


def _export(options: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    from clothgym.playground.exporting import export, tell

    given = {name: getattr(options, name) for name in ("seconds", "fps", "size", "seed", "color", "kind", "policy")}
    try:
        settings = dict(_setting(text) for text in options.set)
        print(f"written: {export(options.name, options.out, settings=settings, say=tell, **given)}")
    except (ValueError, OSError, ImportError) as error:
        parser.error(str(error))
    except (RuntimeError, KeyboardInterrupt) as error:
        raise SystemExit("\n" + "\n".join([str(error) or "stopped", *getattr(error, "__notes__", [])])) from None


def _setting(text: str) -> tuple[str, Any]:
    """``NAME=VALUE`` with a number where it is one."""
    name, equals, value = text.partition("=")
    if not equals:
        raise ValueError(f"--set {text!r}: must be NAME=VALUE, for instance gravity=3")
    try:
        return name, json.loads(value)
    except json.JSONDecodeError:
        return name, value
