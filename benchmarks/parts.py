"""
``python -m benchmarks.parts``: the time of each part of a training step, measured during training.

Each part is timed in place, after the parts before it have replaced its data in the caches; in a separate loop it would
be several times faster.
"""

import argparse
import os
import subprocess
import sys
import time
from collections import defaultdict
from typing import Any

import numpy as np

from benchmarks.speed import ENVS, hardware

PARTS = {  # name → the object within the model, its method
    "draw a minibatch": ("_fused_update", "sample"),
    "compare what the update relies on": ("_fused_update", "fits"),
    "target actions: a forward pass of the target actor": ("_fused_update", "_set_target_actions"),
    "forward pass of the target critics": ("_fused_update.critic_target", "forward"),
    "λ-LCB target": ("_fused_update", "set_target"),
    "forward pass of the critics": ("_fused_update.critic", "forward"),
    "gradient of the loss": ("_fused_update", "compute_loss_gradient"),
    "backward pass of the critics": ("_fused_update.critic", "backward"),
    "Adam, critics": ("_fused_update.critic_adam", "step"),
    "actor, every second update: passes of actor and first critic": ("_fused_update", "run_actor"),
    "Polyak averaging, every second update": ("_fused_update", "_update_targets"),
    "choose an action": ("", "_sample_action"),
    "simulator and its wrappers": ("env", "step"),
    "store the transition": ("", "_store_transition"),
}


def measure(env_id: str, steps: int, stochastic_actor: bool) -> dict[str, float]:
    """Return microseconds per training step, by part."""
    from sb3_tdc import TDC

    settings: dict[str, Any] = {"learning_starts": 300, "buffer_size": 200_000, "device": "cpu", "seed": 0}
    model = TDC("MlpPolicy", env_id, stochastic_actor=stochastic_actor, **settings).learn(1000)
    update: Any = model._fused_update
    actor_part = "_update_stochastic_actor" if model.stochastic_actor else "_update_deterministic_actor"
    times: dict[str, list[float]] = defaultdict(list)
    for name, (path, method) in PARTS.items():
        owner = model
        for attribute in path.split(".") if path else ():
            owner = getattr(owner, attribute)
        method = actor_part if method == "run_actor" else method
        _time_method(owner, method, times[name])
    start = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    total = (time.perf_counter() - start) / steps
    assert model._fused_update is update
    result = {name: 1e6 * sum(times[name]) / steps for name in PARTS}
    return {**result, "all else": 1e6 * total - sum(result.values()), "a training step": 1e6 * total}


def _time_method(owner: Any, name: str, times: list[float]) -> None:
    method = getattr(owner, name)

    def timed(*arguments: Any, **options: Any) -> Any:
        start = time.perf_counter()
        result = method(*arguments, **options)
        times.append(time.perf_counter() - start)
        return result

    timed.__name__ = name
    setattr(owner, name, timed)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default=ENVS[0])
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--stochastic", action="store_true", help="the tanh-Gaussian head")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        import torch as th

        th.set_num_threads(arguments.threads[0])
        print(*measure(arguments.env, arguments.steps, arguments.stochastic).values())
        return
    columns = []
    for threads in arguments.threads:
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
        command = [sys.executable, "-W", "ignore", "-m", "benchmarks.parts", "--child", "--threads", str(threads)]
        command += ["--env", arguments.env, "--steps", str(arguments.steps)]
        command += ["--stochastic"] if arguments.stochastic else []
        output = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True).stdout
        columns.append(np.array(output.splitlines()[-1].split(), dtype=float))
    print(f"{arguments.env}, {hardware()}, microseconds per training step.\n")
    print("| part | " + " | ".join(f"{n} thread{'s' * (n > 1)}" for n in arguments.threads) + " |")
    print("|---" * (1 + len(columns)) + "|")
    for name, *values in zip([*PARTS, "all else", "a training step"], *columns, strict=True):
        print(f"| {name} | " + " | ".join(f"{value:.0f}" for value in values) + " |")


if __name__ == "__main__":
    main()
