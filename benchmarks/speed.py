"""
``python -m benchmarks.speed``: the time of whole environment steps of TDC, compared with its peers.

Every row is a ratio of times measured in one process, in turns of half a second, so that a drift of the machine's speed
does not change the ratio. Peers: ``pip install "sb3-tdc[bench]"``; one that is missing is left out, with a message.
"""

import argparse
import importlib
import json
import os
import platform
import random
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

ENVS = ("HalfCheetah-v4", "Hopper-v4", "Humanoid-v4")
# Targets on HalfCheetah-v4: (peer, threads) → smallest ratio of the peer's time to TDC's
TARGETS = {
    ("SB3 TD3", 2): 1.6,
    ("SB3 TD3", 1): 1.4,
    ("SBX TD3", 1): 1.05,
    ("SBX TQC, 64 quantiles", 2): 7.0,
    ("SB3 SAC / TDC, stochastic head", 1): 2.0,
}
WARM_UP = 5  # calls at the beginning of a turn that are not measured
WITHOUT_NUMBA = "TDC, without Numba"


def make_models(env_id: str) -> dict[str, Any]:
    """Return a model for every installed peer, by name; the others are compared with ``TDC``."""
    import gymnasium as gym
    from stable_baselines3 import SAC, TD3
    from stable_baselines3.common.noise import NormalActionNoise

    from benchmarks.naive import NaivePolicy, NaiveTDC
    from sb3_tdc import TDC

    dimension = gym.make(env_id).action_space.shape[0]
    noise = NormalActionNoise(np.zeros(dimension), np.full(dimension, 0.1))

    def settings(**policy_kwargs: Any) -> dict[str, Any]:
        common = {"learning_starts": 300, "buffer_size": 50_000, "batch_size": 256, "seed": 0}
        return {
            **common,
            "env": env_id,
            "policy": "MlpPolicy",
            "policy_kwargs": {"net_arch": [256, 256], **policy_kwargs},
        }

    models = {
        "TDC": TDC(**settings(), device="cpu"),
        "TDC, readable update": TDC(**settings(), device="cpu", fused=False),
        "TDC, stochastic head": TDC(**settings(), device="cpu", stochastic_actor=True),
        WITHOUT_NUMBA: TDC(**settings(), device="cpu"),
        "SB3 TD3": TD3(**settings(), device="cpu", action_noise=noise),
        "SB3 SAC": SAC(**settings(), device="cpu"),
        "naive transcription": NaiveTDC(**{**settings(), "policy": NaivePolicy}, device="cpu", action_noise=noise),
    }
    if contrib := optional("sb3_contrib"):
        models["contrib TQC, 64 quantiles"] = contrib.TQC(**settings(n_quantiles=64), device="cpu")
    if sbx := optional("sbx"):
        models["SBX TD3"] = sbx.TD3(**settings(), action_noise=noise, policy_delay=2)
        models["SBX TQC, 64 quantiles"] = sbx.TQC(**settings(n_quantiles=64))
    return models


def optional(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        print(f'{name} is missing and left out: pip install "sb3-tdc[bench]"', file=sys.stderr)
        return None


def matrix_products(model: Any) -> Callable[[], None]:
    """Return a function that computes only the matrix products of one gradient step."""
    fused = model._fused_update
    calls = 0

    def forward(network: Any) -> None:
        for product in network.products:
            product()

    def backward(network: Any) -> None:
        for product in (*network.weight_products, *network.grad_input_products):
            product()

    def run() -> None:
        nonlocal calls
        calls += 1
        forward(fused.target_head.network)
        forward(fused.critic_target)
        forward(fused.critic)
        backward(fused.critic)
        if calls % model.policy_delay == 0:
            forward(fused.head.network)
            forward(fused.value)
            backward(fused.value)
            fused.value.grad_outputs[0] @ fused.action_weight
            backward(fused.head.network)

    return run


class Load:
    """A context that measures the processor time of other processes meanwhile, in cores (Linux)."""

    def __enter__(self) -> "Load":
        self.start = time.perf_counter(), self._busy(), sum(os.times()[:4])
        return self

    def __exit__(self, *_: object) -> None:
        seconds, busy, own = time.perf_counter(), self._busy(), sum(os.times()[:4])
        self.foreign = (busy - self.start[1] - (own - self.start[2])) / (seconds - self.start[0])

    @staticmethod
    def _busy() -> float:
        stat = Path("/proc/stat")
        if not stat.exists():
            return float("nan")
        user, nice, system, _, _, irq, softirq, steal, *_ = map(int, stat.read_text().split("\n")[0].split()[1:])
        return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")


def time_calls(functions: dict[str, Callable[[int], Any]], rounds: int, seconds: float) -> dict[str, list[float]]:
    """
    Time functions in turn, in a new random order in every round.

    :param functions: by name; each takes the number of calls to make
    :param seconds: approximate length of a turn
    :return: milliseconds per call, (rounds,) for every function
    """
    times: dict[str, list[float]] = {name: [] for name in functions}
    shuffle = random.Random(0)

    def time_call(function: Callable[[int], Any], calls: int) -> float:
        start = time.perf_counter()
        function(calls)
        return (time.perf_counter() - start) / calls

    for _ in range(rounds):
        for name in shuffle.sample(list(functions), len(functions)):
            # The function before has left its data in the caches and its threads awake: the first calls do not count
            estimate = time_call(functions[name], WARM_UP)
            times[name].append(1000 * time_call(functions[name], max(WARM_UP, round(seconds / estimate))))
    return times


def repeat(function: Callable[[], Any]) -> Callable[[int], None]:
    """Return a function that takes n, and calls the given function n times."""

    def run(n: int) -> None:
        for _ in range(n):
            function()

    return run


def gradient_steps(model: Any, batch_size: int) -> dict[str, Callable[[int], None]]:
    """Return two functions for :func:`time_calls`: gradient steps of a model, and their matrix products alone."""
    return {
        "TDC": repeat(lambda: model.train(1, batch_size)),
        "matrix products": repeat(matrix_products(model)),
    }


def learn_steps(name: str, model: Any) -> Callable[[int], None]:
    """Return a function that trains a model for a number of steps."""

    def learn(n: int) -> None:
        with ExitStack() as stack:
            for place in ("quantiles", "fused.update") if name == WITHOUT_NUMBA else ():
                stack.enter_context(mock.patch(f"sb3_tdc.tdc.{place}.load_kernels", return_value=None))
            model.learn(n, reset_num_timesteps=False)

    return learn


def measure_env(env_id: str, rounds: int, seconds: float) -> dict[str, Any]:
    """Time whole environment steps of every peer, then gradient steps of TDC and their matrix products."""
    models = make_models(env_id)
    learn = {name: learn_steps(name, model) for name, model in models.items()}
    for function in learn.values():
        function(340)
    with Load() as load:
        step_times = time_calls(learn, rounds, seconds)
        tdc = models["TDC"]
        gradient_times = time_calls(gradient_steps(tdc, 256), 4 * rounds, seconds / 2)
    return {
        "steps": step_times,
        "gradient": gradient_times,
        "foreign_load": load.foreign,
    }


def measure_scaling(rounds: int) -> dict[str, Any]:
    """Time gradient steps of TDC and their matrix products, against quantiles, batch size and width."""
    from sb3_tdc import TDC

    def measure(n_quantiles: int = 64, batch_size: int = 256, width: int = 256) -> dict[str, list[float]]:
        model = TDC(
            "MlpPolicy",
            "HalfCheetah-v4",
            policy_kwargs={"net_arch": [width, width], "n_quantiles": n_quantiles},
            learning_starts=10_000,
            buffer_size=10_000,
            batch_size=batch_size,
            device="cpu",
            seed=0,
        ).learn(300)
        model.train(2, batch_size)
        return time_calls(gradient_steps(model, batch_size), rounds, seconds=0.2)

    with Load() as load:
        result: dict[str, Any] = {
            "quantiles": {n: measure(n_quantiles=n) for n in (8, 16, 32, 64, 128, 200)},
            "batch size": {n: measure(batch_size=n) for n in (64, 256, 1024, 4096)},
            "width": {n: measure(width=n) for n in (64, 128, 256, 512, 1024)},
        }
    return {**result, "foreign_load": load.foreign}


def run_child(task: str, threads: int, arguments: argparse.Namespace) -> dict[str, Any]:
    """Run one measurement in a separate process, on as many cores as threads."""
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {**os.environ, **dict.fromkeys(names, str(threads)), "JAX_PLATFORMS": "cpu", "TQDM_DISABLE": "1"}
    command = [sys.executable, "-W", "ignore", "-m", "benchmarks.speed", "--task", task, "--threads", str(threads)]
    command += ["--rounds", str(arguments.rounds), "--seconds", str(arguments.seconds)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def run_together(runs: int, threads: int, seconds: float) -> float:
    """Return the total environment steps per second of several simultaneous runs of TDC, on all cores."""
    names = ("OMP_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {**os.environ, **dict.fromkeys(names, str(threads))}
    command = [sys.executable, "-W", "ignore", "-m", "benchmarks.speed", "--task", "rate", "--threads", str(threads)]
    children = [
        subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for _ in range(runs)
    ]
    for child in children:  # each reports the end of its warm-up, then waits for the length of the measurement
        assert child.stdout is not None
        child.stdout.readline()
    for child in children:
        assert child.stdin is not None
        child.stdin.write(f"{seconds}\n")
        child.stdin.flush()
    return sum(float(child.communicate()[0]) for child in children)


def measure_rate() -> None:
    """Measure the rate of one run, in a child of :func:`run_together`."""
    from sb3_tdc import TDC

    model = TDC("MlpPolicy", ENVS[0], learning_starts=300, buffer_size=50_000, device="cpu", seed=0).learn(340)
    print("ready", flush=True)
    seconds, steps = float(sys.stdin.readline()), 0
    start = time.perf_counter()
    while time.perf_counter() - start < seconds:
        model.learn(20, reset_num_timesteps=False)
        steps += 20
    print(steps / (time.perf_counter() - start))


def measure_threads(rounds: int, seconds: float = 6.0) -> list[dict[str, Any]]:
    """Measure one run and as many runs as cores, with one thread each and with as many threads as cores."""
    cores = os.cpu_count() or 1
    settings = [(runs, threads) for runs in (1, cores) for threads in (1, cores)]
    rates: dict[tuple[int, int], list[float]] = {setting: [] for setting in settings}
    for _ in range(rounds):
        for setting in settings:
            rates[setting].append(run_together(*setting, seconds))
    return [{"runs": runs, "threads": threads, "rates": rates[runs, threads]} for runs, threads in settings]


def work(arguments: argparse.Namespace) -> None:
    """Do the work of a child process: pin it to cores, measure, print JSON."""
    if arguments.task == "rate":
        measure_rate()
        return
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: arguments.threads])
    import torch as th

    th.set_num_threads(arguments.threads)
    if arguments.task == "scaling":
        result = measure_scaling(arguments.rounds)
    else:
        result = measure_env(arguments.task, arguments.rounds, arguments.seconds)
    print(json.dumps(result))


def hardware() -> str:
    import torch as th

    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        model = next((x.split(":")[1].strip() for x in cpuinfo.read_text().split("\n") if "model name" in x), model)
    versions = f"Python {platform.python_version()}, PyTorch {th.__version__}"
    return f"{os.cpu_count()} cores of {model}, {platform.system()}, {versions}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/benchmarks"), help="folder of table and plots")
    parser.add_argument("--rounds", type=int, default=6, help="turns of every peer")
    parser.add_argument("--seconds", type=float, default=0.5, help="length of a turn")
    parser.add_argument("--envs", nargs="+", default=ENVS)
    parser.add_argument("--task", help=argparse.SUPPRESS)
    parser.add_argument("--threads", type=int, nargs="+", default=[2, 1])
    arguments = parser.parse_args()
    if arguments.task:
        arguments.threads = arguments.threads[0]
        work(arguments)
        return

    from benchmarks.speed_report import write_report

    start = time.perf_counter()
    results: dict[str, Any] = {"hardware": hardware(), "rounds": arguments.rounds, "seconds": arguments.seconds}
    results["envs"] = {}
    for env_id in arguments.envs:
        for threads in arguments.threads:
            print(f"{env_id}, {threads} thread(s) ...", file=sys.stderr, flush=True)
            results["envs"].setdefault(env_id, {})[str(threads)] = run_child(env_id, threads, arguments)
    for threads in arguments.threads:
        print(f"scaling, {threads} thread(s) ...", file=sys.stderr, flush=True)
        results.setdefault("scaling", {})[str(threads)] = run_child("scaling", threads, arguments)
    print("several runs at once ...", file=sys.stderr, flush=True)
    results["together"] = measure_threads(rounds=3)
    results["minutes"] = (time.perf_counter() - start) / 60
    write_report(results, arguments.output, TARGETS)


if __name__ == "__main__":
    main()
