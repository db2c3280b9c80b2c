"""Generate the environment's tables, for class docstrings and ``docs/environment.md``.

``python -m tlf_env.envs.spec`` prints the page; a test compares it with the committed page.
"""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from typing import TypeVar

from tlf_env.task.actions import ACTION_ENTRIES
from tlf_env.task.feasibility import SENSOR_FIX_LIMIT_MM, SENSOR_START_LIMIT_MM, SENSOR_TIME_LIMIT_S
from tlf_env.task.info import MEANINGS
from tlf_env.task.observation import (
    NEIGHBOUR_ENTRIES,
    OBSERVATION_LIMIT,
    PREVIEW_ENTRIES,
    RAY_MEANING,
    SAMPLE_ENTRIES,
    SENSOR_TAIL_ENTRIES,
    TRACKING_ENTRIES,
    Entry,
)
from tlf_env.task.reward import DEFAULT_WEIGHTS, REWARD_MEANINGS

T = TypeVar("T", bound=type)


def table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """A Markdown table."""
    cells = [tuple(cell.replace("|", "\\|") for cell in row) for row in rows]
    lines = [header, tuple("---" for _ in header), *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def entry_rows(entries: dict[str, Entry], first: int = 0) -> list[tuple[str, ...]]:
    """Rows of an observation's table."""
    return [
        (str(first + i), f"`{name}`", entry.meaning, entry.unit, f"{entry.scale:g}")
        for i, (name, entry) in enumerate(entries.items())
    ]


DEFAULT_ACTIONS = """In `gymnasium.make`, `make_vec` and `FormationVecEnv` the action is by default
`tracking_twist`: an action of zero follows the reference, and exploring does not end the episode in the first
seconds. Elsewhere, as in `parallel_env`, it is `twist`, the action that the reference policies answer with.
The field `action` of a call, a file or a mapping counts before that, and a `Scenario` keeps its own."""

LOST_NEVER_PAYS = """With the default weights a robot that has an action of zero and wheels that do not slip
never has a negative reward, so that being lost is never the best choice. `far` changes that: an `alive` of at
least as much per step as the largest `far` (`reward={"far": -1.0, "alive": 1.2}`, as robots are lost beyond
1200 mm) makes up for it. A reward under which being lost pays gives a `ReferenceWarning`."""

LIMITED = """`action_range=(300.0, 3.0)` sets what 1.0 means in `tracking_twist` and `residual`, mm/s and rad/s.
Near the reference the range of `tracking_twist` shrinks: an action counts with the weight e/(e + F), where e
is the estimated position error and F = `tracking_fade_mm` (10 mm by default; 0: the whole range everywhere).
What an action does wrong there stays small: wheels keep their grip, and a constant error of the network leaves
almost no error of the robot. Learners that begin with actions of standard deviation 1, as those of SB3, need a
range about as small as the default one ([learning.md](learning.md#what-decides)).

`limiter` puts a [limiter](systems.md#limiters) behind the actions `twist`, `wheel_speed` and `tracking_twist`:
a preset, a file or a mapping. Motors and tyres can follow what it lets through. It is the law that limits a
system `CONTROLLER+ESTIMATOR+LIMITER`: the twist that a law wants, as an action, gives the system's command. A
limiter's `lead_s` shifts the reference that `tracking_twist` adds to; its supervisor needs a `neighbour`. By
default `twist` and `wheel_speed` are not limited, and `tracking_twist` is, by `approach`: the default system's
`grip`, and a gentle approach to the reference. `limiter="none"` takes that away. A `residual` has the limits
of its `residual_base`.

`residual_base` is a controller, by its preset or file, or a policy in Python: an object with SB3's `predict`
from `tracking` observations to `twist` actions, or, with `trust`, `"module:factory"` of one. Such a policy
runs once a control step for all robots, also in a batch, and a `limiter` may limit the sum.

```python
env = tlf_env.parallel_env("infinity", action="tracking_twist", limiter="body")
```"""


def action_section() -> str:
    """Section on the kinds of action."""
    rows = [
        (f"`{kind}`", str(i), entry.meaning, f"{entry.scale:g} {entry.unit}")
        for kind, entries in ACTION_ENTRIES.items()
        for i, entry in enumerate(entries)
    ]
    return (
        '`Box(−1, 1, (2,))`, float32 (float64 with `dtype="float64"`). Finite values outside are clipped '
        "and counted.\n\n"
        + table(("action", "index", "meaning", "1.0 means"), rows)
        + "\n\n"
        + DEFAULT_ACTIONS
        + "\n\n"
        + LIMITED
    )


def observation_section() -> str:
    """Section on the two observations."""
    columns = ("index", "entry", "meaning", "unit", "scale")
    count = len(TRACKING_ENTRIES)
    each = len(PREVIEW_ENTRIES)
    return "\n\n".join(
        [
            f"`Box(−{OBSERVATION_LIMIT:g}, {OBSERVATION_LIMIT:g}, (size,))`. Every entry is divided by its "
            f"scale and clipped at ±{OBSERVATION_LIMIT:g}.",
            f"`tracking`: {count + 2 * each} entries with the default previews of 0.5 s and 1 s:",
            table(columns, entry_rows(TRACKING_ENTRIES)),
            f"followed by {each} entries for each time of `preview_s`, named `NAME_in_TIME_s`:",
            table(columns, entry_rows(PREVIEW_ENTRIES, count)),
            "and, with a `neighbour`, by:",
            table(
                ("entry", "meaning", "unit", "scale"),
                [row[1:] for row in entry_rows(NEIGHBOUR_ENTRIES)],
            ),
            "`sensor`: for each substep of the last step, oldest first, named `NAME_K`:",
            table(columns, entry_rows(SAMPLE_ENTRIES)),
            "followed by:",
            table(
                ("entry", "meaning", "unit", "scale"),
                [row[1:] for row in entry_rows(SENSOR_TAIL_ENTRIES)],
            ),
            "With range sensors (`rays`), both are followed by:",
            table(
                ("entry", "meaning", "unit", "scale"),
                [("`ray_0` … `ray_{count − 1}`", RAY_MEANING, "mm", "`range_mm`")],
            ),
            f"Clipping limits the range of `sensor`: fixes and messages to ±{SENSOR_FIX_LIMIT_MM / 1e3:g} m "
            f"from the robot's own start,\nthe start itself to ±{SENSOR_START_LIMIT_MM / 1e3:g} m in the "
            f"world, per coordinate, and `time` to {SENSOR_TIME_LIMIT_S:g} s. Beyond these limits\n"
            "an entry stays constant. A scenario that exceeds them within its horizon gives a "
            "`ReferenceWarning`\n"
            "with the place and the limit, as does a reference that [the robots cannot follow]"
            "(trajectories.md#what-a-robot-can-do);\nscatter of the starts and the options `poses` and "
            "`phase_s` of a reset are not checked. Every constructor warns, and the\ncommands print the "
            "same lines.",
        ]
    )


def reward_section() -> str:
    """Section on the reward terms and their weights."""
    rows = [
        (f"`{name}`", meaning, f"{getattr(DEFAULT_WEIGHTS, name):g}")
        for name, meaning in REWARD_MEANINGS.items()
    ]
    return (
        "The weighted sum of the terms, separately for each robot. `reward={term: weight}` changes weights; "
        "`cooperative=True` gives every robot the mean over the formation.\n\n"
        + table(("term", "meaning", "weight"), rows)
        + "\n\n"
        + LOST_NEVER_PAYS
    )


def info_section() -> str:
    """Section on the entries of info."""
    rows = [(f"`{name}`", meaning) for name, meaning in MEANINGS.items()]
    return (
        "One number or flag for each key; the same keys in `reset` and in every step. `infos=False` returns "
        "empty infos,\nand a sequence of keys returns only these, which saves time.\n\n"
        + table(("key", "meaning"), rows)
    )


SECTIONS = {
    "Actions": action_section,
    "Observations": observation_section,
    "Rewards": reward_section,
    "Info": info_section,
}


def documented(cls: T) -> T:
    """Append the tables to a class's docstring."""
    parts = [f"{title}\n\n{make()}" for title, make in SECTIONS.items()]
    cls.__doc__ = inspect.cleandoc(cls.__doc__ or "") + "\n\n" + "\n\n".join(parts) + "\n"
    return cls


PAGE = """# The environment

Generated by `python -m tlf_env.envs.spec > docs/environment.md`.

`tlf_env.parallel_env(scenario, **fields)` is the PettingZoo parallel environment, `tlf_env.aec_env` its
turn-based form, `gymnasium.make("tlf_env/Infinity-v0", learner="robot_1", others="reference")` the
Gymnasium environment with one learner. `scenario` is a preset (a YAML file shipped in `configs/`, used by
name), a file or a mapping. `env.scenario` contains everything that determines an episode except its seed;
each of its fields is a keyword argument. An unknown keyword is a `TypeError`, an unknown key in a file or a
mapping a `ValueError`; both name the key with its path and, if there is one, the nearest name.

A file or mapping with `base: infinity` is that scenario with the changes that follow: mappings are merged,
all else is replaced. A disturbance has `base`, too, as in
`disturbance: {base: slip, slip: {delta_1_mm_s: 40}}`. `trajectory` may be the name or file of another
scenario, whose trajectory it takes, or a CSV file of waypoints. Files that a file names lie in its own folder
or in the working directory. Code that a scenario or a call names (`module:factory`) is imported only with
`trust=True`, or into a process of its own with `trust="isolated"` ([parts.md](parts.md)). No file can set it.

In YAML files numbers are decimal (`12`, `-0.5`, `5e-1`), and only `true` and `false` are switches (YAML 1.2).
Words and numbers that YAML 1.1 reads otherwise (`yes`, `no`, `on`, `off`, `010`, `0x1F`, `1_000`, `1:30`, a
date) are refused unless they are quoted; a quoted value is a text and never a number. In Python a number is
one of Python or NumPy; `True`, a text or an array is none.

An episode ends for the whole formation at once. `lost`: the true error to the robot's own reference
exceeded `lost_beyond_mm`. `touched`: the outline of a robot met that of another, a wall or an obstacle
([world.md](world.md#touched)). Each of them ends the episode if it is in `end_on`: the robots concerned are
terminated, the others are truncated with `info["end"] == tlf_env.EndReason.OTHER_ROBOT`, so that a learner
bootstraps for robots that did not fail. The horizon truncates all robots.

`reset(seed=..., options={"poses": (n, 3) in mm, mm, rad, "phase_s": seconds})` sets the start poses and the
time on its trajectory at which the leader's reference starts, for that episode only. Heading 0 points along
+y, and positive turns are counter-clockwise (in ROS REP-103, heading 0 points along +x). `state()` is the true
state, for critics.

## Snapshots

`env.get_state()` returns a `tlf_env.Snapshot` of this moment, and `env.set_state(snapshot)` goes back to it:
all that follows is the same, bit for bit, in contact and after the end of an episode, too. `set_state`
returns the observations and infos of that moment, as `reset` does. So several actions can be tried from the
same moment, as a predictive controller or a tree search does:

```python
settings = {"disturbance": "slip", "action": "tracking_twist"}
env = tlf_env.parallel_env("infinity", **settings)
env.reset(seed=0)
for _ in range(100):
    env.step({agent: np.zeros(2) for agent in env.agents})
moment = env.get_state()


def outcome(forward):  # sum of the rewards over half a second
    env.set_state(moment)
    steps = [env.step({agent: [forward, 0.0] for agent in env.agents}) for _ in range(25)]
    return sum(sum(rewards.values()) for _, rewards, *_ in steps)


best = max((-0.2, 0.0, 0.2), key=outcome)
observations, infos = env.set_state(moment)  # and on with the best
print(best)
```

```text
0.2
```

`save` writes a snapshot to one file, for a long run that is to be resumed, or for a report of a moment at
which something goes wrong. In another process, `set_state` needs no `reset` before:

```python
moment.save("moment.safetensors")

again = tlf_env.parallel_env("infinity", **settings)
observations, infos = again.set_state(tlf_env.Snapshot.load("moment.safetensors"))
```

```python
from collections import deque

recent = deque(maxlen=50)  # the last second
env.reset(seed=0)
while env.agents:
    recent.append(env.get_state())
    *_, infos = env.step({agent: [0.5, 0.0] for agent in env.agents})
    if any(info["lost"] for info in infos.values()):
        recent[0].save("before-the-loss.safetensors")
        break
```

- `FormationParallelEnv`, `FormationEnv` (`gymnasium.make(...).unwrapped`), `FormationVectorEnv`, `BatchPlant`
  and `Formation` have both methods, on every plant. A snapshot goes back into an object of the same class
  that was made with the same arguments; threads, render mode and `infos` may differ. (Gymnasium's wrappers
  want a `reset` before the first `step`, too.)
- In it are all states of the engine and of the space (motions, delays, estimators, random processes, contacts
  with the impulses that they remember, pushed and moving bodies), seed and number of the episode,
  `np_random`, and the states of [parts and policies of yours](parts.md#snapshots). Not in it are the random
  generators of the spaces, the counters of wrappers (`TimeLimit`, the AEC conversion), and functions that you
  give to bodies, constraints or collisions.
- Objects that you have added to the space go back, too. They must be there in the same order, with the same
  sizes and masses. (After a wall was removed or moved within an episode, the order in which contacts with
  several walls at once are solved may differ.)
- A snapshot that does not fit is refused with one line that names the first difference, and nothing changes.
  A file is refused if it is damaged, or if it was written by other code of tlf_env or with another version of
  Numba or pymunk, as its future would be another. Nothing in a file is pickled, and loading it runs no code.
- The simulation goes on as if it had not been asked. Snapshots can be pickled, and `==` compares all their
  bits. With three robots `get_state` takes 0.15 ms and `set_state` 0.7 ms, and a file has 90 KB; with 256
  formations in a batch it is 2 ms, 4 ms and 20 MB.

## Objects in the space

Walls, obstacles, bodies to push and moving obstacles are fields of a scenario: [world.md](world.md). What it
has no field for is added to the space. On the plants `pymunk` (the default) and `chipmunk`, `env.space` is a
[pymunk](https://www.pymunk.org) space in mm, s and kg (forces in mN), `env.robot_bodies` contains the robots'
bodies in it, and `env.pushable_bodies` and `env.moving_bodies` those of the scenario's world. (With
`gymnasium.make`, `env.unwrapped.formation_env` has them.) What you add takes part from the next step on:

```python
import pymunk
import tlf_env

env = tlf_env.parallel_env("infinity")
env.reset(seed=0)
wall = pymunk.Segment(env.space.static_body, (-5000, 3300), (8000, 3300), 5)
box = pymunk.Body(2.0, pymunk.moment_for_box(2.0, (150, 150)))
box.position = 0.0, 0.0
person = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
person.position, person.velocity = (-3000.0, 1000.0), (800.0, 0.0)
env.space.add(
    wall, box, pymunk.Poly.create_box(box, (150, 150)), person, pymunk.Circle(person, 200)
)
```

- A robot that meets a static or kinematic shape (a wall, a moving obstacle) is `touched`, as by another robot,
  and `touched_by` says which. A dynamic body (a box) can be pushed, and is not counted. Shapes that you add to
  a robot's body (a bar, a gripper) belong to its outline.
- A contact has the product of both shapes' `friction` and `elasticity`. Those of the robots are
  `outline_friction` and `outline_restitution`, 0 by default; those of a new pymunk shape are 0, too.
- Constraints, such as a [rope to a trailer](../examples/trailer_on_a_rope.py), and
  [forces](../examples/user_force.py) act on robots; the wheels answer one substep later, on `chipmunk` in the
  same one. (There `env.robot_bodies` are the chassis alone: [chipmunk.md](chipmunk.md).) A force
  (`body.apply_force_at_world_point`) acts through the whole next control step and is then 0: apply it before
  each step. A constraint's `impulse` is that of the last substep: divided by `physics_period_s`, it is the
  force.
- A dynamic body that you add slides without friction on the floor. A `PivotJoint` and a `GearJoint` to
  `space.static_body`, with `max_bias` 0 and a `max_force`, are floor friction; a body in the scenario's
  `pushables` has both.
- Leave the space's own `gravity` and `damping` at 0 and 1: on a robot they would act only while something is
  near. Use forces instead.
- Robots get their places from the engine: to move a robot, use the option `poses` of `reset`; a position
  written to its body has no effect.
- After moving a static shape by hand, call `env.space.reindex_shape(shape)`, and read `env.space` again, so
  that it is noticed.
- `reset` keeps the objects, and puts each body back to where the first step found it. Copies and pickles take
  them along and go on bit for bit, with constraints too; functions of yours must be picklable for that.
- While an object is near enough to a robot to act on it, and always with constraints or forces on robots or
  moving bodies, a control step takes [many times as long](world.md#what-it-costs). Objects out of reach change
  no bit of the robots' motion.

## Range sensors

With `rays`, every robot has a ring of range sensors, whose readings follow at the end of its observations:

```python
env = tlf_env.parallel_env(
    "infinity", world="warehouse", rays={"count": 16, "range_mm": 1500.0, "noise_std_mm": 5.0}
)
observations, infos = env.reset(seed=0)
readings_mm = observations["robot_1"][-16:] * env.scenario.rays.range_mm
```

- The rays start at the centre of the outline. `ray_0` points `first_angle_rad` (default 0) counter-clockwise
  from forward, and the others follow counter-clockwise at equal angles, all relative to the true heading.
- A reading is the distance from that centre to the first border of a robot, a wall, an obstacle, a pushed body
  or an object of yours in the space. Shapes on the robot's own body and sensor shapes of pymunk are not seen.
  If nothing is within `range_mm`, the reading is `range_mm`; inside a wall or a disc it is 0.
- `noise_std_mm` adds white noise to every reading, which has its own random stream; readings stay within 0 and
  `range_mm`.
- `period_s` is the time between two readings, by default one control period. In between, the last one holds.
- Walls, static obstacles and round robots are seen on every plant, with the same bits. Everything else needs
  the plant `pymunk` or `chipmunk`.
- Range sensors change no bit of the motion or of the other entries, and policies without rays act as before.

Sixteen rays on each of three robots add 3.5 µs to a control step of 58 µs (7 µs with noise), and in a batch
1.8 µs to 18 µs for each formation (3.5 µs with noise). Where the space contains more than walls, static
obstacles and round robots, a reading takes 0.1 ms more.

## Hearing beyond the predecessor

With `neighbour`, a robot hears the broadcasts of one more robot than its predecessor, in the observation
`tracking`:

```python
env = tlf_env.parallel_env("infinity", robots=6, neighbour={"range_mm": 2000.0})
```

- The neighbour of a robot is the nearest within `range_mm` (at most 5000) of the robots with smaller numbers,
  its predecessor left out. The true distance of the axle midpoints counts, as it decides how well a radio
  receives. The leader and `robot_1` have no neighbour.
- Robots with smaller numbers go first: they do not hear those behind them, and do not wait for them. So no
  two robots wait for each other; the reference of the leader waits for none. The price: a robot that stands
  in the way of one with a smaller number is not noticed by it.
- `neighbour_heard` is 1 if there is a neighbour. The other entries are those of a predecessor, from the
  neighbour's latest message; it may be lost or late like the predecessor's ([`radio`](disturbances.md)).
  Without a neighbour all are 0.
- Hearing changes no bit of the motion or of the other entries. What a robot makes of it is up to its policy:
  the limiter [`supervised`](controller/supervisor.md) slows down and waits.

## Many formations

The following use the batch plant (`tlf_env.BatchPlant`, [architecture.md](architecture.md#many-formations)).
Robots pass through each other and through walls, but `touched` is still reported. All numbers are bit for bit
those of single environments.

- `gymnasium.make_vec("tlf_env/Infinity-v0", num_envs=256, vectorization_mode="vector_entry_point",
  learner="robot_1", autoreset_mode="NextStep", threads=1, **fields)`: one learner in each formation; the
  reference drives the others. Sub-environment k of seed s equals `gymnasium.make(..., plant="batch")` with
  seed s + k. The modes `NextStep`, `SameStep` (`final_obs`, `final_info`) and `Disabled`
  (`reset(options={"reset_mask": mask})`) are those of Gymnasium.
- `baselines.sb3.FormationVecEnv("infinity", formations=256, threads=1, **fields)`: the `VecEnv` of
  stable-baselines3. Every robot is a sub-environment; robot i of formation k has index k·n + i. Its infos
  contain `position_error_mm`, `lost`, `touched` and `end`; `infos=True` gives all keys. That nearly doubles
  the time of a step, because SB3 takes a dictionary for each robot.
  `terminal_observation` and `TimeLimit.truncated` indicate where to bootstrap: robots whose episode was
  ended by another robot are truncated. Several tasks with any numbers of robots:
  `FormationVecEnv({"infinity": [...], "flower": "flower"})`.
- `reset` of all of them takes the options `poses` and `phase_s`, for all formations or one for each. In the
  `VecEnv`, `set_options` sets them for the next `reset`: a mapping for all, or a list with one for each robot.
- `max_episode_steps` shortens the horizon in `make_vec`. In `gymnasium.make`, Gymnasium's own wrapper cuts the
  episode, so that `end` is still 0 then; `horizon_s` gives the same with `end`. `env.spec` contains the length
  of an episode: to make another environment from it with a longer `horizon_s`, pass `max_episode_steps=-1`.
- With a sequence of scenarios and `mixture=True` or shares, every episode draws its scenario (domain
  randomisation).
- With `staggered=True` the episodes that a reset of all formations starts end at different times: that of
  formation k after (k + 1)/formations of the horizon, and all later ones at the horizon. Otherwise each
  rollout of a learner would have all formations at the same time of their episodes.
"""


def page() -> str:
    """The text of ``docs/environment.md``."""
    sections = [f"## {title}\n\n{make()}\n" for title, make in SECTIONS.items()]
    return PAGE + "\n" + "\n".join(sections)


if __name__ == "__main__":
    print(page(), end="")
