"""
``python -m benchmarks.flows``: gradient steps of MEOW compared with SB3's SAC, and its couplings with zuko's.

As in :mod:`benchmarks.speed`, all are timed in turn in one process. zuko is left out if it is not installed:
``pip install "sb3-tdc[bench]"``.
"""

import argparse
import statistics
from collections.abc import Callable
from typing import Any

import torch as th

from benchmarks.speed import Load, hardware, optional, repeat, time_calls

ENV, BATCH, BLOCKS, WIDTHS = "HalfCheetah-v4", 256, 2, (64, 64)


def gradient_steps() -> dict[str, Callable[[int], None]]:
    """Return gradient steps of MEOW and SAC for ``time_calls``, with the networks of their papers."""
    from stable_baselines3 import SAC

    from sb3_tdc import MEOW

    settings: dict[str, Any] = {"learning_starts": 300, "buffer_size": 10_000, "seed": 0, "device": "cpu"}
    models = {"MEOW": MEOW("MlpPolicy", ENV, **settings), "SB3 SAC": SAC("MlpPolicy", ENV, **settings)}
    for model in models.values():
        model.learn(340)
    return {name: repeat(lambda model=model: model.train(1, BATCH)) for name, model in models.items()}  # type: ignore[misc]


def couplings(features_dim: int = 17, action_dim: int = 6) -> dict[str, Callable[[int], None]]:
    """Return the couplings alone for ``time_calls``: the inverse with its log-determinant, and the backward pass."""
    from sb3_tdc.meow.flow import ConditionalFlow, Swish

    features, actions = th.randn(BATCH, features_dim), 2 * th.rand(BATCH, action_dim) - 1
    flow = ConditionalFlow(features_dim, action_dim, WIDTHS, BLOCKS)

    def run_ours() -> None:
        z, log_det = flow.inverse(actions, features)
        (z.square().sum() + log_det.sum()).backward()

    found = {"couplings of sb3_tdc": repeat(run_ours)}
    if zuko := optional("zuko"):
        even = th.arange(action_dim) % 2 == 0
        shifts = th.nn.ModuleList(
            zuko.flows.coupling.GeneralCouplingTransform(
                action_dim,
                context=features_dim,
                mask=mask,
                univariate=zuko.transforms.AdditiveTransform,
                shapes=[()],
                hidden_features=WIDTHS,
                activation=lambda: Swish(WIDTHS[0]),
                normalize=True,
            )
            for mask in (even, ~even) * BLOCKS
        )

        def run_zuko() -> None:
            z, log_det = th.atanh(actions.clamp(-0.99999, 0.99999)), th.zeros(BATCH)
            for coupling in reversed(shifts):
                z, ladj = coupling(features).inv.call_and_ladj(z)
                log_det = log_det + ladj
            (z.square().sum() + log_det.sum()).backward()

        found["couplings of zuko"] = repeat(run_zuko)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=12, help="turns of each")
    parser.add_argument("--seconds", type=float, default=0.5, help="length of a turn")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    th.set_num_threads(arguments.threads)
    print(f"{hardware()}; {arguments.threads} thread(s); {ENV}, batch {BATCH}")
    for functions in (gradient_steps(), couplings()):
        with Load() as load:
            times = time_calls(functions, arguments.rounds, arguments.seconds)
        first_of_group = next(iter(times.values()))
        for name, values in times.items():
            ratios = [other / first for first, other in zip(first_of_group, values, strict=True)]
            print(
                f"{name}: {statistics.median(values):.2f} ms (least {min(values):.2f}), "
                f"{statistics.median(ratios):.2f} times the first of its group"
            )
        print(f"(other processes took {load.foreign:.1f} cores meanwhile)")


if __name__ == "__main__":
    main()
