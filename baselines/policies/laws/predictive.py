"""Nonlinear model predictive control with preview, and the limits of the robot as constraints."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from pydantic import Field

from baselines.policies.laws.law import UNBOUNDED, ErrorBounds, LawFile, Remembering
from tlf_env.common.errors import install_command
from tlf_env.common.models import NonNegative, Positive, Whole
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.supervisor import Neighbour

PREVIEW_S = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
NODE = ("forward", "right", "sin_turn", "cos_turn", "u_1", "u_2")
STATES, CONTROLS, SLACKS = (
    5,
    2,
    3,
)  # forward, right, turn, u₁, u₂; their accelerations; see _problem
PRICE = 1e5  # of an excess as large as the limit


class PredictiveFile(LawFile):
    """Parameters of :class:`Predictive` in a file; None: its default."""

    position_mm: Positive | None = None
    heading_rad: Positive | None = None
    speed_mm_s: Positive | None = None
    turning_rad_s: Positive | None = None
    jump_mm_s: Positive | None = None
    effort_mm_s2: Positive | None = None
    turning_effort_rad_s2: Positive | None = None
    last_weight: Positive | None = None
    dead_time_s: NonNegative | None = None
    steps: Whole | None = Field(default=None, ge=1)
    acceleration_mm_s2: Positive | None = None
    turning_acceleration_mm_s2: Positive | None = None
    yaw_acceleration_rad_s2: Positive | None = None
    yaw_rate_rad_s: Positive | None = None
    lateral_acceleration_mm_s2: Positive | None = None
    reverse_mm_s: Positive | None = None
    free_speed_mm_s: NonNegative | None = None
    free_reach_mm: Positive | None = None


class Predictive(Remembering):
    """Nonlinear model predictive control by real-time iterations.

    Over the previews, the law chooses accelerations a, constant between one preview and the next, of a
    robot with the speed u₁ and yaw rate u₂. The cost is the sum over the previews of (deviation/tolerance)²
    of position, heading, speed, yaw rate and a from the reference's; the constraints are the limits of the
    robot on the sizes of a₁ (less in a turn), a₂, u₂ and u₁ u₂, and on reversing. Near the reference the speed
    may also jump, within a band about the reference's. The limits are those of the limiter ``body``. Those
    on the twist are soft, at a high price, since an estimate that jumps may start outside of them. Where
    nothing behind the law subtracts the estimated slip, the prediction contains it.

    In each control period the last solution, shifted by the period, is improved by one step of sequential
    quadratic programming (Diehl, Bock and Schlöder, "A real-time iteration scheme for nonlinear optimization
    in optimal feedback control", SIAM Journal on Control and Optimization 43, 2005, pages 1714 to 1736): the
    motion is predicted from the observed state, linearised by CasADi (Andersson et al., Mathematical
    Programming Computation 11, 2019) with the Gauss–Newton Hessian, its states eliminated, and the dense
    quadratic program solved by DAQP (Arnström, Bemporad and Axehill, IEEE Transactions on Automatic Control
    67, 2022). No compiler is needed.

    A shooting interval ends at each preview; the law asks for 10 of them up to 1 s. Bounds on errors move
    the whole reference.

    Parameters
    ----------
    position_mm, heading_rad, speed_mm_s, turning_rad_s
        Tolerances of the deviations.
    jump_mm_s, effort_mm_s2, turning_effort_rad_s2
        Tolerances of the jump and of a.
    last_weight
        Factor on the squared deviations at the last preview.
    dead_time_s
        The last command lasts this long from now, at most up to half of the first preview.
    steps
        Steps of sequential quadratic programming in a control period.
    acceleration_mm_s2, turning_acceleration_mm_s2, yaw_acceleration_rad_s2, yaw_rate_rad_s
        Limits as in :class:`tlf_env.onboard.limiter.TwistLimits`, also those that follow.
    lateral_acceleration_mm_s2, reverse_mm_s, free_speed_mm_s, free_reach_mm
        The same.

    Raises
    ------
    ValueError
        if CasADi is not installed, there is no preview, or the first is at 0 s.
    """

    scenario_overrides = {"preview_s": PREVIEW_S}

    def __init__(
        self,
        preview_s: tuple[float, ...] = PREVIEW_S,
        position_mm: float = 20.0,
        heading_rad: float = 0.3,
        speed_mm_s: float = 100.0,
        turning_rad_s: float = 1.0,
        jump_mm_s: float = 300.0,
        effort_mm_s2: float = 300.0,
        turning_effort_rad_s2: float = 6.0,
        last_weight: float = 5.0,
        dead_time_s: float = 0.02,
        steps: int = 1,
        acceleration_mm_s2: float = 195.0,
        turning_acceleration_mm_s2: float = 150.0,
        yaw_acceleration_rad_s2: float = 11.5,
        yaw_rate_rad_s: float = 1.5,
        lateral_acceleration_mm_s2: float = 165.0,
        reverse_mm_s: float = 20.0,
        free_speed_mm_s: float = 130.0,
        free_reach_mm: float = 27.0,
        rays: Rays | None = None,
        neighbour: Neighbour | None = None,
        bounds: ErrorBounds = UNBOUNDED,
    ) -> None:
        super().__init__(preview_s, rays, neighbour, bounds)
        casadi_package()
        if not preview_s or preview_s[0] <= 0 or any(np.diff(preview_s) <= 0):
            raise ValueError(
                f"nmpc needs increasing previews above 0, got preview_s {tuple(preview_s)}"
            )
        self.steps, self.memory_size = steps, CONTROLS * len(preview_s)
        self.intervals_s = np.diff((0.0, *preview_s))
        self.most = np.array([acceleration_mm_s2, yaw_acceleration_rad_s2])
        self.lateral_acceleration_mm_s2 = lateral_acceleration_mm_s2
        self.turning_loss = max(acceleration_mm_s2 - turning_acceleration_mm_s2, 0.0)
        self.free_speed_mm_s, self.free_reach_mm = free_speed_mm_s, free_reach_mm
        self.tolerances = (position_mm, position_mm, heading_rad, speed_mm_s, turning_rad_s)
        self.efforts = (effort_mm_s2, turning_effort_rad_s2)
        self.jump_mm_s, self.last_weight = jump_mm_s, last_weight
        self.dead_time_s = min(dead_time_s, 0.5 * preview_s[0])
        self._build, self._solve = _problem(
            tuple(preview_s),
            (*self.tolerances, jump_mm_s, *self.efforts),
            last_weight,
            self.dead_time_s,
            (yaw_rate_rad_s, lateral_acceleration_mm_s2, reverse_mm_s),
        )
        self._nodes = [f"{name}_in_{time_s:g}_s" for time_s in preview_s for name in NODE]

    def step(
        self, seen: dict[str, np.ndarray], memory: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The twist after a control period of the planned accelerations, row by row."""
        start = np.stack(
            [
                seen[f"{name}_{i}"]
                for name in ("granted_u", "left_slip", "present_u")
                for i in (1, 2)
            ],
            axis=-1,
        )
        nodes = np.stack([seen[name] for name in self._nodes], axis=-1)
        nodes = nodes.reshape(len(memory), -1, len(NODE)).copy()
        for i, name in enumerate(("e_1", "e_2")):
            nodes[:, :, i] += (seen[name] - seen[f"whole_{name}"])[:, None]
        plans = memory.reshape(len(memory), -1, CONTROLS)
        share = np.minimum(self.period_s / self.intervals_s, 1.0)[:, None]
        after = np.concatenate([plans[:, 1:], np.zeros_like(plans[:, :1])], axis=1)
        plans[:] = (1.0 - share) * plans + share * after
        jumps = np.zeros(len(plans))
        low, high = self._jumps(seen)
        for i in range(len(plans)):
            for _ in range(self.steps):
                plans[i], jumps[i] = self.improved(start[i], nodes[i], plans[i], low[i], high[i])
        twist = start[:, :2] + plans[:, 0] * self.period_s
        return twist[:, 0] + jumps, twist[:, 1]

    def _jumps(self, seen: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Range of the jump of the speed, as of the limiter: within a band about the reference's speed."""
        far = (seen["whole_e_1"] ** 2 + seen["whole_e_2"] ** 2) / self.free_reach_mm**2
        free = self.free_speed_mm_s / (1.0 + far * far)
        missing = seen["present_u_1"] - seen["granted_u_1"]
        inside = np.abs(missing) <= free
        return np.where(inside, missing - free, 0.0), np.where(inside, missing + free, 0.0)

    def most_of(self, start: np.ndarray) -> np.ndarray:
        """Largest accelerations ``(2,)``, as of the limiter: in a turn less torque is left for a₁."""
        speed, turning = start[:2] + start[2:4]
        used = min(abs(speed * turning) / self.lateral_acceleration_mm_s2, 1.0)
        return self.most - (self.turning_loss * used * used, 0.0)

    def improved(
        self,
        start: np.ndarray,
        nodes: np.ndarray,
        plan: np.ndarray,
        low: float = 0.0,
        high: float = 0.0,
    ) -> tuple[np.ndarray, float]:
        """A plan ``(preview, 2)`` and a jump after one step of sequential quadratic programming.

        Parameters
        ----------
        start
            The twist granted last, the slip that is not subtracted, and the reference's twist, mm/s and
            rad/s each.
        nodes
            ``(preview, 6)``: the entries of each preview.
        plan
            Accelerations so far, mm/s² and rad/s².
        low, high
            Range of the jump of the speed at once, mm/s.
        """
        h, g, a, least = self._build(start, nodes.T, plan.T)
        most = self.most_of(start)
        lowest = np.concatenate([(-most - plan).ravel(), [low], np.zeros(SLACKS)])
        highest = np.concatenate([(most - plan).ravel(), [high], np.full(SLACKS, np.inf)])
        found = self._solve(h=h, g=g, a=a, lba=least, lbx=lowest, ubx=highest)
        if not self._solve.stats()["success"]:
            return np.clip(plan, -most, most), 0.0
        change = np.asarray(found["x"])[:, 0]
        plan = plan + change[: plan.size].reshape(plan.shape)
        return np.clip(plan, -most, most), min(max(change[plan.size], low), high)


def casadi_package() -> Any:
    """The package casadi.

    Raises
    ------
    ValueError
        if it is missing.
    """
    try:
        import casadi
    except ModuleNotFoundError as error:
        raise ValueError(f"nmpc needs casadi ({install_command('mpc')})") from error
    return casadi


@functools.cache
def _problem(
    preview_s: tuple[float, ...],
    tolerances: tuple[float, ...],
    last_weight: float,
    dead_s: float,
    limits: tuple[float, ...],
) -> tuple[Any, Any]:
    """The quadratic program of a step, as a function of what is observed and planned, and its solver.

    The unknowns are the changes of the plan, one preview after the other, a jump of the speed, and the
    excess of |u₂|, |u₁ u₂| and −u₁ over their limits, each in units of the limit.
    """
    ca = casadi_package()
    count = len(preview_s)
    start, nodes, plan = (ca.SX.sym(*one) for one in (("s", 6), ("n", 6, count), ("a", 2, count)))
    state, control, slip, span = (
        ca.SX.sym(n, k) for n, k in zip("xasT", (5, 2, 2, 1), strict=True)
    )
    after = _moved(ca, state, control, slip, span)
    move = ca.Function("move", [state, control, slip, span], [after])
    by_state, by_control = (
        ca.Function("slope", [state, control, slip, span], [ca.jacobian(after, one)])
        for one in (state, control)
    )
    goal = ca.SX.sym("goal", 6)
    deviation = _deviation(ca, state, slip, goal) / ca.DM(tolerances[:STATES])
    deviate = ca.Function(
        "deviate", [state, slip, goal], [deviation, ca.jacobian(deviation, state)]
    )
    twist = _used(ca, state, slip, limits)
    use = ca.Function("use", [state, slip], [twist, ca.jacobian(twist, state)])

    delta, reference = start[2:4], start[4:6]
    x = move(ca.vertcat(0, 0, 0, start[0:2]), ca.SX.zeros(2), delta, dead_s)
    unknowns = CONTROLS * count + 1
    effect = ca.SX.zeros(STATES, unknowns)  # of the unknowns on the state
    effect[3, unknowns - 1] = 1
    jump, effort_1, effort_2 = tolerances[STATES:]
    residuals, slopes, used, uses = [0], [ca.SX.zeros(1, unknowns)], [], []
    slopes[0][unknowns - 1] = 1 / jump
    intervals_s = np.diff((0.0, *preview_s))
    for k, h in enumerate(np.diff((dead_s, *preview_s))):
        given = (x, plan[:, k], delta, h)
        effect = ca.mtimes(by_state(*given), effect)
        effect[:, CONTROLS * k : CONTROLS * (k + 1)] += by_control(*given)
        x = move(*given)
        weight = np.sqrt(h * (last_weight if k == count - 1 else 1.0))
        residual, slope = deviate(x, delta, nodes[:, k])
        residuals.append(weight * residual)
        slopes.append(weight * ca.mtimes(slope, effect))
        value, slope = use(x, delta)
        used.append(value)
        uses.append(ca.mtimes(slope, effect))
        for i, tolerated in enumerate((effort_1, effort_2)):
            row = ca.SX.zeros(1, unknowns)
            row[CONTROLS * k + i] = np.sqrt(h) / tolerated
            needed = (nodes[4 + i, k] - reference[i]) / intervals_s[k]
            residuals.append(np.sqrt(h) / tolerated * (plan[i, k] - needed))
            slopes.append(row)
        reference = nodes[4:6, k]
    jacobian, residual = ca.vertcat(*slopes), ca.vertcat(*residuals)
    excess = ca.repmat(ca.DM.eye(SLACKS), count, 1)
    # Rows: −1 − s ≤ value ≤ 1 + s for |u₂| and |u₁ u₂|, and value ≥ −1 − s for u₁.
    value, slope = ca.vertcat(*used), ca.vertcat(*uses)
    two_sided = [i for i in range(SLACKS * count) if i % SLACKS < 2]
    rows = ca.vertcat(ca.horzcat(slope, excess), ca.horzcat(-slope, excess)[two_sided, :])
    low = ca.vertcat(-1 - value, (-1 + value)[two_sided])
    hessian = ca.diagcat(ca.mtimes(jacobian.T, jacobian), PRICE * ca.DM.eye(SLACKS))
    gradient = ca.vertcat(ca.mtimes(jacobian.T, residual), PRICE * ca.DM.ones(SLACKS))
    outputs = [ca.densify(one) for one in (hessian, gradient, rows, low)]
    build = ca.Function("build", [start, nodes, plan], outputs)
    shapes = {"h": outputs[0].sparsity(), "a": outputs[2].sparsity()}
    return build, ca.conic("solve", "daqp", shapes, {"error_on_fail": False})


def _moved(ca: Any, state: Any, control: Any, slip: Any, span: Any) -> Any:
    """The state after a time with constant accelerations; the distance by Simpson's rule."""
    u_1, u_2, a_1, a_2 = state[3], state[4], control[0], control[1]
    forward, right = 0, 0
    for share, weight in ((0.0, 1.0), (0.5, 4.0), (1.0, 1.0)):
        time = share * span
        turn = state[2] + (u_2 + slip[1]) * time + a_2 * time**2 / 2
        speed = u_1 + slip[0] + a_1 * time
        forward += weight / 6 * speed * ca.cos(turn)
        right -= weight / 6 * speed * ca.sin(turn)
    turned = (u_2 + slip[1]) * span + a_2 * span**2 / 2
    return state + ca.vertcat(forward * span, right * span, turned, a_1 * span, a_2 * span)


def _deviation(ca: Any, state: Any, slip: Any, goal: Any) -> Any:
    """Deviations of a state from a preview: positions, sine of the heading, speed, yaw rate."""
    return ca.vertcat(
        state[0] - goal[0],
        state[1] - goal[1],
        ca.sin(state[2]) * goal[3] - ca.cos(state[2]) * goal[2],
        state[3] + slip[0] - goal[4],
        state[4] + slip[1] - goal[5],
    )


def _used(ca: Any, state: Any, slip: Any, limits: tuple[float, ...]) -> Any:
    """The shares of their limits that u₂, u₁ u₂ and u₁ of the body have: −1 to 1, and from −1 on."""
    yaw_rate, lateral, reverse = limits
    u_1, u_2 = state[3] + slip[0], state[4] + slip[1]
    return ca.vertcat(u_2 / yaw_rate, u_1 * u_2 / lateral, u_1 / reverse)
