"""Quantities of the engine by name, for code outside: renderer, interfaces, recorded runs, benchmarks."""

from __future__ import annotations

from typing import Any

import numpy as np

from tlf_env.disturbances.channels import CHANNELS
from tlf_env.engine.arrays import Arrays
from tlf_env.onboard.observer import Reference
from tlf_env.task.info import INFO_KEYS, Info, State, check_key
from tlf_env.task.reward import RewardTerms

FIRST_TERM = len(Info._fields)
FIRST_CHANNEL = FIRST_TERM + len(RewardTerms._fields)
FIRST_FLAG = FIRST_CHANNEL + len(CHANNELS)


def named(arrays: Arrays, name: str) -> Any:
    """A row of :data:`tlf_env.engine.layout.ROWS`: its named tuple of arrays ``(formation, robot)``; views.

    Raises
    ------
    KeyError
        for a name that is not in the table.
    """
    row = arrays.named(name)
    return type(row)(*(field.T for field in row))


def info(arrays: Arrays) -> Any:
    """:class:`~tlf_env.task.info.Info` of the last step, each field ``(formation, robot)``; views."""
    return Info(*np.moveaxis(arrays.infos, 2, 0))


def info_of(arrays: Arrays, key: str) -> np.ndarray:
    """An entry of info by its key, ``(formation, robot)``; a view.

    Raises
    ------
    ValueError
        for a key that info does not have.
    """
    check_key(key)
    place = INFO_KEYS.index(key)
    if place < FIRST_TERM:
        return arrays.infos[:, :, place]
    if place < FIRST_CHANNEL:
        return arrays.terms[:, :, place - FIRST_TERM]
    if place < FIRST_FLAG:
        return arrays.applied[place - FIRST_CHANNEL, :, : len(arrays.seeds)].T
    flags = {
        "lost": arrays.lost,
        "touched": arrays.touched,
        "touched_by": arrays.touched_by,
        "end": arrays.ends,
    }
    return flags[key]


def info_rows(
    arrays: Arrays, lane: int = 0, channels: np.ndarray | slice = slice(None)
) -> list[tuple[float, ...]]:
    """The infos of a formation's robots, each a tuple in the order of ``INFO_KEYS``.

    Of the channels only those at the given places.
    """
    none = not isinstance(channels, slice) and len(channels) == 0
    infos = arrays.infos[lane].tolist()
    rows = zip(
        infos,
        arrays.terms[lane].tolist(),
        [()] * len(infos) if none else arrays.applied[channels, :, lane].T.tolist(),
        arrays.lost[lane].tolist(),
        arrays.touched[lane].tolist(),
        arrays.touched_by[lane].tolist(),
        arrays.ends[lane].tolist(),
        strict=True,
    )
    return [
        (*info, *terms, *applied, lost, touched, touched_by, end)
        for info, terms, applied, lost, touched, touched_by, end in rows
    ]


def reference(arrays: Arrays) -> Any:
    """:class:`~tlf_env.onboard.observer.Reference` of every robot now, each field ``(formation, robot)``."""
    slots = (arrays.clock[:, 1] % arrays.references.shape[1])[None, None, None, :]
    lanes = len(arrays.seeds)
    now = np.take_along_axis(arrays.references[:, :, :, :lanes], slots, axis=1)[:, 0]
    return Reference(*now.transpose(0, 2, 1))


def true_positions(arrays: Arrays, step: int) -> np.ndarray:
    """True position of c at a control step of the last gap, ``(2, formation, robot)``, mm."""
    return arrays.slot(arrays.paths, step)[:2].transpose(0, 2, 1)


def state(arrays: Arrays) -> Any:
    """:class:`~tlf_env.task.info.State`, each field ``(formation, robot)``, in physical units."""
    motion, now = named(arrays, "motion"), reference(arrays)
    d = named(arrays, "body").d
    sin, cos = np.sin(motion.theta), np.cos(motion.theta)
    return State(
        x_mm=motion.x - d * sin,
        y_mm=motion.y + d * cos,
        sin_theta=sin,
        cos_theta=cos,
        castor_rad=np.remainder(motion.psi - motion.theta + np.pi, 2 * np.pi) - np.pi,
        forward_mm_s=-motion.v_x * sin + motion.v_y * cos,
        right_mm_s=motion.v_x * cos + motion.v_y * sin - motion.w * d,
        yaw_rad_s=motion.w,
        omega_l_rad_s=motion.omega_l,
        omega_r_rad_s=motion.omega_r,
        reference_x_mm=now.x,
        reference_y_mm=now.y,
    )


def state_rows(arrays: Arrays) -> np.ndarray:
    """The true state, ``(formation, robot, State)``, in physical units."""
    return np.stack(state(arrays), axis=-1)
