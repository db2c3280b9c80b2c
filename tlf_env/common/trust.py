"""Permission to run code that a name stands for."""

from __future__ import annotations

from typing import Literal

# Not at all (False), in this process (True), or in a process of its own. No result depends on it.
ISOLATED: Literal["isolated"] = "isolated"
Trust = bool | Literal["isolated"]
