"""Entries of the competition: their cards, and what their programs answer."""

from __future__ import annotations

from typing import Any

import numpy as np
from campaign.fuzzing.cases import changed
from campaign.fuzzing.checks import finite, refused, working_folder
from campaign.fuzzing.registry import target
from hypothesis import strategies as st

from baselines.policies import entry_process
from baselines.policies.entries import load_entry
from baselines.policies.entry_process import EntryProcess
from baselines.policies.registry import make_policy
from tlf_env.common.presets import yaml_text
from tlf_env.task.scenario import load_scenario

ENTRIES: list[Any] = [
    {
        "name": "a",
        "authors": ["b"],
        "kind": "code",
        "command": ["python", "entry.py"],
        "scenario": {"action": "twist", "observation": "tracking", "preview_s": [0.5]},
    },
    {"name": "a", "authors": ["b"], "kind": "weights", "file": "own.safetensors"},
]


@target(changed(lambda: ENTRIES, most=3), share=1.0)
def entries(case: Any) -> None:
    """Cards of competition entries; no program is started."""
    with working_folder() as folder:
        (folder / "entry.yaml").write_text(yaml_text(case))
        refused(lambda: load_entry(folder))
        refused(lambda: make_policy(f"entry:{folder}", load_scenario("infinity")))


ANSWERS = """
import sys
data = bytes.fromhex(sys.argv[1])
out = sys.stdout.buffer
while data:
    size = int.from_bytes(sys.stdin.buffer.read(4), "little")
    if not size:
        break
    sys.stdin.buffer.read(size)
    length = data[0]
    out.write(data[1 : 1 + length])
    out.flush()
    data = data[1 + length :]
"""

HELLO = b'\x0f\x00\x00\x00{"protocol": 1}'

answer = st.one_of(
    st.just(HELLO),
    st.binary(max_size=40),
    st.binary(min_size=16, max_size=16).map(lambda body: b"\x10\x00\x00\x00" + body),
)


@target(st.lists(answer, min_size=1, max_size=3), share=0.02)
def entry_programs(case: Any) -> None:
    """Answers of an entry's program."""
    data = b"".join(bytes([len(one)]) + one for one in case)
    with working_folder() as folder:
        (folder / "entry.py").write_text(ANSWERS)

        entry_process.START_LIMIT_S = 2.0  # for the first answer: 60 s

        def spoken() -> None:
            command = ("python", "entry.py", data.hex())
            process = EntryProcess("entry", command, folder, {"dtype": "<f4"}, (2, 3))
            try:
                for _ in range(2):
                    finite("actions of an entry", process.act(np.zeros((2, 3), np.float32)))
            finally:
                process.close()

        refused(spoken)
