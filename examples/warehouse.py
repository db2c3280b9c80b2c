"""A formation drives the ∞ between the shelves of a warehouse; then a pallet stands in its way.

The world is the preset ``warehouse``: walls, shelves, columns, and pallets that can be pushed. The first run
prints how close each robot came to each kind of thing. In the second, a light pallet on castors stands on
the path. The leader pushes it aside; that is no touch that ends the episode.

    python examples/warehouse.py --horizon-s 25
"""

from __future__ import annotations

import numpy as np
import typer

import tlf_env
from baselines import ReferencePolicy
from tlf_env.envs.parallel import FormationParallelEnv
from tlf_env.physics.world import Pushable, Wall, World, capsules_of, gaps_to_capsule

PALLET = Pushable.model_validate(
    {
        "shape": {"type": "circle", "radius_mm": 150.0},
        "x_mm": 3100.0,
        "y_mm": 3900.0,
        "mass_kg": 2.0,
        "floor_friction": 0.01,
    }
)
FILTER = {"estimator": "ekf-slip", "broadcast_smoothing_s": 0.0}  # of the controller `tuned`


def drive(env: FormationParallelEnv) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Run an episode.

    Returns places of the outlines' centres, ``(step, robot, 2)``, and for each robot its smallest distance
    from a pallet and what it touched.
    """
    policy = ReferencePolicy("tuned")
    robot = env.scenario.robot
    observations, infos = env.reset(seed=0)
    centres, to_pallets = [], []
    pallets = [shape for body in env.pushable_bodies for shape in body.shapes]
    while env.agents:
        actions = {agent: policy.predict(seen)[0] for agent, seen in observations.items()}
        observations, *_, infos = env.step(actions)
        centres.append(
            [
                (
                    info["x_mm"] + robot.outline_offset_mm * np.sin(info["theta_rad"]),
                    info["y_mm"] - robot.outline_offset_mm * np.cos(info["theta_rad"]),
                )
                for info in infos.values()
            ]
        )
        to_pallets.append(
            [
                min(shape.point_query(tuple(place)).distance for shape in pallets)
                for place in centres[-1]
            ]
        )
    touched = [tlf_env.TouchedBy(info["touched_by"]).name.lower() for info in infos.values()]
    nearest = np.array(to_pallets).min(axis=0) - robot.outline_radius_mm
    return np.array(centres), nearest, touched


def clearance(world: World, kind: type, centres: np.ndarray, radius_mm: float) -> float:
    """Smallest distance of an outline from the walls or the obstacles of a world, mm."""
    things = [thing for thing in world.fixed if isinstance(thing, Wall) == (kind is Wall)]
    gaps = [gaps_to_capsule(one, centres) for thing in things for one in capsules_of(thing)]
    return float(np.min(gaps)) - radius_mm


def main(horizon_s: float = 25.0) -> None:
    """Print the clearances, and where a pallet goes that stands in the way."""
    env = tlf_env.parallel_env("warehouse", **FILTER, horizon_s=horizon_s)
    world, radius_mm = env.scenario.world, env.scenario.robot.outline_radius_mm
    centres, to_pallets, touched = drive(env)
    print("         smallest clearance in mm from")
    print("         walls  shelves  pallets  touched")
    for i, what in enumerate(touched):
        walls, shelves = (
            clearance(world, kind, centres[:, i], radius_mm) for kind in (Wall, object)
        )
        print(f"robot_{i}{walls:7.0f}{shelves:9.0f}{to_pallets[i]:9.0f}  {what}")

    world = world.model_copy(update={"pushables": (*world.pushables, PALLET)})
    env = tlf_env.parallel_env("warehouse", **FILTER, horizon_s=horizon_s, world=world)
    *_, touched = drive(env)
    pallet = env.pushable_bodies[-1]
    way = pallet.position - (PALLET.x_mm, PALLET.y_mm)
    print(
        f"a pallet in the way of robot_0 was pushed {way.length:.0f} mm; after "
        f"{env.formation.time_s:.0f} s the robots touched {', '.join(touched)}"
    )


if __name__ == "__main__":
    typer.run(main)
