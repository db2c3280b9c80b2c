"""The processes of the peers that are installed, and what became of the others."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from types import TracebackType

from baselines.speed.environments import TimedEnvironment, served_environments
from baselines.speed.peers import PEERS, Peer, is_missing, missing_line
from baselines.speed.worker import PeerError, Worker


class Crew:
    """Processes of peers; closed as a whole.

    Parameters
    ----------
    pythons
        The Python of each package that does not share ours.

    Attributes
    ----------
    left_out
        A line for each peer that is not timed: how it is installed, or what went wrong.
    workers
        The processes, each with the time that compiling took.
    """

    def __init__(self, pythons: Mapping[str, str]) -> None:
        self.pythons = pythons
        self.left_out: dict[str, str] = {}
        self.workers: list[Worker] = []
        self._open = ExitStack()

    def __enter__(self) -> Crew:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._open.close()

    def python(self, peer: Peer) -> str:
        """The Python that a peer runs under."""
        return self.pythons.get(peer.extra, sys.executable)

    def has(self, peer: Peer) -> bool:
        """Whether a peer can be tried; says how it is installed if not."""
        if peer.extra not in self.pythons and is_missing(peer):
            self.left_out[peer.name] = missing_line(peer)
        return peer.name not in self.left_out

    def environments(
        self, formations: Sequence[int], threads: Sequence[int], steps: int
    ) -> list[TimedEnvironment]:
        """All peers that run in processes of their own, for each number of robots, formations and threads."""
        made: list[TimedEnvironment] = []
        for peer in PEERS.values():
            if not self.has(peer) or not peer.served or (peer.many and not formations):
                continue
            try:
                made += self._of(peer, formations, threads if peer.many else (1,), steps)
            except PeerError as error:
                self.left_out[peer.name] = f"{error}: left out"
        return made

    def _of(
        self, peer: Peer, formations: Sequence[int], threads: Sequence[int], steps: int
    ) -> list[TimedEnvironment]:
        made: list[TimedEnvironment] = []
        for robots in peer.robots:
            for used in threads:
                if used > 1 and max(formations) == 1:
                    continue
                worker = self._open.enter_context(Worker(peer, robots, used, self.python(peer)))
                made += served_environments(peer, worker, robots, formations, used, steps)
                self.workers.append(worker)
        return made
