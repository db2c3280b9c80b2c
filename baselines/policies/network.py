"""The network of a learned policy: its layers, and the names and shapes of its tensors."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from baselines.policies.history import History
from tlf_env.common.models import Frozen, Switch, Whole
from tlf_env.task.actions import ACTION_SIZE

NORMALISATION = "normalise."
LSTM_GATES = 4  # input, forget, cell, output, in this order

# squashed: tanh of the draw, as SAC does; tanh: of the mean, and nothing is drawn, as in TD3
Head = Literal["gaussian", "squashed_gaussian", "tanh"]

Size = Annotated[Whole, Field(ge=1)]


class Network(Frozen):
    """A history, normalisation, an LSTM, hidden layers and a linear head, in this order.

    Names and shapes of the tensors: :meth:`shapes`. A weight is (out, in), as in torch.
    """

    hidden: tuple[Size, ...]  # sizes of the hidden layers
    activation: Literal["tanh", "relu"]  # after each of them
    history: History | None = None  # None: it sees the present observation only
    lstm: Size | None = None  # size of its state; None without an LSTM
    head: Head
    normalised: Switch = False  # whether observations are normalised as VecNormalize does

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.history is not None and self.lstm is not None:
            raise ValueError("history and lstm exclude each other; both are there")
        return self

    def shapes(self, entries: int) -> dict[str, tuple[int, ...]]:
        """Shapes of all tensors by name, for an observation of so many entries.

        ``normalise.*`` are float64, as in VecNormalize; all others are float32.
        """
        if self.history is not None:
            entries += self.history.size(entries)
        shapes: dict[str, tuple[int, ...]] = {}
        if self.normalised:
            shapes |= {f"{NORMALISATION}{name}": (entries,) for name in ("mean", "var")}
            shapes |= {f"{NORMALISATION}{name}": () for name in ("epsilon", "clip")}
        size = entries
        if self.lstm is not None:
            gates = LSTM_GATES * self.lstm
            shapes |= {"lstm.weight_ih": (gates, size), "lstm.weight_hh": (gates, self.lstm)}
            shapes |= {"lstm.bias_ih": (gates,), "lstm.bias_hh": (gates,)}
            size = self.lstm
        for i, width in enumerate(self.hidden):
            shapes |= {f"hidden.{i}.weight": (width, size), f"hidden.{i}.bias": (width,)}
            size = width
        shapes |= {"mean.weight": (ACTION_SIZE, size), "mean.bias": (ACTION_SIZE,)}
        if self.head == "tanh":
            return shapes
        if self.head == "gaussian":
            return shapes | {"log_std": (ACTION_SIZE,)}
        return shapes | {"log_std.weight": (ACTION_SIZE, size), "log_std.bias": (ACTION_SIZE,)}
