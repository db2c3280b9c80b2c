"""Moving-horizon estimator: the last states together, by one Gauss–Newton step in each interval.

The states at the *nodes* of a window, one node in each control period, minimise the sum of squares of what the
motion, the encoders and the fixes leave unexplained, each in its standard deviations, and of the arrival cost
(C. Rao, J. Rawlings, D. Mayne, "Constrained state estimation for nonlinear discrete-time systems: stability and
moving horizon approximations", IEEE Transactions on Automatic Control 48, 2003, pages 246 to 258). The window
is solved again one node later, so one step suffices each time: real-time iterations (P. Kühl, M. Diehl, T.
Kraus, J. Schlöder, H. G. Bock, "A real-time algorithm for moving horizon state and parameter estimation",
Computers & Chemical Engineering 35, 2011, pages 71 to 83).

- A late fix counts at the node of the time at which it was taken.
- Fixes have the loss of P. Huber ("Robust estimation of a location parameter", Annals of Mathematical
  Statistics 35, 1964): quadratic up to some standard deviations, linear beyond, so that outliers count
  little. It is made by weights, which every step sets anew.
- The slip is bounded: where a step would go beyond, it is held at the bound and the step is made again.
- The node that leaves the window is eliminated; what remains of it is the arrival cost. In the linear case
  without bounds the newest state is that of the Kalman filter.

The normal equations are banded, since only neighbours are linked.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from baselines.policies.estimators.reckoning import (
    SLIP,
    STATES,
    THETA,
    Fix,
    Interval,
    Noise,
    Reckoning,
    X,
    Y,
    in_world,
    moved,
    rolling_slope,
    rolling_speed,
    slopes,
)
from tlf_env.physics.vehicle import RobotParameters

INTERVAL_S = 0.02  # between two nodes
WINDOW_S = 0.6
HUBER = 2.5  # standard deviations of a fix up to which the loss is quadratic
SLIP_BOUND_MM_S = 150.0
AT_BOUND = 1.0e6  # information of a bound that holds, 1/(mm/s)²


class Links(NamedTuple):
    """Cost of the changes dz, dz₊ of neighbours: ½ ‖miss + dz₊ − slope dz‖² in the metric ``information``."""

    slope: np.ndarray  # (node, n, n)
    information: np.ndarray  # (node, n, n): inverse covariance of the process noise
    miss: np.ndarray  # (node, n)


def banded(information: np.ndarray, links: Links) -> np.ndarray:
    """Lower bands ``(2n, node · n)`` of the normal equations, as of :func:`scipy.linalg.cholesky_banded`.

    ``information`` ``(node, n, n)`` is that of each node without its links.
    """
    nodes, n, _ = information.shape
    diagonal, below = information.copy(), np.zeros((nodes, n, n))
    pulled = links.information @ links.slope
    diagonal[1:] += links.information
    diagonal[:-1] += links.slope.swapaxes(1, 2) @ pulled
    below[:-1] = -pulled
    columns = np.concatenate([diagonal, below], axis=1)  # of a node: its rows and those of the next
    bands = np.zeros((2 * n, nodes, n))
    for j in range(n):
        bands[: 2 * n - j, :, j] = columns[:, j:, j].T
    return bands.reshape(2 * n, nodes * n)


def solved(
    information: np.ndarray, gradient: np.ndarray, links: Links
) -> tuple[np.ndarray, np.ndarray]:
    """The changes of all nodes that minimise the cost, and the covariance of the newest.

    Parameters
    ----------
    information, gradient
        Hessian ``(node, n, n)`` and gradient ``(node, n)`` of the cost of each node by itself.
    links
        Of neighbours, one fewer.

    Returns
    -------
    tuple
        Changes ``(node, n)`` and covariance ``(n, n)``.

    Raises
    ------
    numpy.linalg.LinAlgError
        if the information determines no minimum.
    """
    nodes, n = gradient.shape
    right = -gradient.copy()
    pull = (links.information @ links.miss[:, :, None])[:, :, 0]
    right[1:] -= pull
    right[:-1] += (links.slope.swapaxes(1, 2) @ pull[:, :, None])[:, :, 0]
    factor = cholesky_banded(banded(information, links), lower=True, check_finite=False)
    changes = cho_solve_banded((factor, True), right.ravel(), check_finite=False)
    last = np.zeros((n, n))  # triangular, of the newest node
    for j in range(n):
        last[j:, j] = factor[: n - j, (nodes - 1) * n + j]
    inverse = np.linalg.inv(last)
    return changes.reshape(nodes, n), inverse.T @ inverse


def eliminated(
    information: np.ndarray, gradient: np.ndarray, link: Links
) -> tuple[np.ndarray, np.ndarray]:
    """Information ``(n, n)`` and gradient ``(n,)`` that the oldest node and its link leave to the next.

    ``link`` has no axis of nodes here. What is left is a Schur complement.
    """
    pulled = link.information @ link.slope
    inner = information + link.slope.T @ pulled
    pull = link.information @ link.miss
    share = np.linalg.solve(inner, np.column_stack([pulled.T, gradient - link.slope.T @ pull]))
    return link.information - pulled @ share[:, :-1], pull + pulled @ share[:, -1]


class MovingHorizonEstimator(Reckoning):
    """The model of :mod:`~baselines.policies.estimators.reckoning` over a moving window.

    Parameters
    ----------
    robot, period_s, interval_s, noise
        As of :class:`Reckoning`; an interval ends at a node.
    window_s
        Time from the oldest to the newest node.
    huber
        Standard deviations of a fix up to which its loss is quadratic.
    slip_bound_mm_s
        Bound of the slip's size.

    Raises
    ------
    ValueError
        as :class:`Reckoning`; for a window shorter than an interval, and a loss or bound that is not positive.
    """

    def __init__(
        self,
        robot: RobotParameters,
        period_s: float,
        interval_s: float = INTERVAL_S,
        noise: Noise | None = None,
        window_s: float = WINDOW_S,
        huber: float = HUBER,
        slip_bound_mm_s: float = SLIP_BOUND_MM_S,
    ) -> None:
        super().__init__(robot, period_s, interval_s, noise or Noise())
        if not interval_s <= window_s < np.inf:
            raise ValueError(f"window_s {window_s} must be finite and at least {interval_s}")
        for name, value in (("huber", huber), ("slip_bound_mm_s", slip_bound_mm_s)):
            if not value > 0.0:
                raise ValueError(f"{name} {value} must be positive")
        self._links = max(round(window_s / (self._every * period_s)), 1)
        self._huber, self._slip_bound = huber, slip_bound_mm_s

    def reset(self, pose: np.ndarray) -> None:
        """Start at the true pose ``(x mm, y mm, θ rad)``, at rest."""
        super().reset(pose)
        self._pasts: list[Interval] = []  # between the nodes
        self._ways_at = [self._way]  # the way at the nodes
        self._states = self.state[None].copy()
        # Fixes of each node, moved on along the way to it; 1 where there is one: at most one of each period.
        nodes = self._links + 1
        self._measured = np.zeros((nodes, self._every, 2))
        self._here = np.zeros((nodes, self._every))
        # Arrival cost: mean and information of the oldest node
        self._arrival = self.state, np.linalg.inv(self.covariance)
        self._new: list[Fix] = []

    def _take(self, fix: Fix) -> None:
        self._new.append(fix)

    def _correct(self, t_s: float, past: Interval) -> None:
        """Append a node, make one Gauss–Newton step, and eliminate the oldest node of a full window."""
        if len(self._pasts) == self._links:
            self._drop()
        self._pasts.append(past)
        self._ways_at.append(self._way)
        predicted = moved(self._states[-1], past, self.noise)
        self._states = np.concatenate([self._states, predicted[None]])
        for fix in self._new:
            self._place(fix, t_s)
        self._new = []
        change, self.covariance = self._step(*self._terms(len(self._states)))
        self._states = self._states + change
        self.state = self._states[-1].copy()

    def _place(self, fix: Fix, t_s: float) -> None:
        """Put a fix at the first node at or after its time; one from before the window is left out."""
        # The small share is for rounding: a fix taken at a node belongs to it.
        back = int((t_s - fix.t_s) / (self._every * self._dt_s) + 1e-6)
        node = len(self._states) - 1 - back
        if node < 0 or self._here[node].all():
            return
        place = int(self._here[node].sum())
        way_x, way_y = self._ways_at[node]
        self._measured[node, place] = fix.x - fix.way_x + way_x, fix.y - fix.way_y + way_y
        self._here[node, place] = 1.0

    def _terms(self, nodes: int) -> tuple[np.ndarray, np.ndarray, Links]:
        """Information and gradient of the oldest nodes by themselves, and their links, at their states now."""
        z, noise = self._states[:nodes], self.noise
        pasts = Interval(*np.array(self._pasts[: nodes - 1]).T)
        information = np.zeros((nodes, STATES, STATES))
        gradient = np.zeros((nodes, STATES))
        mean, information[0] = self._arrival
        gradient[0] = information[0] @ (z[0] - mean)
        rolling, slope = self._rolling_terms(z[1:], pasts)
        information[1:] += rolling
        gradient[1:] += slope
        # Fixes
        missed = z[:, None, :2] - self._measured[:nodes]
        sizes = np.hypot(missed[..., 0], missed[..., 1]) / np.sqrt(self.fix_variance)
        weights = self._here[:nodes] / np.maximum(sizes / self._huber, 1.0) / self.fix_variance
        total = weights.sum(axis=1)
        information[:, X, X] += total
        information[:, Y, Y] += total
        gradient[:, :2] += (weights[..., None] * missed).sum(axis=1)
        before = z[:-1]
        links = Links(
            slope=slopes(before, pasts, noise),
            information=in_world(1.0 / self._variances, before[:, THETA] + 0.5 * pasts.turned),
            miss=z[1:] - moved(before, pasts, noise),
        )
        return information, gradient, links

    def _rolling_terms(self, z: np.ndarray, pasts: Interval) -> tuple[np.ndarray, np.ndarray]:
        """Information ``(8, 8)`` of what was rolled before each node, and its gradients ``(node, 8)``."""
        off = rolling_speed(z, pasts) - pasts.rolled / pasts.time_s
        row = rolling_slope(self._pasts[0])
        weight = (self._pasts[0].time_s / self.noise.rolled_mm) ** 2
        return weight * np.outer(row, row), weight * off[:, None] * row

    def _step(
        self, information: np.ndarray, gradient: np.ndarray, links: Links
    ) -> tuple[np.ndarray, np.ndarray]:
        """Changes of all states with the slips within their bound, and the covariance of the newest."""
        change, covariance = solved(information, gradient, links)
        wanted = self._states[:, SLIP] + change[:, SLIP]
        beyond = np.abs(wanted) > self._slip_bound
        if not beyond.any():
            return change, covariance
        held, at = information.copy(), gradient.copy()
        bounds = np.clip(wanted, -self._slip_bound, self._slip_bound)
        held[beyond, SLIP, SLIP] += AT_BOUND
        at[beyond, SLIP] += AT_BOUND * (self._states[:, SLIP] - bounds)[beyond]
        change, covariance = solved(held, at, links)
        slips = np.clip(
            self._states[:, SLIP] + change[:, SLIP], -self._slip_bound, self._slip_bound
        )
        change[:, SLIP] = slips - self._states[:, SLIP]
        return change, covariance

    def _drop(self) -> None:
        """Eliminate the oldest node, with its link and what was rolled after it."""
        information, gradient, links = self._terms(2)
        link = Links(*(part[0] for part in links))
        left, slope = eliminated(information[0], gradient[0], link)
        past = Interval(*np.array([self._pasts[0]]).T)
        rolling, rolling_slopes = self._rolling_terms(self._states[1:2], past)
        left = 0.5 * (left + left.T) + rolling
        slope = slope + rolling_slopes[0]
        del self._pasts[0], self._ways_at[0]
        self._states = self._states[1:]
        self._measured[:-1], self._here[:-1] = self._measured[1:].copy(), self._here[1:].copy()
        self._here[-1] = 0.0
        self._arrival = self._states[0] - np.linalg.solve(left, slope), left
