#!/bin/sh
# The first hour of a newcomer, with an installed package, outside the checkout: make check-install.
# Every command must succeed, and write what it promises. Training is tried if torch is installed.
set -eu

say() { printf '\n== %s\n' "$1"; }

say "what there is"
tlf --version
tlf list tasks | grep -q infinity_from_rest
tlf run infinity_from_rst 2>&1 | grep -q "did you mean 'infinity_from_rest'"

say "the demo"
tlf demo --out demo
test -s demo/demo.png
test -s demo/residual-slip/summary.json
grep -q "the paper's loop" demo/replay.html

say "Gymnasium and PettingZoo, from presets and weights in the package"
python - <<'END'
import gymnasium
import pettingzoo
import tlf_env
from baselines import ReferencePolicy, load_policy

env = gymnasium.make("tlf_env/Infinity-v0")
env.reset(seed=0)
print(env.step(env.action_space.sample())[1])
print(env.unwrapped.scenario)
print(tlf_env.parallel_env("warehouse").possible_agents, ReferencePolicy(), load_policy("residual"))
END

say "a task of one's own"
tlf show circle > own.yaml
tlf run own.yaml --set time_gap_s=4 --horizon-s 10
tlf show circle --set robots=2 | tlf run - --horizon-s 10 --no-figures
printf 'base: infinity\nhorizon_s: 8\ntrajectory: flower\n' > based.yaml
tlf run based.yaml --disturbance slip-noise --policy residual --no-figures
test -s results/index.html
tlf run infinity --disturbance slip --horizon-s 10 --no-figures
tlf run infinity --disturbance slip --horizon-s 10 --no-figures --policy residual
tlf compare results/infinity-linearised-slip-0-* results/infinity-residual-slip-0-*

say "paths of one's own, in odd forms"
python - <<'END'
from math import cos, sin

rows = [(0.05 * k, 2 * sin(0.0125 * k), 2 * cos(0.0125 * k)) for k in range(500)]
with open("semicolons.csv", "w", encoding="utf-8-sig", newline="") as file:
    file.write("# a log\r\ntime [s];pos_x [m];pos_y [m]\r\n")
    file.writelines(f"{1.7e9 + t:.2f};{x:.4f};{y:.4f}\r\n".replace(".", ",") for t, x, y in rows)
with open("blanks.txt", "w", encoding="utf-8") as file:
    file.writelines(f"{t:.2f}  {x:.4f}  {y:.4f}\n" for t, x, y in rows)
with open("odom.csv", "w", encoding="utf-8") as file:
    for t, x, y in rows:
        seconds, rest = divmod(round(1e9 * t), 10**9)
        file.write(f"{1700000000 + seconds},{rest},odom,base,{x:.4f},{y:.4f},0.0\n")
END
tlf path semicolons.csv --smooth 1 --speed-limit 300 --out one.csv
tlf path blanks.txt --units m --speed-limit 300 --out two.csv --no-figures
tlf path odom.csv --columns 1+2,5,6 --units m --speed-limit 300 --out three.csv --no-figures
for path in one two three; do tlf run "$path.csv" --horizon-s 10 --no-figures; done
if tlf path blanks.txt --out never.csv; then exit 1; fi

say "data"
tlf run circle --horizon-s 5 --no-figures --parquet --out data
test -s data/trajectory.parquet
tlf export circle --seeds 0:2 --horizon-s 5

say "a small benchmark, and a cell of the published board"
tlf bench --policies reference:linearised,residual --tasks circle --disturbances nominal,slip \
    --seeds 20000:20003 --horizon-s 20 --plant batch --no-figures --out bench
test -s bench/leaderboard.md
tlf bench --check infinity_from_rest:nominal --policies residual

if python -c "import stable_baselines3" 2> /dev/null; then
    say "a training, interrupted and resumed"
    tlf train quick --robot-steps 150000 --out training > first.log 2>&1 &
    learner=$!
    while ! ls training/seed_0/robot_steps > /dev/null 2>&1; do sleep 1; kill -0 $learner; done
    kill -INT $learner
    if wait $learner; then exit 1; fi
    grep -q "the same command goes on: tlf train quick" first.log
    tlf train quick --robot-steps 150000 --out training
    tlf run infinity --policy training/policy.safetensors --horizon-s 10 --no-figures
fi
say "done"
