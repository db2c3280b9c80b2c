"""A sliding-mode law: the errors are brought onto a surface on which they decay by themselves."""

from __future__ import annotations

import numpy as np

from baselines.policies.laws.law import UNBOUNDED, ErrorBounds, LawFile, Memoryless, angles
from tlf_env.common.models import Positive
from tlf_env.onboard.rays import Rays
from tlf_env.onboard.supervisor import Neighbour
from tlf_env.task.scenario import DEFAULT_PREVIEW_S


class SlidingModeFile(LawFile):
    """Parameters of :class:`SlidingMode` in a file; None: its default."""

    heading_weight: Positive | None = None
    lateral_scale_mm: Positive | None = None
    forward_reach_mm_s: Positive | None = None
    forward_layer_mm: Positive | None = None
    turn_reach_rad_s: Positive | None = None
    turn_layer_rad: Positive | None = None


class SlidingMode(Memoryless):
    """Sliding mode on the surfaces of Mu, Yan, Spurgeon and Mao, with a boundary layer.

    "Nonlinear sliding mode control of a two-wheeled mobile robot system", International Journal of
    Modelling, Identification and Control 27, 2017, pages 75 to 83. With the forward error x = e₁, the
    lateral error y = −e₂ (to the left) and the heading error e₃, the surfaces are

        σ₁ = c e₃ + atan(y/ℓ),  σ₂ = x

    On σ₁ = 0 the heading turns the robot towards the path: y' = u₁* sin e₃ decays over the distance c ℓ. The
    law makes σ̇₁ = −η₁ sat(σ₁/φ₁) and σ̇₂ = −η₂ sat(σ₂/φ₂), where sat limits to ±1:

        u₂ = (c u₂* + a u₁* sin e₃ + η₁ sat(σ₁/φ₁)) / (c + a x),  a = ∂ atan(y/ℓ)/∂y
        u₁ = u₁* cos e₃ + u₂ y + η₂ sat(σ₂/φ₂)

    The paper has the sign in place of sat, which chatters at a finite control rate, and ℓ = 1 m. It shows
    that the surfaces are reached where c + a x is positive; a robot further ahead of its reference takes
    the smallest allowed divisor, c/2. The reference moves forward.

    Parameters
    ----------
    heading_weight
        c.
    lateral_scale_mm
        ℓ.
    forward_reach_mm_s, turn_reach_rad_s
        η₂ and η₁: the largest correction of the speed, and of σ₁.
    forward_layer_mm, turn_layer_rad
        φ₂ and φ₁: half the width of the boundary layer of each surface.
    """

    def __init__(
        self,
        preview_s: tuple[float, ...] = DEFAULT_PREVIEW_S,
        heading_weight: float = 1.0,
        lateral_scale_mm: float = 230.0,
        forward_reach_mm_s: float = 100.0,
        forward_layer_mm: float = 77.0,
        turn_reach_rad_s: float = 1.0,
        turn_layer_rad: float = 0.2,
        rays: Rays | None = None,
        neighbour: Neighbour | None = None,
        bounds: ErrorBounds = UNBOUNDED,
    ) -> None:
        super().__init__(preview_s, rays, neighbour, bounds)
        self.heading_weight, self.lateral_scale_mm = heading_weight, lateral_scale_mm
        self.forward_reach_mm_s, self.forward_layer_mm = forward_reach_mm_s, forward_layer_mm
        self.turn_reach_rad_s, self.turn_layer_rad = turn_reach_rad_s, turn_layer_rad

    def twist(self, seen: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The twist with which both surfaces are approached at their rates."""
        c, scale = self.heading_weight, self.lateral_scale_mm
        x, y, u_1 = seen["e_1"], -seen["e_2"], seen["reference_u_1"]
        e_3 = angles(seen["sin_e_3"], seen["cos_e_3"])
        share = y / scale
        surface = c * e_3 + angles(share, np.ones_like(share))
        slope = 1.0 / (scale * (1.0 + share * share))
        turning = self.turn_reach_rad_s * np.clip(surface / self.turn_layer_rad, -1.0, 1.0)
        turn = c * seen["reference_u_2"] + slope * u_1 * seen["sin_e_3"] + turning
        turn /= np.maximum(c + slope * x, 0.5 * c)
        catching_up = np.clip(x / self.forward_layer_mm, -1.0, 1.0)
        forward = u_1 * seen["cos_e_3"] + turn * y + self.forward_reach_mm_s * catching_up
        return forward, turn
