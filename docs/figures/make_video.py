"""The film at the top of README: the same slip, with the paper's loop and with the learned policy.

``python docs/figures/make_video.py`` writes ``docs/images/slip.gif`` in half a minute, with the extra ``view``.
"""

from __future__ import annotations

from pathlib import Path

from baselines.policies.registry import fit_policy
from baselines.runs.run import run_policy
from baselines.runs.video import Film, write_video
from tlf_env.task.scenario import load_scenario

PICTURE = Path(__file__).resolve().parents[1] / "images" / "slip.gif"
POLICIES = {"reference:consistent": "the paper's loop", "residual": "learned policy"}
TASK, DISTURBANCE, SEED = "infinity", "slip", 0
HORIZON_S, SPEED, FPS = 51.0, 3.0, 12.5


def main() -> None:
    """Run both policies and write the picture."""
    films = []
    for name in POLICIES:
        chosen = load_scenario(TASK, disturbance=DISTURBANCE, horizon_s=HORIZON_S)
        fitted = fit_policy(name, chosen)
        films.append(Film(FPS, SPEED))
        run_policy(fitted.scenario, fitted.policy, SEED, name=name, watch=films[-1])
    path = write_video(films, PICTURE, captions=tuple(POLICIES.values()))
    print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
