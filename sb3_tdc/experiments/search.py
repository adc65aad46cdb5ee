"""The candidates of a search, checked before anything is trained."""

import argparse
from contextlib import closing
from dataclasses import replace
from typing import Any

from sb3_tdc.envs.make import SETUP_ERRORS, make_envs
from sb3_tdc.envs.registry import require_env, simulator_of
from sb3_tdc.experiments.jobs import Job, count_cores
from sb3_tdc.experiments.search_space import LAMBDAS, make_candidates, parse_space
from sb3_tdc.hyperparams import constructor_hints, hyperparams_file, parse, read_entry
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS
from sb3_tdc.runs.models import make_model


def make_candidate_jobs(args: argparse.Namespace) -> list[list[Job]]:
    """
    Make the jobs of every candidate.

    :return: for every candidate, the jobs of its seeds
    :raises ValueError: if an argument is not allowed
    """
    for name in ("n_timesteps", "seeds", "samples", "jobs"):
        value = getattr(args, name)
        if value is not None and value < 1:
            raise ValueError(f"{'-n' if name == 'n_timesteps' else f'--{name}'} must be at least 1, got {value}")
    if simulator_of(args.env).make_vec is not None:
        raise ValueError(f"{args.env} has no evaluations by which candidates could be compared")
    require_env(args.env, args.gym_packages)
    space = parse_space(args.search)
    if not space:
        if "lam" not in constructor_hints(KNOWN_ALGORITHMS[args.algo]):
            raise ValueError(f"{args.algo} has no λ: say what to --search")
        space = {"lam": LAMBDAS}
    args.searched = list(space)
    candidates = make_candidates(space, args.samples)
    for candidate in candidates:
        check(args.algo, args.env, {**args.hyperparams, **candidate})
    n_cpus = args.jobs or count_cores()
    if args.asha and args.address is None and args.seeds > n_cpus:
        raise ValueError(
            f"--asha compares candidates by all their seeds, side by side: {args.seeds} seeds need as many CPUs, "
            f"there are {n_cpus} (--seeds {n_cpus}, or --jobs {args.seeds} to share them)"
        )

    def job(number: int, candidate: dict[str, Any], seed: int) -> Job:
        logs = args.folder / f"candidate_{number}" / f"seed_{seed}"
        settings, packages = {**args.hyperparams, **candidate}, tuple(args.gym_packages)
        return Job(args.algo, args.env, seed, args.n_timesteps, logs, settings, packages)

    return [
        [job(number, candidate, seed) for seed in range(1, args.seeds + 1)]
        for number, candidate in enumerate(candidates, start=1)
    ]


def check(algo: str, env_id: str, settings: dict[str, Any]) -> None:
    """
    Check that the algorithm takes the hyperparameters of a candidate.

    :raises ValueError: if the algorithm does not take them
    """
    entry, name = read_entry(hyperparams_file(algo), env_id)
    where = f"{hyperparams_file(algo)}, {name}"
    hyperparams = parse(entry, KNOWN_ALGORITHMS[algo], where, settings, "--search and -params")
    try:
        with closing(make_envs(env_id, hyperparams, seed=1, n_envs=hyperparams.n_envs)) as env:
            small = replace(hyperparams, model={**hyperparams.model, "buffer_size": 1_000})
            make_model(algo, small, env, device="cpu")
    except SETUP_ERRORS as error:
        raise ValueError(f"--search and -params: {' '.join(str(error).split())}") from error
