"""Memory of a formation and the time of a start, each measured in processes of their own."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from typing import Any

from baselines.speed.crew import Crew
from baselines.speed.environments import MIN_STEPS
from baselines.speed.peers import OURS, PEERS, Peer
from baselines.speed.worker import PeerError, Worker

MEMORY_FORMATIONS = (1024, 8192)
MEMORY_STEPS = 300  # more than the time gap of the ∞, so that the ring buffers are full
START_FORMATIONS = 1024  # of an environment of many formations
CACHE_VARIABLE = "TLF_ENV_CACHE"


def measured_peers(crew: Crew, peers: bool, many: bool) -> list[Peer]:
    """Ours and the peers that are installed; only those of many formations, if so wanted."""
    found = [*OURS.values(), *(PEERS.values() if peers else ())]
    return [one for one in found if crew.has(one) and (one.many or not many)]


def memory_rows(
    crew: Crew, peers: bool, formations: tuple[int, int], update: Callable[[], None]
) -> list[dict[str, Any]]:
    """Growth of the memory of a process by each formation, bytes, on one thread.

    Both numbers of formations have a fresh process. ``resident`` is what the process holds after the steps,
    ``peak`` the most that it held in them; None where the system does not tell.
    """
    rows = []
    for peer in measured_peers(crew, peers, many=True):
        robots = peer.robots[0]
        found = []
        try:
            for count in formations:
                with Worker(peer, robots, 1, crew.python(peer)) as worker:
                    worker.make(count, MIN_STEPS)
                    found.append(worker.ask("memory", formations=count, steps=MEMORY_STEPS))
        except PeerError as error:
            crew.left_out[peer.name] = f"{error}: its memory is left out"
            continue
        finally:
            update()
        rows.append(
            {"env": peer.name, "robots": robots, "formations": list(formations)}
            | {
                kind: None
                if found[0][kind] is None
                else round((found[1][kind] - found[0][kind]) / (formations[1] - formations[0]))
                for kind in ("resident", "peak")
            }
        )
    return rows


def start_row(peer: Peer, python: str, formations: int, cache: str | None) -> dict[str, Any]:
    """Processor time that a fresh process needs up to the end of its first step, s, on one thread."""
    variables = {} if cache is None else {CACHE_VARIABLE: cache}
    with Worker(peer, peer.robots[0], 1, python, variables) as worker:
        worker.make(formations, 1)
        done = worker.ask("drive", formations=formations, steps=1)
        return {
            "env": peer.name,
            "formations": formations,
            "import_s": round(worker.import_s, 2),
            "first_step_s": round(done["processor_s"], 2),
        }


def start_rows(
    crew: Crew, peers: bool, formations: int, update: Callable[[], None]
) -> list[dict[str, Any]]:
    """The starts of ours, with an empty cache of compiled drivers and with a full one, and of the peers."""
    rows = []
    for peer in measured_peers(crew, peers, many=False):
        count = formations if peer.many else 1
        try:
            if peer.name in OURS:
                with tempfile.TemporaryDirectory() as cache:
                    for state in ("empty", "full"):
                        row = start_row(peer, crew.python(peer), count, cache)
                        rows.append({**row, "cache": state})
            else:
                rows.append({**start_row(peer, crew.python(peer), count, None), "cache": None})
        except PeerError as error:
            crew.left_out[peer.name] = f"{error}: its start is left out"
        update()
    return rows
