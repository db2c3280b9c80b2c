"""Examples of each command, for its ``--help``."""

from __future__ import annotations

EXAMPLES: dict[str, dict[str, str]] = {
    "demo": {
        "tlf demo": "seed 0, into results/demo",
        "tlf demo --seed 3 --out results/seed-3": "other draws of noise and slip",
    },
    "list": {
        "tlf list": "everything that has a name",
        "tlf list disturbances": "the presets, with a line on each",
        "tlf list tasks --json": "names for a program",
    },
    "show": {
        "tlf show infinity > own.yaml": "a file to start from",
        "tlf show infinity --disturbance ice --changes": "only what is not a default",
        "tlf show flower --set time_gap_s=3 | tlf run -": "change a field and run",
    },
    "run": {
        "tlf run infinity": "the default controller, without disturbance",
        "tlf run flower --disturbance slip --policy residual": "a learned policy on slip",
        "tlf run infinity --set time_gap_s=3 --seed 7": "any field of the scenario",
        "tlf run own.yaml --policy my_module:make --trust": "a task and a policy of your own",
        "tlf run infinity --disturbance slip --video slip.mp4": "a video, too",
    },
    "view": {
        "tlf view infinity --disturbance slip": "the default controller on slip; h lists the keys",
        "tlf view warehouse --policy residual --theme dark": "the learned policy, light on dark",
    },
    "play": {
        "tlf play warehouse": "drive the leader, then: tlf run drive.csv",
        "tlf play infinity --disturbance ice --robots 5 --out mine.csv": "five robots on ice",
    },
    "compare": {
        "tlf compare results/infinity-consistent-slip-0 results/infinity-residual-slip-0": "two runs of "
        "one task and seed",
    },
    "path": {
        "tlf path log.csv --units m --smooth 5": "a noisy log in metres",
        "tlf path log.csv --columns time,px,py --speed-limit 400": "columns by name, at most 400 mm/s",
    },
    "openloop": {"tlf openloop scenarios.json --out results/openloop": "one CSV for each scenario"},
    "speed": {
        "tlf speed": "ours alone and many at once, and the peers that are installed",
        "tlf speed --formations 1024 --steps 200": "one size, shorter",
        "tlf speed --memory --cold --training": "memory, starts, and the time to a trained policy, too",
    },
    "bench": {
        "tlf bench --policies reference,residual --tasks infinity --disturbances slip,ice --seeds 0:10": "a "
        "small comparison",
        "tlf bench --policies my.zip --trust --tasks infinity,flower": "a policy of SB3, 50 seeds",
        "tlf bench --check infinity:slip": "a cell of the published board again, digit for digit",
        "tlf bench --plan board --out results/board": "the whole board, about two hours of a core",
    },
    "eval": {
        "tlf eval residual": "a shipped policy against the default, a minute or two",
        "tlf eval my.safetensors --disturbances all --seeds 20000:20050": "your own, under everything",
        "tlf eval my.zip --trust --against residual": "a policy of SB3 against another one",
    },
    "export": {
        "tlf export infinity --policy reference --seeds 0:20 --out data": "20 runs as an offline data set",
        "tlf export infinity --policy from-nothing --noise 0.3 --out data": "with noise on the actions",
    },
    "train": {
        "tlf train quick": "a few minutes, into results/train/quick",
        "tlf train residual --seeds 1": "a shipped policy again, from another seed",
        "tlf train own.yaml --robot-steps 200000": "a training of your own, shorter",
        "tlf train scratch --search --processes 1": "better numbers of PPO, within the file's ranges",
    },
    "tune": {"tlf tune adrc --trials 50": "a search of the gains; call it again to continue"},
    "paper": {
        "tlf paper": "every figure and claim of the paper, into results/paper; about three quarters of an hour",
        "tlf paper --figures fig7ab,fig7c": "the wheel loop only, half a minute",
    },
    "compile": {
        "tlf compile": "what most runs need",
        "tlf compile --all": "also for tlf speed and double precision",
    },
}


def examples(command: str) -> str:
    """The end of a command's help: its examples in lines of their own."""
    lines = [f"  {line}\n      {what}" for line, what in EXAMPLES[command].items()]
    return "\b\nExamples:\n" + "\n".join(lines)
