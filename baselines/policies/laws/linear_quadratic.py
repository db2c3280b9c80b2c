"""The linear-quadratic law: optimal feedback for small errors about the reference's motion, with preview."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from baselines.policies.laws.law import UNBOUNDED, ErrorBounds, LawFile, Memoryless, angles
from tlf_env.common.models import Positive
from tlf_env.numerics.compiled import block, driver
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.supervisor import Neighbour
from tlf_env.task.scenario import DEFAULT_PREVIEW_S

MOST_STEPS = 100_000  # of the recursion, for each action
# The recursion divides by the squares of the tolerances: much smaller or larger ones are lost in rounding.
Tolerance = Annotated[Positive, Field(ge=1e-5, le=1e6)]


class LinearQuadraticFile(LawFile):
    """Parameters of :class:`LinearQuadratic` in a file; None: its default."""

    forward_mm: Tolerance | None = None
    lateral_mm: Tolerance | None = None
    heading_rad: Tolerance | None = None
    speed_mm_s: Tolerance | None = None
    yaw_rate_rad_s: Tolerance | None = None
    horizon_s: Positive | None = None
    step_s: Annotated[Positive, Field(le=1.0)] | None = None


class LinearQuadratic(Memoryless):
    """Time-varying linear-quadratic regulator of the errors about the reference's motion.

    For small errors e = (e₁, e₂, e₃) of eq. (16) and corrections v = (u₁ − u₁* cos e₃, u₂ − u₂*) of the
    reference's twist,

        ė = A e − B v,  A = [[0, −u₂*, 0], [u₂*, 0, −u₁*], [0, 0, 0]],  B = [[1, 0], [0, 0], [0, 1]]

    (Klančar and Škrjanc, "Tracking-error model-based predictive control for mobile robots in real time",
    Robotics and Autonomous Systems 55, 2007, pages 460 to 469). The law minimises the sum of
    (error/tolerance)² and (correction/tolerance)² over ``horizon_s`` (Bryson's rule), by the backward
    Riccati recursion (Anderson and Moore, "Optimal control: linear quadratic methods", Prentice Hall 1990)
    with u* piecewise linear through now and the previews, and constant afterwards. The recursion ends with
    the weight 0, so that a reference at rest, about which a lateral error cannot be controlled, needs no
    case of its own: the longer a lateral error must remain, the more it costs, and the yaw rate's gain on it
    is 0.

    Parameters
    ----------
    forward_mm, lateral_mm, heading_rad
        Tolerated errors.
    speed_mm_s, yaw_rate_rad_s
        Tolerated corrections.
    horizon_s, step_s
        Horizon of the cost, and the step of the recursion, for which a correction is held.

    Raises
    ------
    ValueError
        if the horizon is shorter than a step, or longer than :data:`MOST_STEPS` of them.
    """

    def __init__(
        self,
        preview_s: tuple[float, ...] = DEFAULT_PREVIEW_S,
        forward_mm: float = 10.0,
        lateral_mm: float = 10.0,
        heading_rad: float = 0.04,
        speed_mm_s: float = 13.0,
        yaw_rate_rad_s: float = 0.14,
        horizon_s: float = 3.0,
        step_s: float = 0.03,
        rays: Rays | None = None,
        neighbour: Neighbour | None = None,
        bounds: ErrorBounds = UNBOUNDED,
    ) -> None:
        super().__init__(preview_s, rays, neighbour, bounds)
        if horizon_s < step_s:
            raise ValueError(f"horizon_s {horizon_s:g} must be at least step_s {step_s:g}")
        if horizon_s / step_s > MOST_STEPS:
            raise ValueError(
                f"horizon_s {horizon_s:g} must be at most {MOST_STEPS} steps of step_s {step_s:g}"
            )
        self.error_weights = np.array([forward_mm, lateral_mm, heading_rad]) ** -2.0
        self.correction_weights = np.array([speed_mm_s, yaw_rate_rad_s]) ** -2.0
        self.step_s, self.steps = step_s, round(horizon_s / step_s)
        self.times_s = np.array([0.0, *(time_s for time_s in preview_s if time_s > 0.0)])

    def twist(self, seen: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The reference's twist plus the gain times the errors."""
        later = [f"in_{time_s:g}_s" for time_s in self.times_s[1:]]
        twists = [
            np.stack([seen[f"reference_{name}"], *(seen[f"{name}_{when}"] for when in later)])
            for name in ("u_1", "u_2")
        ]
        k = self.gains(np.stack(twists, axis=-1).swapaxes(0, 1))
        e_1, e_2, e_3 = seen["e_1"], seen["e_2"], angles(seen["sin_e_3"], seen["cos_e_3"])
        v_1, v_2 = (k[:, i, 0] * e_1 + k[:, i, 1] * e_2 + k[:, i, 2] * e_3 for i in (0, 1))
        return seen["reference_u_1"] * seen["cos_e_3"] + v_1, seen["reference_u_2"] + v_2

    def gains(self, twists: np.ndarray) -> np.ndarray:
        """Gains ``(row, 2, 3)`` of the corrections on the errors, for the reference's twists.

        Parameters
        ----------
        twists
            ``(row, time, 2)`` in mm/s and rad/s at :attr:`times_s`.
        """
        out = np.empty((len(twists), 2, 3))
        _gains(
            np.ascontiguousarray(twists, dtype=np.float64),
            self.times_s,
            self.error_weights * self.step_s,
            self.correction_weights * self.step_s,
            self.step_s,
            self.steps,
            out,
        )
        return out


@block
def _discretised(
    u_1: float, u_2: float, step: float, transition: np.ndarray, effect: np.ndarray
) -> None:
    """e⁺ = F e + G v of a step with a constant twist u*, to third order in the step."""
    turn, half = u_2 * step, 0.5 * step
    transition[0, 0] = transition[1, 1] = 1.0 - 0.5 * turn * turn
    transition[1, 0] = turn * (1.0 - turn * turn / 6.0)
    transition[0, 1] = -transition[1, 0]
    transition[0, 2] = half * turn * u_1
    transition[1, 2] = -step * u_1 * (1.0 - turn * turn / 6.0)
    transition[2, 0] = transition[2, 1] = 0.0
    transition[2, 2] = 1.0
    effect[0, 0] = -step * (1.0 - turn * turn / 6.0)
    effect[1, 0] = -half * turn
    effect[2, 0] = 0.0
    effect[0, 1] = -step * step * turn * u_1 / 6.0
    effect[1, 1] = half * step * u_1
    effect[2, 1] = -step


@block
def _product(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@driver
def _gains(
    twists: np.ndarray,
    times: np.ndarray,
    q: np.ndarray,
    r: np.ndarray,
    step: float,
    steps: int,
    out: np.ndarray,
) -> None:
    """Backward Riccati recursion of each row: K = (R + GᵀPG)⁻¹ GᵀPF, P ← Q + FᵀP(F − GK)."""
    f, g, p = np.empty((3, 3)), np.empty((3, 2)), np.empty((3, 3))
    pf, pg, gpf, gpg = np.empty((3, 3)), np.empty((3, 2)), np.empty((2, 3)), np.empty((2, 2))
    last = times.shape[0] - 1
    for row in range(twists.shape[0]):
        p[:, :] = 0.0
        gain = out[row]
        for k in range(steps - 1, -1, -1):
            time, i = (k + 0.5) * step, 0
            while i < last and times[i + 1] <= time:
                i += 1
            u_1, u_2 = twists[row, i, 0], twists[row, i, 1]
            if i < last:
                share = (time - times[i]) / (times[i + 1] - times[i])
                u_1 += share * (twists[row, i + 1, 0] - u_1)
                u_2 += share * (twists[row, i + 1, 1] - u_2)
            _discretised(u_1, u_2, step, f, g)
            for j in range(3):
                p[j, j] += q[j]
            _product(p, f, pf)
            _product(p, g, pg)
            _product(g.T, pf, gpf)
            _product(g.T, pg, gpg)
            a, b, c = gpg[0, 0] + r[0], gpg[0, 1], gpg[1, 1] + r[1]
            scale = 1.0 / (a * c - b * b)
            for j in range(3):
                gain[0, j] = scale * (c * gpf[0, j] - b * gpf[1, j])
                gain[1, j] = scale * (a * gpf[1, j] - b * gpf[0, j])
            _product(g, gain, p)
            for i in range(3):
                for j in range(3):
                    p[i, j] = f[i, j] - p[i, j]
            _product(pf.T, p, f)
            for i in range(3):
                for j in range(3):
                    p[i, j] = 0.5 * (f[i, j] + f[j, i])
        for j in range(3):
            gain[0, j], gain[1, j] = -gain[0, j], -gain[1, j]
