"""Learned policies without their learning library: MLPs, with a history or an LSTM, in compiled NumPy.

The result for a row of a batch has the same bits in every batch, so a formation drives the same run alone
and in a batch. A matrix product of BLAS does not guarantee that: its order of summation depends on the
number of rows. Here every sum has one order, in float64, and is rounded to float32 once per layer. The
actions differ by less than 1e-6 from those of SB3, which computes in float32.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from baselines.policies.card import WEIGHTS, Loaded, read_policy
from baselines.policies.columns import Columns
from baselines.policies.history import Past
from tlf_env.numerics.compiled import block, driver, law
from tlf_env.onboard.limiters import Limiter
from tlf_env.task.actions import ACTION_ENTRIES, ACTION_SIZE, LIMITED_KINDS, RANGED_KINDS
from tlf_env.task.scenario import Scenario

SHIPPED = Path(__file__).resolve().parent / "weights"
LINEAR, TANH, RELU = range(3)
ACTIVATIONS = {"tanh": TANH, "relu": RELU}
LOG_STD_LIMITS = (-20.0, 2.0)  # SAC's

LstmState = tuple[np.ndarray, np.ndarray]  # h and c, each (1, row, unit), as in sb3-contrib


def shipped_policies() -> list[str]:
    """Names of the policies that are shipped with the package."""
    return sorted(path.stem for path in SHIPPED.glob(f"*{WEIGHTS}"))


def load_policy(path_or_name: str | Path, *, seed: int = 0) -> LearnedPolicy:
    """A learned policy from ``NAME.safetensors`` and its card ``NAME.json``; runs without torch.

    Its observation is the one with the card's previews, as ``scenario_overrides`` sets it. For another
    observation, call :meth:`LearnedPolicy.bind` with the scenario.

    Parameters
    ----------
    path_or_name
        A path that ends in ``.safetensors``, or the name of a shipped policy.
    seed
        Seed of the draws with ``deterministic=False``.

    Raises
    ------
    ValueError
        in one line, for an unknown name, and as :func:`baselines.policies.card.read_policy` does.
    """
    text = str(path_or_name)
    if text.lower().endswith(WEIGHTS):
        return LearnedPolicy(read_policy(Path(text)), seed=seed)
    if text in shipped_policies():
        return LearnedPolicy(read_policy(SHIPPED / f"{text}{WEIGHTS}"), seed=seed)
    names = ", ".join(shipped_policies()) or "there is none yet"
    raise ValueError(f"policy {text!r} is neither a {WEIGHTS} file nor shipped ({names})")


class LearnedPolicy:
    """A network with the signature of SB3's ``predict``; made by :func:`load_policy`.

    Attributes
    ----------
    card : baselines.policies.card.Card
        Its description.
    files : tuple of Path
        Its weights and its card.
    scenario_overrides : dict
        Scenario fields that it needs, for ``load_scenario`` and ``parallel_env``. A custom part
        (``module:factory``) is left out, because a card must not choose code that is run.
    """

    privileged = False

    def __init__(self, loaded: Loaded, *, seed: int = 0) -> None:
        self.card, tensors, self.files = loaded
        self._columns: Columns | None = None  # of the observation; found at the first use
        network = self.card.network
        self._past = None if network.history is None else Past(network.history, self.card.entries)
        self._squashed = network.head != "gaussian"
        self._without_draws = network.head == "tanh"
        self._activation = ACTIVATIONS[network.activation]
        self._normalisation = (
            tuple(tensors[f"normalise.{name}"] for name in ("mean", "var", "epsilon", "clip"))
            if network.normalised
            else None
        )
        self._lstm = (
            (
                _transposed(tensors["lstm.weight_ih"]),
                _transposed(tensors["lstm.weight_hh"]),
                tensors["lstm.bias_ih"].astype(np.float64) + tensors["lstm.bias_hh"],
            )
            if network.lstm
            else None
        )
        self._hidden = [_dense_pair(tensors, f"hidden.{i}") for i in range(len(network.hidden))]
        self._mean = _dense_pair(tensors, "mean")
        if network.head == "squashed_gaussian":
            self._log_std_layer = _dense_pair(tensors, "log_std")
        elif network.head == "gaussian":
            self._log_std = tensors["log_std"]
        self._generator = np.random.default_rng(seed)
        card = self.card
        asked: dict[str, Any] = {"action": card.action, "observation": card.observation}
        asked |= {"residual_base": card.residual_base, "estimator": card.estimator}
        if card.estimator is not None:
            asked["broadcast_smoothing_s"] = card.broadcast_smoothing_s
        if card.residual_fade_mm:
            asked["residual_fade_mm"] = card.residual_fade_mm
        asked["residual_reach_mm"] = card.residual_reach_mm
        if card.action == "tracking_twist":
            asked["tracking_fade_mm"] = card.tracking_fade_mm
        if card.observation == "tracking":
            asked["preview_s"] = card.preview_s
        if card.action in RANGED_KINDS and card.action_scales != tuple(
            entry.scale for entry in ACTION_ENTRIES[card.action]
        ):
            asked["action_range"] = card.action_scales
        if card.action in LIMITED_KINDS and (card.limiter or card.action == "tracking_twist"):
            asked["limiter"] = (card.limiter or Limiter()).model_dump()
        asked["rays"] = None if card.rays is None else card.rays.model_dump()
        asked["neighbour"] = None if card.neighbour is None else card.neighbour.model_dump()
        self.scenario_overrides = {
            field: value
            for field, value in asked.items()
            if value is not None and not (isinstance(value, str) and ":" in value)
        }

    def overrides_for(self, scenario: Scenario) -> dict[str, Any]:
        """The scenario fields that it needs, without its previews if the scenario has them already."""
        needed = dict(self.scenario_overrides)
        if set(self.card.preview_s) <= set(scenario.preview_s):
            needed.pop("preview_s", None)
        return needed

    def bind(self, name: str, scenario: Scenario) -> None:
        """Take the columns of a scenario's observation from now on.

        Raises
        ------
        ValueError
            as :meth:`baselines.policies.card.Card.fit` does.
        """
        self._columns = self.card.fit(name, scenario)

    def predict(
        self,
        observation: np.ndarray,
        state: Any = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, Any]:
        """Action for one observation ``(entry,)`` or a batch ``(row, entry)``.

        Parameters
        ----------
        state
            With an LSTM or a history: the state that the last call returned, None at the start. Otherwise
            passed through.
        episode_start
            With a state: True for the rows ``(row,)`` whose state is reset first. None: no row.
        deterministic
            False draws from the policy's Gaussian, if it has one. The draws come from one generator, seeded
            when the policy was loaded, so the same calls after a new load give the same draws.

        Returns
        -------
        tuple
            Actions ``(2,)`` or ``(row, 2)``, float32 in [−1, 1], and the next state: with an LSTM h
            and c, each ``(1, row, unit)`` float32; with a history an array of it, ``(row, number)``.

        Raises
        ------
        ValueError
            if the observation or the state has another shape.
        """
        if self._columns is None:
            self._columns = self.card.own_columns()
        observation = np.asarray(observation)
        if observation.ndim not in (1, 2) or observation.shape[-1] != self._columns.width:
            raise ValueError(
                f"the observation has the shape {observation.shape}; this policy takes "
                f"{self.card.observation} observations of {self._columns.width} entries"
            )
        seen = self._columns.take(np.atleast_2d(observation))
        next_state: Any = state
        if self._past is not None:
            memory = self._past.memory(state, len(seen), episode_start)
            next_state = self._past.after(memory, seen)
            seen = self._past.joined(seen, memory)
        rows = self._normalised(seen)
        if self._lstm is not None:
            next_state = self._remembered(rows, state, episode_start)
            rows = next_state[0][0]
        for layer in self._hidden:
            rows = _through(rows, *layer, self._activation)
        chosen = deterministic or self._without_draws
        action = self._chosen(rows) if chosen else self._drawn(rows)
        return (action[0] if observation.ndim == 1 else action), next_state

    def _normalised(self, rows: np.ndarray) -> np.ndarray:
        """Normalised as by VecNormalize, in float64, then float32."""
        if self._normalisation is not None:
            mean, var, epsilon, clip = self._normalisation
            rows = np.clip((rows - mean) / np.sqrt(var + epsilon), -clip, clip)
        return np.array(rows, dtype=np.float32, order="C")

    def _remembered(
        self, rows: np.ndarray, state: LstmState | None, episode_start: np.ndarray | None
    ) -> LstmState:
        """The LSTM's next state; the given state is not changed."""
        assert self._lstm is not None
        shape = (1, len(rows), len(self._lstm[1]))
        if state is None:
            state = np.zeros(shape), np.zeros(shape)
        if any(np.shape(part) != shape for part in state) or len(state) != 2:
            raise ValueError(
                f"the state must be h and c of the shape {shape}, got {[np.shape(p) for p in state]}"
            )
        h, c = (np.array(part[0], dtype=np.float32, order="C") for part in state)
        if episode_start is not None:
            restarted = np.broadcast_to(np.asarray(episode_start, dtype=np.bool_), len(rows))
            h[restarted] = c[restarted] = 0.0
        next_h, next_c = np.empty((2, *shape), dtype=np.float32)
        _lstm(rows, h, c, *self._lstm, next_h[0], next_c[0])
        return next_h, next_c

    def _chosen(self, rows: np.ndarray) -> np.ndarray:
        if self._squashed:
            return _through(rows, *self._mean, TANH)
        return np.clip(_through(rows, *self._mean, LINEAR), -1.0, 1.0)

    def _drawn(self, rows: np.ndarray) -> np.ndarray:
        mean = _through(rows, *self._mean, LINEAR)
        noise = self._generator.standard_normal((len(rows), ACTION_SIZE), dtype=np.float32)
        if not self._squashed:
            return np.clip(mean + np.exp(self._log_std) * noise, -1.0, 1.0)
        log_std = np.clip(_through(rows, *self._log_std_layer, LINEAR), *LOG_STD_LIMITS)
        return np.tanh(mean + np.exp(log_std) * noise)


def _transposed(weight: np.ndarray) -> np.ndarray:
    """(in, out) from (out, in), so that the inner loop runs over independent sums."""
    return np.array(weight.T, order="C")


def _dense_pair(tensors: dict[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    return _transposed(tensors[f"{name}.weight"]), tensors[f"{name}.bias"].astype(np.float64)


def _through(rows: np.ndarray, weight: np.ndarray, bias: np.ndarray, activation: int) -> np.ndarray:
    """A layer's output ``(row, out)``, float32."""
    out = np.empty((len(rows), weight.shape[1]), dtype=np.float32)
    _dense(rows, weight, bias, activation, out)
    return out


@law
def _sigmoid(x: float) -> float:
    return 1.0 / (1.0 + math.exp(-x))


@block
def _add_product(row: np.ndarray, weight: np.ndarray, sums: np.ndarray) -> None:
    """Add ``row @ weight`` to float64 sums, entry by entry."""
    for i in range(weight.shape[0]):
        value = np.float64(row[i])
        for j in range(weight.shape[1]):
            sums[j] += value * weight[i, j]


@driver
def _dense(
    rows: np.ndarray, weight: np.ndarray, bias: np.ndarray, activation: int, out: np.ndarray
) -> None:
    sums = np.empty(weight.shape[1])
    for r in range(rows.shape[0]):
        sums[:] = bias
        _add_product(rows[r], weight, sums)
        for j in range(weight.shape[1]):
            value = sums[j]
            if activation == TANH:
                value = math.tanh(value)  # that of float32 takes ten times as long
            elif activation == RELU:
                value = max(value, 0.0)
            out[r, j] = value


@driver
def _lstm(
    rows: np.ndarray,
    h: np.ndarray,
    c: np.ndarray,
    weight_ih: np.ndarray,
    weight_hh: np.ndarray,
    bias: np.ndarray,
    next_h: np.ndarray,
    next_c: np.ndarray,
) -> None:
    units = weight_hh.shape[0]
    sums = np.empty(weight_hh.shape[1])
    for r in range(rows.shape[0]):
        sums[:] = bias
        _add_product(rows[r], weight_ih, sums)
        _add_product(h[r], weight_hh, sums)
        for j in range(units):
            entering, kept = _sigmoid(sums[j]), _sigmoid(sums[units + j])
            cell = kept * c[r, j] + entering * math.tanh(sums[2 * units + j])
            next_c[r, j] = cell
            next_h[r, j] = _sigmoid(sums[3 * units + j]) * math.tanh(cell)
