"""``python tune.py --algo tdc --env Hopper-v4``: which λ, or other hyperparameters, on Ray Tune."""

import argparse
import shlex
import sys
import time
import zipfile
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from experiments.figures import COLORS, draw_sweep
from experiments.jobs import Job, cluster, count_cores, eval_freq, stop
from experiments.results import Run
from experiments.search_space import LAMBDAS, make_candidates, parse_space
from sb3_tdc import plain_yaml
from sb3_tdc.arguments import KeyValues, Parser, add_package_argument, import_packages, one_of, plain_arguments
from sb3_tdc.experiment import ALGORITHMS, SETUP_ERRORS, check_env_id, make_envs
from sb3_tdc.hyperparams import constructor_hints, hyperparams_file, parse, read_entry
from sb3_tdc.run_folder import folder_name

_ARGUMENTS = "search.yml"
_POLL_SECONDS = 1.0  # a look reads the files of a run, which takes time from the training
_LONGEST_STEP_SECONDS = 5.0


# ---------------------------------------------------------------- trials


def make_trainable(tune: Any, trials: Mapping[str, Sequence[Job]]) -> Any:
    """
    :param tune: the module of Ray
    :param trials: by name, the jobs that run side by side: one seed, or all of a candidate
    :return: the class of a trial
    """

    class Trial(tune.Trainable):
        def setup(self, config: dict[str, Any]) -> None:
            self.jobs = trials[config["trial"]]
            self.n_reported = 0
            self.processes = [job.start() for job in self.jobs if not job.is_finished]

        def step(self) -> dict[str, Any]:
            """Wait for the next evaluation of all seeds, not for long: only between steps can a trial be stopped."""
            deadline = time.monotonic() + _LONGEST_STEP_SECONDS
            while True:
                has_ended = all(process.poll() is not None for process in self.processes)
                returns = read_returns(self.jobs)
                if has_ended or returns.shape[1] > self.n_reported or time.monotonic() > deadline:
                    break
                time.sleep(_POLL_SECONDS)
            failed = [job for job in self.jobs if has_ended and not job.is_finished]
            if failed:
                raise RuntimeError("; ".join(f"{job}: see {job.log}: {' | '.join(job.last_lines())}" for job in failed))
            self.n_reported = n = min(self.n_reported + 1, returns.shape[1])
            return {
                "steps": n * eval_freq(self.jobs[0].n_timesteps),
                "mean_return": float(returns[:, :n].mean()) if n else float("nan"),
                "last_return": float(returns[:, n - 1].mean()) if n else float("nan"),
                "done": has_ended and n == returns.shape[1],
            }

        def cleanup(self) -> None:
            stop(self.processes)

    return Trial


def read_returns(jobs: Sequence[Job]) -> np.ndarray:
    """:return: (seeds, evaluations that all of them have), each the mean of its episodes"""
    found = []
    for job in jobs:
        folder = job.run_folder
        try:
            evaluations = None if folder is None else Run.open(folder.path).evaluations
        except (OSError, ValueError, EOFError, zipfile.BadZipFile):  # it is being written
            evaluations = None
        found.append(np.empty(0) if evaluations is None else evaluations.returns.mean(axis=1))
    shortest = min(map(len, found))
    return np.array([returns[:shortest] for returns in found])


def run_trials(args: argparse.Namespace, trials: Mapping[str, Sequence[Job]]) -> tuple[bool, list[str]]:
    """
    :return: whether the search came to its end, and what went wrong with the trials that failed
    """
    from ray import tune
    from ray.tune.schedulers import ASHAScheduler

    if not args.asha:  # ASHA needs all of them, to compare: a finished one reports at once what it has
        trials = {name: jobs for name, jobs in trials.items() if not all(job.is_finished for job in jobs)}
    if not trials:
        return True, []
    n_cpus = max(map(len, trials.values()))  # a CPU and a thread for each seed
    scheduler = ASHAScheduler(
        time_attr="steps",
        max_t=args.n_timesteps,
        grace_period=max(args.n_timesteps // 9, 1),
        reduction_factor=3,
        stop_last_trials=False,  # behind its last evaluation, a run has its model to write
    )
    # Also where a search is resumed: all that counts is in the folders of the runs, and Ray's state would be unpickled
    tuner = tune.Tuner(
        tune.with_resources(make_trainable(tune, trials), {"cpu": n_cpus}),
        param_space={"trial": tune.grid_search(list(trials))},
        tune_config=tune.TuneConfig(
            metric="mean_return", mode="max", scheduler=scheduler if args.asha else None, reuse_actors=False
        ),
        run_config=tune.RunConfig(
            name="ray",
            storage_path=str(args.folder),
            verbose=1,
            checkpoint_config=tune.CheckpointConfig(checkpoint_at_end=False),  # the runs have their own
        ),
    )
    results = tuner.fit()
    failed = [str(error).strip().splitlines()[-1] for error in results.errors]
    return results.num_terminated + results.num_errors == len(trials), failed


# ---------------------------------------------------------------- results


def rank(candidates: Sequence[Sequence[Job]], searched: Sequence[str]) -> pd.DataFrame:
    """
    The best first: by the mean over seeds of the mean of all evaluations, at the steps that all its seeds have.

    A candidate with fewer steps than another (stopped early, or failed) is behind it.

    :param candidates: of each, its seeds
    :param searched: names of hyperparameters, the first columns
    """
    rows = []
    for number, jobs in enumerate(candidates):
        scores = read_returns(jobs)
        steps = scores.shape[1] * eval_freq(jobs[0].n_timesteps)
        per_seed = scores.mean(axis=1) if steps else np.full(len(jobs), np.nan)
        spread = per_seed.std(ddof=1) if len(jobs) > 1 else np.nan
        settings = {key: jobs[0].settings[key] for key in searched}
        rows.append(
            {**settings, "mean": per_seed.mean(), "std": spread, "seeds": len(jobs), "steps": steps, "number": number}
        )
    table = pd.DataFrame(rows).sort_values(["steps", "mean"], ascending=False, kind="stable")
    return table.set_index("number")


def draw(candidates: Sequence[Sequence[Job]], key: str, path: Path) -> None:
    """
    Return against one hyperparameter, as PNG and PDF, at the steps that all candidates have.

    Where others are searched too, of each value the best candidate counts.

    :param path: without a suffix
    """
    from matplotlib.figure import Figure

    shortest = min(read_returns(jobs).shape[1] for jobs in candidates)
    best: dict[float, np.ndarray] = {}
    for jobs in candidates:
        value, scores = jobs[0].settings[key], read_returns(jobs)[:, :shortest].mean(axis=1)
        if value not in best or scores.mean() > best[value].mean():
            best[value] = scores
    job = candidates[0][0]
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    name = "λ" if key == "lam" else key
    draw_sweep(
        axes, sorted(best), [best[value] for value in sorted(best)], job.env_id, name, COLORS.get(job.algo.upper())
    )
    axes.set_ylabel(f"mean return until step {shortest * eval_freq(job.n_timesteps):,}")
    for suffix in (".png", ".pdf"):
        figure.savefig(f"{path}{suffix}")


def write_results(folder: Path, candidates: Sequence[Sequence[Job]], searched: Sequence[str]) -> None:
    """Print the table; write it, the figures, and the hyperparameters of the best."""
    table = rank(candidates, searched)
    table.to_csv(folder / "ranking.csv", index=False)
    print(table.to_string(index=False, float_format=lambda x: f"{x:g}", na_rep="–"))
    for key in searched:
        values = {jobs[0].settings[key] for jobs in candidates if isinstance(jobs[0].settings[key], (int, float))}
        if len(values) > 1 and (table["steps"] > 0).all():
            draw(candidates, key, folder / key)
    best = candidates[int(table.index[0])][0]
    entry, _ = read_entry(hyperparams_file(best.algo), best.env_id)
    content = {best.env_id: {**entry, **best.settings}}  # with the steps of a whole training
    (folder / "best.yml").write_text(plain_yaml.dump(content, sort_keys=False))
    print(f"Ranking, figures and the best hyperparameters are in {folder}")
    command = ["python", "train.py", "--algo", best.algo, "--env", best.env_id, "-conf", str(folder / "best.yml")]
    print("  " + shlex.join([*command, *(["--gym-packages", *best.packages] if best.packages else [])]))


# ---------------------------------------------------------------- command line


def make_parser() -> Parser:
    """:return: of the command line"""
    parser = Parser("Search hyperparameters (by default λ, among the paper's ten) by early evaluation returns.")
    add = parser.add_argument
    add("--algo", type=one_of("algorithm", ALGORITHMS), default="tdc", help="algorithm")
    add("--env", default="Hopper-v4", help="environment id")
    add("-n", "--n-timesteps", type=int, default=100_000, help="environment steps of a trial")
    add("--seeds", type=int, default=3, help="seeds of each candidate: 1, 2, ...")
    add(
        "--search",
        nargs="+",
        default=[],
        metavar="KEY:VALUES",
        help='such as "lam:[0.5,1.0]" "tau:loguniform(1e-4,1e-2)"',
    )
    add("--samples", type=int, default=10, help="draws of the distributions in --search")
    add("-params", "--hyperparams", nargs="+", action=KeyValues, default={}, help="key:value of all candidates")
    add_package_argument(parser)
    add("--asha", action="store_true", help="stop the worse two thirds of the candidates early, twice")
    add("--logs", type=Path, default=Path("logs"), help="folder of all searches")
    add("--jobs", type=int, help="CPUs to use (default: all cores); a trial takes one, with --asha one a seed")
    add("--address", help="of a Ray cluster that shares this file system (default: this machine)")
    add("--resume", type=Path, metavar="FOLDER", help="go on with a stopped search; it has all other arguments")
    return parser


def make_candidate_jobs(args: argparse.Namespace) -> list[list[Job]]:
    """
    :return: for every candidate, its seeds
    :raises ValueError: for anything that is not allowed
    """
    for name in ("n_timesteps", "seeds", "samples", "jobs"):
        value = getattr(args, name)
        if value is not None and value < 1:
            raise ValueError(f"{'-n' if name == 'n_timesteps' else f'--{name}'} must be at least 1, got {value}")
    check_env_id(args.env)
    space = parse_space(args.search)
    if not space:
        if "lam" not in constructor_hints(ALGORITHMS[args.algo]):
            raise ValueError(f"{args.algo} has no λ: say what to --search")
        space = {"lam": LAMBDAS}
    args.searched = list(space)
    candidates = make_candidates(space, args.samples)
    for candidate in candidates:
        _check(args.algo, args.env, {**args.hyperparams, **candidate})
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


def _check(algo: str, env_id: str, settings: dict[str, Any]) -> None:
    """:raises ValueError: if the algorithm does not take them"""
    entry, _ = read_entry(hyperparams_file(algo), env_id)
    parse({"n_timesteps": 1, **settings}, ALGORITHMS[algo], "--search and -params")
    hyperparams = parse({**entry, **settings}, ALGORITHMS[algo], "--search and -params")
    try:
        with closing(make_envs(env_id, hyperparams, seed=1, n_envs=hyperparams.n_envs)) as env:
            ALGORITHMS[algo](env=env, device="cpu", **{**hyperparams.model, "buffer_size": 1_000})
    except SETUP_ERRORS as error:
        raise ValueError(f"--search and -params: {' '.join(str(error).split())}") from error


def make_trials(
    candidates: Sequence[Sequence[Job]], searched: Sequence[str], side_by_side: bool
) -> dict[str, Sequence[Job]]:
    """
    :param searched: names of hyperparameters; their values name the trials
    :param side_by_side: all seeds of a candidate in one trial: what stops a trial then stops a candidate, not its bad
        seeds, which would leave a mean of the lucky ones
    """

    def name(job: Job, seeds: str) -> str:
        return ", ".join([*(f"{key} {job.settings[key]}" for key in searched), seeds])

    if not side_by_side:
        return {name(job, f"seed {job.seed}"): [job] for jobs in candidates for job in jobs}
    return {name(jobs[0], f"{len(jobs)} seeds"): jobs for jobs in candidates}


def _read_arguments(args: argparse.Namespace, given: dict[str, Any]) -> None:
    """
    Those of a search that is resumed.

    :raises ValueError: if there is none, or the command line contradicts it
    """
    try:
        stored = plain_yaml.load((args.resume / _ARGUMENTS).read_text(), str(args.resume / _ARGUMENTS))
    except OSError as error:
        raise ValueError(f"{args.resume} is not the folder of a search: it has no readable {_ARGUMENTS}") from error
    of_the_process = ("resume", "jobs", "address")
    for name, value in given.items():
        if name not in of_the_process and str(value) != str(stored.get(name)):
            raise ValueError(f"--{name} {value} contradicts the search in {args.resume}: {stored.get(name)}")
    vars(args).update({name: value for name, value in stored.items() if name not in of_the_process})
    args.folder = args.resume.resolve()


def _make_folder(args: argparse.Namespace) -> Path:
    """:return: the next free one; it does not exist yet"""
    parent = args.logs.resolve() / "search" / args.algo
    name = folder_name(args.env)
    taken = [path.name.rpartition("_")[2] for path in parent.glob(f"{name}_*")]
    number = max((int(text) for text in taken if text.isdecimal()), default=0) + 1
    return parent / f"{name}_{number}"


def main(argv: Sequence[str] | None = None) -> int:
    """
    :param argv: arguments, those of the process by default
    :return: 0, 1 if a trial failed, 130 if the user stopped the search
    """
    parser = make_parser()
    args, given = parser.parse_args(argv), parser.parse_given(argv)
    try:
        if args.resume is not None:
            _read_arguments(args, given)
        typed = plain_arguments(vars(args))
        args.env = import_packages(args, args.env)
        if args.resume is None:
            args.folder = _make_folder(args)
        candidates = make_candidate_jobs(args)
        trials = make_trials(candidates, args.searched, args.asha)
        with cluster(args.address, args.jobs):
            if args.resume is None:
                args.folder.mkdir(parents=True)
                (args.folder / _ARGUMENTS).write_text(plain_yaml.dump(typed))
            print(
                f"{len(candidates)} candidates × {args.seeds} seeds, {args.n_timesteps:,} steps each, evaluated every "
                f"{eval_freq(args.n_timesteps):,} (5 episodes); one CPU and one thread a seed; in {args.folder}",
                flush=True,
            )
            is_complete, failed = run_trials(args, trials)
    except ValueError as error:
        parser.fail(error)
    except KeyboardInterrupt:
        is_complete, failed = False, []
    for sentence in failed:
        print(f"failed {sentence}", file=sys.stderr)
    if not is_complete:
        print(f"Stopped. To go on:\n  python tune.py --resume {shlex.quote(str(args.folder))}", file=sys.stderr)
        return 130
    if any(read_returns(jobs).size for jobs in candidates):
        write_results(args.folder, candidates, args.searched)
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
