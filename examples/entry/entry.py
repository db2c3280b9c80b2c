"""A competition's entry: observations come in, actions go out. It needs NumPy only.

Run it with

    tlf bench --entry examples/entry --trust --tasks infinity --disturbances nominal --seeds 20000:20002
"""

import json
import struct
import sys

import numpy as np

AHEAD_MM = 80.0  # the point that is steered
GAIN_PER_S = 1.3
BOUND_MM = 60.0  # larger errors count as this
ACCELERATION_MM_S2, YAW_ACCELERATION_RAD_S2, YAW_RATE_RAD_S = 150.0, 8.0, 1.5

requests, answers = sys.stdin.buffer, sys.stdout.buffer
sys.stdout = sys.stderr  # what is printed must not get between the answers


def receive() -> bytes | None:
    """The next message; None at the end of the episode."""
    head = requests.read(4)
    return requests.read(*struct.unpack("<I", head)) if len(head) == 4 else None


def send(message: bytes) -> None:
    """Answer with a message."""
    answers.write(struct.pack("<I", len(message)) + message)
    answers.flush()


class Steering:
    """The law, for all robots at once.

    Parameters
    ----------
    hello
        The first message: number of robots, names and scales of the observation, scales of the action.
    """

    def __init__(self, hello: dict) -> None:
        self.scales = np.array([entry["scale"] for entry in hello["observation"]])
        self.names = [entry["name"] for entry in hello["observation"]]
        self.full = np.array([entry["scale"] for entry in hello["action"]])
        self.most = hello["control_period_s"] * np.array(
            [ACCELERATION_MM_S2, YAW_ACCELERATION_RAD_S2]
        )
        self.last = np.zeros((hello["robots"], 2))  # the robots begin at rest

    def act(self, rows: np.ndarray) -> np.ndarray:
        """Actions ``(robot, 2)`` for the observations ``(robot, entry)``."""
        seen = dict(zip(self.names, (rows * self.scales).T, strict=True))
        e_1, e_2 = (np.clip(seen[name], -BOUND_MM, BOUND_MM) for name in ("e_1", "e_2"))
        sin, cos = seen["sin_e_3"], seen["cos_e_3"]
        u_1, u_2 = seen["reference_u_1"], seen["reference_u_2"]
        # Velocity of the point ahead of the reference, plus a gain on the error, in the robot's axes.
        forward = u_1 * cos - AHEAD_MM * u_2 * sin + GAIN_PER_S * (e_1 + AHEAD_MM * (cos - 1.0))
        left = u_1 * sin + AHEAD_MM * u_2 * cos + GAIN_PER_S * (-e_2 + AHEAD_MM * sin)
        wanted = np.stack(
            [forward - seen["slip_1"], np.clip(left / AHEAD_MM, -YAW_RATE_RAD_S, YAW_RATE_RAD_S)],
            axis=1,
        )
        self.last += np.clip(wanted - self.last, -self.most, self.most)
        return np.clip(self.last / self.full, -1.0, 1.0)


def main() -> None:
    """Answer until the input ends."""
    hello = json.loads(receive() or b"{}")
    law = Steering(hello)
    send(json.dumps({"protocol": hello["protocol"]}).encode())
    while (message := receive()) is not None:
        rows = np.frombuffer(message, dtype=hello["dtype"]).reshape(hello["robots"], -1)
        send(law.act(rows).astype(hello["dtype"]).tobytes())


if __name__ == "__main__":
    main()
