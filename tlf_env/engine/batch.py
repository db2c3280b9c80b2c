"""Many formations at once, one compiled call a step, without contact between robots."""

from __future__ import annotations

import functools
import os
import secrets
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from tlf_env.common.errors import is_one_of, shown
from tlf_env.common.trust import Trust
from tlf_env.engine import drivers, judging, readout
from tlf_env.engine.arrays import Arrays, make_arrays, make_variants
from tlf_env.engine.excerpt import Excerpt, empty_excerpt
from tlf_env.engine.formation import NO_POSES, reference_table, refusal
from tlf_env.engine.outside_base import make_base, separate_base
from tlf_env.engine.settings import make_settings
from tlf_env.engine.snapshot import (
    Snapshot,
    array_numbers,
    checked_arrays,
    checked_snapshot,
    put_arrays,
    scenario_facts,
)
from tlf_env.engine.starting import STARTED
from tlf_env.numerics.compiled import compile_for
from tlf_env.numerics.philox import MAX_SEED, checked_seed
from tlf_env.numerics.pointers import packed
from tlf_env.onboard.parts import real_numbers
from tlf_env.task.info import TIME_GAP_KEY
from tlf_env.task.scenario import Scenario, load_scenario
from tlf_env.task.start import Start, start_options
from tlf_env.task.warn import warn_of

Source = str | Path | Mapping[str, Any] | Scenario

KIND = "BatchPlant"
MAY_DIFFER = ("name", "robots", "robot", "wheel_loop", "ekf", "ekf_slip", "ekf_gyro", "disturbance")


DOUBLE = "double"
PRECISIONS: dict[str, Any] = {DOUBLE: np.float64, "single": np.float32}


class BatchPlant:
    """Formations that are simulated side by side.

    Formation k seeded s is, bit for bit, the single environment seeded s + k on the plant ``batch``,
    and on ``pymunk`` until two outlines meet: here they pass through each other, and the robots are
    marked as ``touched`` in the same control step. Neither the number of formations, nor the threads, nor
    resets of other formations change a bit. Units: mm, s, rad. Arrays are views of the present state.

    Parameters
    ----------
    scenario
        What :func:`~tlf_env.task.scenario.load_scenario` takes, or a sequence of it: formation k then
        runs scenario k modulo their number. They may differ in ``robots``' parameters, ``robot``,
        ``wheel_loop``, ``ekf``, ``ekf_slip``, ``ekf_gyro`` and ``disturbance``. A ``kinematic`` plant stays
        one.
    formations
        How many.
    threads
        How many work on a step; None takes one for each core.
    mixture
        True, or a share for each scenario: every episode of a formation draws its scenario, by its seed.
    trust
        Whether a policy that ``residual_base`` names (``"module:factory"``) may run: in this process (True) or
        in one of its own (``"isolated"``). A policy that is given as an object needs no permission.
    staggered
        Whether a reset of all formations spreads the ends of their episodes: that of formation k ends
        after (k + 1)/formations of the horizon, the later ones at the horizon. For learners: otherwise
        all formations are at the same time of their episodes in each rollout.
    precision
        Of the numbers in the substeps: ``"double"``, or ``"single"``, which is faster. Between control steps
        all numbers are doubles, and sliding wheels are always computed in double precision. For training:
        results in single precision are not those of other plants, bit for bit.
    **overrides
        Fields of all scenarios; ``disturbance_level`` too.

    Raises
    ------
    TypeError
        in one line, for an unknown keyword.
    ValueError
        for a scenario that cannot run in a batch (user-defined parts, ``adversary``), scenarios that
        differ elsewhere, or a number out of range; naming the field.
    """

    def __init__(
        self,
        scenario: Source | Sequence[Source],
        formations: int,
        *,
        threads: int | None = 1,
        mixture: bool | Sequence[float] = False,
        staggered: bool = False,
        precision: str = DOUBLE,
        trust: Trust = False,
        **overrides: Any,
    ) -> None:
        if not is_one_of(precision, PRECISIONS):
            raise ValueError(f"precision {shown(precision)} is not one of {', '.join(PRECISIONS)}")
        self.precision = precision
        if not isinstance(scenario, Sequence) or isinstance(scenario, str):
            scenario = [scenario]
        overrides, base = separate_base(overrides)
        self.scenarios = _alike(_all_for_lanes(scenario, overrides))
        warn_of(self.scenarios)
        self.formations = checked_count("formations", formations)
        if not isinstance(staggered, bool):
            raise ValueError(f"staggered {shown(staggered)} must be True or False")
        steps = self.scenario.horizon_steps * np.arange(1, self.formations + 1)
        self._first_ends = np.maximum(steps // self.formations, 1) if staggered else None
        self.threads = checked_count("threads", os.cpu_count() or 1 if threads is None else threads)
        table = reference_table(self.scenario)
        self.arrays: Arrays = make_arrays(self.scenarios, table, self.formations)
        self._base = make_base(self.scenario, base, trust=trust)
        self._variants = make_variants(self.scenarios, _shares(mixture, len(self.scenarios)))
        each = [make_settings(one) for one in self.scenarios]
        self._settings = each[0]._replace(
            changing=any(one.changing for one in each), number=PRECISIONS[precision](1.0)
        )
        self._packed = packed(self._settings)
        self._packed_arrays, self._packed_of = packed(self.arrays), self.arrays
        self._seeded = np.zeros(self.formations, dtype=np.bool_)
        self._phases_s = np.zeros(1)  # of the tables of the leaders' references
        self._poses = NO_POSES  # start poses of the present episodes, if any are given
        self._nothing = empty_excerpt(self.arrays, 0, 0)
        self._pool: ThreadPoolExecutor | None = None
        self._pool_pid = 0

    @property
    def scenario(self) -> Scenario:
        """The first scenario; the others differ from it in :data:`MAY_DIFFER` only."""
        return self.scenarios[0]

    def reset(
        self,
        seed: int | Sequence[int | None] | None = None,
        mask: np.ndarray | None = None,
        options: Mapping[str, Any] | Start | None = None,
    ) -> None:
        """Start an episode in the formations of the mask.

        Parameters
        ----------
        seed
            Formation k gets ``seed`` + k, or ``seed[k]`` of a sequence. Without a seed (None) its next
            episode begins, or the first of a random seed where there was none.
        mask
            ``(formations,)`` bool; all if None.
        options
            For the episodes that this call starts: ``poses``, start poses of c at rest, ``(robots, 3)``
            or ``(formations, robots, 3)`` in mm, mm, rad; ``phase_s``, the time on its trajectory at
            which a leader's reference starts, one number or one for each formation. Every phase in use
            needs a table of the reference (40 bytes a control step).

        Raises
        ------
        ValueError
            for a seed out of its range, a mask of another shape, an unknown or invalid option, or a
            formation that cannot start; in the last case the formations of the mask have to be reset
            again.
        """
        chosen, given, seeds = self.check_reset(seed, mask)
        start = (
            options
            if isinstance(options, Start)
            else start_options(options, self.scenario.robot_count, self.formations)
        )
        fresh = chosen & (given | ~self._seeded)
        arrays = self.arrays
        if fresh.any():
            if not given[fresh].all():
                random = secrets.randbelow(MAX_SEED - self.formations) + np.arange(self.formations)
                seeds = np.where(given, seeds, random)
            arrays.seeds[fresh] = seeds[fresh]
        arrays.clock[chosen & ~fresh, 2] += 1
        arrays.clock[fresh, 2] = 0
        arrays.clock[chosen, 3] = self.scenario.horizon_steps
        if self._first_ends is not None and chosen.all():
            arrays.clock[:, 3] = self._first_ends
        self._seeded |= chosen
        self._place(chosen, start)
        self._start(chosen)

    def _place(self, chosen: np.ndarray, start: Start) -> None:
        """Keep start poses and phases of the chosen formations' new episodes."""
        if start.poses is not None:
            if not len(self._poses):
                self._poses = np.full((self.formations, self.scenario.robot_count, 3), np.nan)
            self._poses[chosen] = start.poses[chosen]
        elif len(self._poses):
            self._poses[chosen] = np.nan
        if start.phases_s is None:
            self.arrays.routes[chosen] = 0
            return
        phases_s = np.where(chosen, start.phases_s, self._phases_s[self.arrays.routes])
        later = np.unique(phases_s[phases_s != 0.0])
        self._follow_from(np.array([0.0, *later]))
        self.arrays.routes[:] = np.where(phases_s == 0.0, 0, 1 + np.searchsorted(later, phases_s))

    def set_shares(self, mixture: bool | Sequence[float]) -> None:
        """Give the scenarios of a mixture other shares, for the episodes that begin from now on.

        Parameters
        ----------
        mixture
            As for the constructor, True or a share for each scenario; at least 0.

        Raises
        ------
        ValueError
            for a plant that was made without ``mixture``, or wrong shares.
        """
        summed = self._variants.mixture
        if not len(summed):
            raise ValueError(
                "shares need a plant with a mixture; give mixture=True when it is made"
            )
        if mixture is False:
            raise ValueError(f"mixture False must be True or {len(summed)} shares")
        shares = np.array(_shares(mixture, len(summed)))
        summed[:] = np.cumsum(shares)
        summed[np.flatnonzero(shares)[-1] :] = 1.0  # so that rounding draws none with a share of 0

    def check_reset(
        self, seed: int | Sequence[int | None] | None, mask: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which formations a reset would start, which of all have a seed, and the seeds; ``(formations,)``.

        Raises
        ------
        ValueError
            for a seed out of its range, or a mask of another shape.
        """
        return self._checked_mask(mask), *self._checked_seeds(seed)

    def restart(self, mask: np.ndarray, start: Start | None = None) -> None:
        """Start the present episode of the formations of the mask, ``(formations,)`` bool, over again.

        With other start poses and phases if ``start`` is given.
        """
        chosen = self._checked_mask(mask)
        if start is not None:
            self._place(chosen, start)
        self._start(chosen)

    def _start(self, chosen: np.ndarray) -> None:
        arrays = self.arrays
        result, robot, lane = drivers.start(
            self._given(), self._variants, chosen, self._poses, self._packed
        )
        if result != STARTED:
            why = refusal(arrays, self._variants, result, robot, lane)
            raise ValueError(f"formation {lane}: {why}")
        lanes = np.flatnonzero(chosen)
        drivers.control_step(
            self._given(), lanes, self._nothing, drivers.LOOK_AT_START, 0, self._packed
        )

    def _given(self) -> Arrays:
        """The arrays as drivers take them; packed again if others were put in their place."""
        if self._packed_of is not self.arrays:
            self._packed_arrays, self._packed_of = packed(self.arrays), self.arrays
        return self._packed_arrays

    def compile_start(self) -> bool:
        """Compile the drivers of a reset, or load them from the cache; nothing is reset.

        Returns whether any was not in the cache.
        """
        arrays, settings = self.arrays, self._settings
        mask = np.zeros(self.formations, dtype=np.bool_)
        compiled = (
            compile_for(drivers.start, arrays, self._variants, mask, self._poses, settings),
            compile_for(drivers.excerpt_of, arrays, mask, self._nothing),
        )
        return any(compiled)

    def compile_step(self) -> bool:
        """Compile the drivers of a step, in contact, too, or load them from the cache; nothing is stepped.

        Returns whether any was not in the cache.
        """
        arrays, settings = self.arrays, self._settings
        left = drivers.lanes_to_step(0, 0)
        compiled = (
            compile_for(drivers.control_step, arrays, left, self._nothing, 0, 0, settings),
            compile_for(drivers.mark, arrays, 0, 0, 0),
        )
        return any(compiled)

    def excerpt(self, robot: int) -> Excerpt:
        """Memory for the results of one robot in each formation, not yet written."""
        return empty_excerpt(self.arrays, robot, self.formations)

    def write_excerpt(self, out: Excerpt, mask: np.ndarray | None = None) -> None:
        """Write the results of the formations of the mask; all if None."""
        drivers.excerpt_of(self._given(), self._checked_mask(mask), out)

    def reset_finished(self) -> np.ndarray:
        """Start the next episode wherever one ended in the last step; returns their mask."""
        ended = self.ended
        if ended.any():
            self.reset(mask=ended)
        return ended

    def compute_time_gap_of(self, robots: Sequence[int]) -> None:
        """Compute ``time_gap_error_s`` of these robots only; that of the others is NaN from now on.

        It is the one entry of the infos that takes long: the search of a point on the predecessor's path.

        Raises
        ------
        ValueError
            for a number that is not a robot's.
        """
        unknown = sorted(set(robots) - set(range(self.scenario.robot_count)))
        if unknown:
            raise ValueError(
                f"robots {unknown} must be at least 0 and less than {self.scenario.robot_count}"
            )
        timed = self.arrays.timed
        timed[:] = False
        timed[list(robots)] = True
        self.info(TIME_GAP_KEY)[:, ~timed] = np.nan

    def step(self, actions: np.ndarray, excerpt: Excerpt | None = None) -> None:
        """Advance all formations by one control period.

        A formation whose episode has ended continues up to its horizon if it is not reset.

        Parameters
        ----------
        actions
            ``(formations, robots, 2)``.
        excerpt
            Where to write the results of one robot in each formation, if given.

        Raises
        ------
        ValueError
            for actions of another shape or not finite, naming formation and robot; nothing has changed.
        RuntimeError
            if a formation was never reset, or is at its horizon.
        """
        arrays = self.arrays
        given = real_numbers(actions)
        if given is None:
            raise ValueError(
                f"actions must be real numbers in the shape {arrays.actions.shape}, got {shown(actions)}"
            )
        if given.shape != arrays.actions.shape:
            raise ValueError(
                f"actions must have the shape {arrays.actions.shape}, got {given.shape}"
            )
        if not np.isfinite(given).all():
            lane, robot, _ = np.argwhere(~np.isfinite(given))[0]
            raise ValueError(
                f"formation {lane}, robot_{robot}: the action must be finite, got {given[lane, robot].tolist()}"
            )
        over = np.flatnonzero(~self._seeded | (arrays.clock[:, 1] >= arrays.clock[:, 3]))
        if len(over):
            raise RuntimeError(f"formation {over[0]}: call reset() before step()")
        arrays.actions[:] = given
        if self._base is not None:
            self._base.command(arrays)
        threads = min(self.threads, -(-self.formations // drivers.LANES_AT_ONCE))
        left = drivers.lanes_to_step(0, self.formations, threads)
        out = self._nothing if excerpt is None else excerpt
        work = (self._given(), left, out, drivers.WHOLE, 0, self._packed)
        helpers = [self._others().submit(drivers.control_step, *work) for _ in range(threads - 1)]
        drivers.control_step(*work)
        for helper in helpers:
            helper.result()

    def _others(self) -> ThreadPoolExecutor:
        """The other threads, kept from step to step; a forked child has to start its own."""
        if self._pool is None or self._pool_pid != os.getpid():
            self._pool, self._pool_pid = ThreadPoolExecutor(self.threads - 1), os.getpid()
        return self._pool

    def get_state(self) -> Snapshot:
        """Everything that the next steps depend on; :meth:`set_state` goes back to it, bit for bit.

        Raises
        ------
        RuntimeError
            before the first :meth:`reset`.
        ValueError
            in one line, for a policy as ``residual_base`` whose state cannot be read: see
            :mod:`tlf_env.onboard.memory`.
        """
        if not self._seeded.any():
            raise RuntimeError("call reset() before get_state()")
        numbers = array_numbers(self.arrays)
        numbers |= {
            "batch/seeded": self._seeded.copy(),
            "batch/phases_s": self._phases_s.copy(),
            "batch/poses": self._poses.copy(),
            "batch/mixture": self._variants.mixture.copy(),
        }
        memory = {} if self._base is None else {"base": self._base.get_state(numbers)}
        return Snapshot(KIND, self._facts, memory, numbers)

    @functools.cached_property
    def _facts(self) -> dict[str, Any]:
        """What must be equal where a snapshot is put back."""
        return {
            "formations": self.formations,
            "scenarios": [scenario_facts(one) for one in self.scenarios],
            "mixture": bool(len(self._variants.mixture)),
            "staggered": self._first_ends is not None,
            "precision": self.precision,
        }

    def set_state(self, state: Snapshot) -> None:
        """Go back to a moment of this plant, or of another one that was made with the same arguments.

        The number of threads may differ.

        Raises
        ------
        TypeError
            for anything but a :class:`~tlf_env.engine.snapshot.Snapshot`.
        ValueError
            in one line that names the first difference, for a state that does not fit, or that is damaged.
            Then nothing has changed, unless the ``set_state`` of a policy raised an error.
        """
        checked_snapshot(state).check(KIND, {})
        self.restore(state)

    def restore(self, state: Snapshot) -> None:
        """:meth:`set_state` of a snapshot that contains that of a plant."""
        state.check(state.kind, self._facts)
        robots, mixture = self.scenario.robot_count, self._variants.mixture
        given = state.numbers.get("batch/poses", NO_POSES)
        shape = (self.formations, robots, 3) if len(given) else NO_POSES.shape
        more = state.part(
            "batch",
            {
                "seeded": (np.bool_, (self.formations,)),
                "phases_s": (np.float64, (None,)),
                "poses": (np.float64, shape),
                "mixture": (np.float64, mixture.shape),
            },
            ("poses",),
        )
        phases_s, shares = more["phases_s"], more["mixture"]
        if not len(phases_s) or phases_s[0] != 0.0 or (np.diff(phases_s) == 0.0).any():
            raise ValueError("the snapshot is damaged: its phases are not those of tables")
        if len(shares) and (shares[-1] != 1.0 or shares[0] < 0.0 or (np.diff(shares) < 0.0).any()):
            raise ValueError("the snapshot is damaged: its shares of the scenarios do not sum to 1")
        counts = len(self.scenarios), len(phases_s)
        found = checked_arrays(
            state, self.arrays, self._variants, self.scenario, counts, more["seeded"]
        )
        if self._base is not None:
            self._base.set_state(state.tree("base"), state.numbers)
        self._follow_from(phases_s)
        put_arrays(self.arrays, found)
        self._poses, self._seeded[:], mixture[:] = more["poses"].copy(), more["seeded"], shares

    def _follow_from(self, phases_s: np.ndarray) -> None:
        """Have the tables of the leaders' references from these times on; the first is 0."""
        known = dict(zip(self._phases_s.tolist(), self.arrays.tables, strict=True))
        tables = [
            reference_table(self.scenario, phase_s)
            if known.get(phase_s) is None
            else known[phase_s]
            for phase_s in phases_s.tolist()
        ]
        self._phases_s = phases_s.copy()
        self.arrays = self.arrays._replace(tables=np.array(tables))

    @property
    def observations(self) -> np.ndarray:
        """(formations, robots, entries)."""
        arrays = self.arrays
        sensor = self.scenario.observation == "sensor"
        return arrays.sensor_observations if sensor else arrays.observations

    @property
    def rewards(self) -> np.ndarray:
        """(formations, robots)."""
        return self.arrays.rewards

    @property
    def terms(self) -> np.ndarray:
        """Reward terms, (formations, robots, :class:`~tlf_env.task.reward.RewardTerms`)."""
        return self.arrays.terms

    def named(self, name: str) -> Any:
        """A row of the engine's table by name: its named tuple of arrays ``(formations, robots)``; views."""
        return readout.named(self.arrays, name)

    @property
    def infos(self) -> np.ndarray:
        """(formations, robots, :class:`~tlf_env.task.info.Info`)."""
        return self.arrays.infos

    def info(self, key: str) -> np.ndarray:
        """An entry of info by its key, as ``"reward_coarse"`` or ``"end"``: (formations, robots); a view.

        Raises
        ------
        ValueError
            for a key that info does not have.
        """
        return readout.info_of(self.arrays, key)

    @property
    def lost(self) -> np.ndarray:
        """(formations, robots) bool, at any time so far in the episode."""
        return self.arrays.lost

    @property
    def touched(self) -> np.ndarray:
        """(formations, robots) bool, at any time so far in the episode."""
        return self.arrays.touched

    @property
    def touched_by(self) -> np.ndarray:
        """(formations, robots) int8 of :class:`~tlf_env.TouchedBy`: what each touched first."""
        return self.arrays.touched_by

    @property
    def lost_now(self) -> np.ndarray:
        """(formations, robots) bool, for the first time in this step."""
        return self.arrays.lost_now

    @property
    def touched_now(self) -> np.ndarray:
        """(formations, robots) bool, for the first time in this step."""
        return self.arrays.touched_now

    @property
    def ends(self) -> np.ndarray:
        """Why the episode ended in this step, (formations, robots) int8 of :class:`~tlf_env.EndReason`."""
        return self.arrays.ends

    @property
    def terminated(self) -> np.ndarray:
        """(formations, robots) bool: robots that ended the episode in this step, by ``end_on``."""
        return judging.terminated(self.arrays.ends)

    @property
    def truncated(self) -> np.ndarray:
        """(formations, robots) bool: robots whose episode another robot or the horizon ended in this step."""
        return judging.truncated(self.arrays.ends)

    @property
    def ended(self) -> np.ndarray:
        """(formations,) bool: formations whose episode ended in this step."""
        return (self.arrays.ends != 0).any(axis=1)

    @property
    def applied(self) -> np.ndarray:
        """The channels' last values, (formations, robots, channel), channels as in ``PATHS``."""
        return self.arrays.applied[:, :, : self.formations].transpose(2, 1, 0)

    @property
    def step_counts(self) -> np.ndarray:
        """(formations,): control steps since the start of the episode."""
        return self.arrays.clock[:, 1]

    @property
    def episodes(self) -> np.ndarray:
        """(formations,): how many episodes came before, of the same seed."""
        return self.arrays.clock[:, 2]

    @property
    def seeds(self) -> np.ndarray:
        """(formations,)."""
        return self.arrays.seeds

    @property
    def scenario_numbers(self) -> np.ndarray:
        """(formations,): which of ``scenarios`` each runs."""
        return self.arrays.variants

    def state(self) -> np.ndarray:
        """The truth, (formations, robots, :class:`~tlf_env.task.info.State`), in physical units."""
        return readout.state_rows(self.arrays)

    @property
    def memory_per_formation_bytes(self) -> int:
        """Bytes per additional formation."""
        one, two = (
            sum(array.nbytes for array in make_arrays(self.scenarios, self.arrays.tables[0], lanes))
            for lanes in (1, 2)
        )
        return two - one

    def _checked_mask(self, mask: np.ndarray | None) -> np.ndarray:
        if mask is None:
            return np.ones(self.formations, dtype=np.bool_)
        try:
            chosen = np.asarray(mask)
        except ValueError as error:  # of lists of different lengths
            raise ValueError(
                f"mask must be ({self.formations},) bool, got {shown(mask)}"
            ) from error
        if chosen.shape != (self.formations,) or chosen.dtype != np.bool_:
            raise ValueError(
                f"mask must be ({self.formations},) bool, got {chosen.shape} {chosen.dtype}"
            )
        return chosen.copy()

    def _checked_seeds(self, seed: Any) -> tuple[np.ndarray, np.ndarray]:
        """Which formations have a seed, ``(formations,)`` bool, and the seeds."""
        everywhere = np.ones(self.formations, dtype=np.bool_)
        if seed is None:
            return ~everywhere, np.zeros(self.formations, dtype=np.int64)
        if isinstance(seed, np.ndarray) and seed.ndim == 0:
            seed = seed.item()
        several = isinstance(seed, Sequence | np.ndarray) and not isinstance(seed, str | bytes)
        if not several:
            first = checked_seed(seed)
            checked_seed(first + self.formations - 1)
            return everywhere, first + np.arange(self.formations)
        if len(seed) != self.formations:
            raise ValueError(f"seed: {len(seed)} seeds for {self.formations} formations")
        seeds = [0 if one is None else checked_seed(one) for one in seed]
        given = np.array([one is not None for one in seed])
        return given, np.array(seeds, dtype=np.int64)

    def close(self) -> None:
        """End the process in which the policy ``residual_base`` runs, if any."""
        if self._base is not None:
            self._base.close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_pool": None}


def _for_lanes(source: Source, overrides: Mapping[str, Any]) -> Scenario:
    """A scenario of a plant without contact."""
    loaded = load_scenario(source, **overrides)
    if loaded.plant == "pymunk":
        loaded = load_scenario(loaded, plant="batch")
    loaded.check_lanes()
    return loaded


def _all_for_lanes(sources: Sequence[Source], overrides: Mapping[str, Any]) -> list[Scenario]:
    """Scenarios of plants without contact; an error names the one that it concerns."""
    found = []
    for number, source in enumerate(sources):
        try:
            found.append(_for_lanes(source, overrides))
        except ValueError as error:
            if len(sources) == 1:
                raise
            raise ValueError(f"scenario {number}: {error}") from error
    return found


def _alike(scenarios: list[Scenario]) -> tuple[Scenario, ...]:
    """The scenarios, which must be alike but for :data:`MAY_DIFFER`."""
    if not scenarios:
        raise ValueError("scenario: the sequence is empty")
    first = scenarios[0]
    for number, other in enumerate(scenarios):
        if other.robot_count != first.robot_count:
            raise ValueError(
                f"scenario {number}: robots is {other.robot_count}, that of the first "
                f"{first.robot_count}; a batch needs the same number"
            )
        for field in Scenario.model_fields:
            mine, theirs = getattr(first, field), getattr(other, field)
            if field not in MAY_DIFFER and mine != theirs:
                raise ValueError(
                    f"scenario {number}: {field} is {theirs!r}, that of the first {mine!r}; the "
                    f"scenarios of a batch may differ in {', '.join(MAY_DIFFER)}"
                )
        if other.smoothing_steps != first.smoothing_steps:
            raise ValueError(
                f"scenario {number}: broadcasts are smoothed over ±{other.smoothing_steps} control periods, "
                f"those of the first over ±{first.smoothing_steps}; set the same broadcast_smoothing_s"
            )
    return tuple(scenarios)


def _shares(mixture: bool | Sequence[float], scenarios: int) -> list[float]:
    """Shares that sum to 1, or none."""
    if mixture is False:
        return []
    weights = np.ones(scenarios) if mixture is True else real_numbers(mixture)
    with np.errstate(over="ignore"):
        total = np.nan if weights is None else weights.sum()
    if (
        weights is None
        or weights.shape != (scenarios,)
        or not (weights >= 0).all()
        or not 0 < total < np.inf
    ):
        raise ValueError(
            f"mixture {shown(mixture)} must be True or {scenarios} shares, at least 0 and not all 0"
        )
    return (weights / total).tolist()


def checked_count(name: str, value: int) -> int:
    """A whole number of things, at least 1.

    Raises
    ------
    ValueError
        naming it, for anything else.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name} {shown(value)} must be a whole number, at least 1")
    return int(value)
