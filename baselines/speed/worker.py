"""A process that holds one environment and steps it as it is asked."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from baselines.speed.peers import Peer

# The other Python imports no installed package of ours: only the files of `baselines` that it needs.
BOOT = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location(
    "baselines", sys.argv[1] + "/__init__.py", submodule_search_locations=[sys.argv[1]])
sys.modules["baselines"] = module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)
from baselines.speed.served import main
main()
"""
FOLDER = Path(__file__).resolve().parent.parent
PATIENCE_S = 5.0  # that a process has to end in


class PeerError(OSError):
    """A peer could not be made or stepped."""


class Worker:
    """A process that makes and steps an environment under a Python of its own.

    Parameters
    ----------
    peer
        The environment.
    robots
        In each formation.
    threads
        Cores and threads that the process may use.
    python
        The Python that has the environment.
    variables
        More variables of its environment.

    Raises
    ------
    PeerError
        if the environment cannot be imported, in its own words.
    """

    def __init__(
        self,
        peer: Peer,
        robots: int,
        threads: int = 1,
        python: str = sys.executable,
        variables: Mapping[str, str] | None = None,
    ) -> None:
        self.peer, self.robots, self.threads = peer, robots, threads
        words = [peer.factory, str(robots), str(threads), ",".join(peer.packages)]
        self.process = subprocess.Popen(
            [python, "-c", BOOT, str(FOLDER), *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, **(variables or {})},
        )
        try:
            about = self.ask("about")
        except BaseException:
            self.close()
            raise
        self.versions: dict[str, str] = about["versions"]
        self.import_s: float = about["import_s"]
        self.compile_s: dict[int, float] = {}  # formations → seconds

    def ask(self, what: str, **more: Any) -> dict[str, Any]:
        """An answer of the process.

        Raises
        ------
        PeerError
            if it answers with an error, or not at all.
        """
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        try:
            self.process.stdin.write(json.dumps({"do": what, **more}) + "\n")
            self.process.stdin.flush()
            line = self.process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise PeerError(f"{self.peer.name}: its process has ended")
        answer: dict[str, Any] = json.loads(line)
        if "error" in answer:
            raise PeerError(f"{self.peer.name}: {answer['error']}")
        return answer

    def make(self, formations: int, at_once: int) -> None:
        """Make so many formations; those in JAX take so many steps in one go."""
        answer = self.ask("make", formations=formations, at_once=at_once)
        self.compile_s[formations] = answer["compile_s"]

    def drive(self, steps: int, formations: int) -> float:
        """Time of so many steps, s."""
        seconds: float = self.ask("drive", formations=formations, steps=steps)["seconds"]
        return seconds

    def close(self) -> None:
        """End the process."""
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                with suppress(BrokenPipeError):  # of a request that it never read
                    stream.close()
        try:
            self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def __enter__(self) -> Worker:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
