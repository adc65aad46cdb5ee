"""The models of trained runs, opened with the environment that they were trained in."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdc.common.exceptions import describe_exception
from sb3_tdc.common.untrusted import escaped
from sb3_tdc.envs.checked import EnvironmentFaultError
from sb3_tdc.envs.make import SETUP_ERRORS, make_envs
from sb3_tdc.envs.registry import has_vector_env, require_env, split_env_id
from sb3_tdc.hyperparams import Hyperparams, parse
from sb3_tdc.runs.algorithms import KNOWN_ALGORITHMS
from sb3_tdc.runs.folder import RunFolder
from sb3_tdc.runs.models import load_model, needs_trust
from sb3_tdc.safe_load.run_files import check_arguments, check_imports, refused_imports

# The hyperparameters of a run that its environments are built from
_OF_THE_ENVIRONMENT = ("normalize", "frame_stack", "env_wrapper", "vec_env_wrapper", "env_kwargs")


@dataclass
class TrainedModel:
    """
    A saved model, with the settings that it was trained with.

    :param path: the zip
    :param env_id: id of a registered environment
    :param hyperparams: those that the environments are built from
    :param env_kwargs: keyword arguments of the environment in training
    :param eval_env_kwargs: keyword arguments of the environment in evaluations, if they differ
    :param normalization: saved statistics of ``VecNormalize``, if the model was trained with them
    :param trust: whether the files may run code
    :param vec_env: "gymnasium" if trained in the vector environment that is registered for the id, else "dummy"
    """

    path: Path
    algo: str
    env_id: str
    hyperparams: Hyperparams
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    eval_env_kwargs: dict[str, Any] = field(default_factory=dict)
    normalization: Path | None = None
    trust: bool = False
    vec_env: str = "dummy"

    def make_env(self, seed: int, env_kwargs: dict[str, Any]) -> VecEnv:
        """
        Make one environment as in training, but with fixed normalisation statistics and unnormalised rewards.

        :param env_kwargs: override the hyperparameter ``env_kwargs``; the attribute ``env_kwargs`` is not added
        :raises ValueError: if the environment or a wrapper raises an exception, with its message
        """
        try:
            return make_envs(
                self.env_id,
                self.hyperparams,
                seed,
                n_envs=1,
                env_kwargs=env_kwargs,
                vec_env=self.vec_env,
                normalization=self.normalization,
                training=False,
                trust=self.trust,
            )
        except EnvironmentFaultError as error:
            raise ValueError(str(error)) from error
        except Exception as error:
            is_a_sentence = isinstance(error, SETUP_ERRORS) and str(error)
            reason = " ".join(str(error).split()) if is_a_sentence else describe_exception(error)
            raise ValueError(f"{self.env_id} cannot be made: {reason}") from error

    def load(self, env: VecEnv | None, device: str) -> OffPolicyAlgorithm:
        """
        Load the model, with a replay buffer of the smallest size.

        :raises ValueError: if the file is refused, or was saved by another algorithm
        """
        return load_model(self.path, self.algo, env, self.trust, device=device, buffer_size=1)


def find_model(
    run: RunFolder, best: bool = False, checkpoint: int | None = None, last_checkpoint: bool = False
) -> Path:
    """
    Find one of a run's models, by default the final one.

    :param best: find the best model instead
    :param checkpoint: find the model that was saved at this step instead
    :param last_checkpoint: find the last model of ``--save-freq`` instead
    :return: the zip
    :raises ValueError: if the model does not exist, naming those that do
    """
    checkpoints = run.checkpoints()
    if best:
        path = run.best_model
    elif checkpoint is not None or last_checkpoint:
        steps = checkpoint if checkpoint is not None else max(checkpoints, default=-1)
        if steps not in checkpoints:
            known = f"there are those of steps {', '.join(map(str, checkpoints))}" if checkpoints else "it has none"
            raise ValueError(
                f"{run.path} has no saved model of step {steps}; {known} (sb3-tdc train --save-freq makes them)"
            )
        path = checkpoints[steps]
    else:
        path = run.model
    if not path.is_file():
        others = [p.name for p in (run.model, run.best_model, *checkpoints.values()) if p.is_file()]
        raise ValueError(f"{path} does not exist; in its folder are: {', '.join(others) or 'no models'}")
    return path


def open_run(run: RunFolder, path: Path, consented: Sequence[str] = (), trust: bool = False) -> TrainedModel:
    """
    Read and check the settings that a model of a run was trained with, and import the packages of its environment.

    :param path: a zip of the run
    :param consented: packages and modules that the user has named and that may therefore be imported
    :param trust: whether the files may refer to any code
    :raises ValueError: if a file is missing or damaged, or refers to code that is not allowed
    """
    trained, config = run.args, run.config
    check_arguments(trained, KNOWN_ALGORITHMS, str(run.path / run.env_name / "args.yml"))
    if not trust:
        check_imports(trained, config, consented, str(run.path))
    env_id, packages = split_env_id(trained["env"], [*trained["gym_packages"], *consented])
    require_env(env_id, packages)
    of_the_environment = {key: value for key, value in config.items() if key in _OF_THE_ENVIRONMENT}
    gamma = {"gamma": config["gamma"]} if "gamma" in config else {}
    where = str(run.path / run.env_name / "config.yml")
    hyperparams = parse({"n_timesteps": 1, **gamma, **of_the_environment}, KNOWN_ALGORITHMS[trained["algo"]], where)
    return TrainedModel(
        path,
        trained["algo"],
        env_id,
        hyperparams,
        trained["env_kwargs"] or {},
        trained.get("eval_env_kwargs") or {},
        run.find_normalization(path) if hyperparams.normalize is not None else None,
        trust,
        vec_env="gymnasium" if trained.get("vec_env") == "gymnasium" and has_vector_env(env_id) else "dummy",
    )


def flags_to_open(runs: Iterable[RunFolder]) -> list[str]:
    """Return the flags that ``enjoy`` and ``evaluate`` require for runs with custom code: the user's consent to it."""
    runs = list(runs)
    modules = dict.fromkeys(escaped(module) for run in runs for module, _ in refused_imports(run.args, run.config))
    trust = any(needs_trust(run.model, run.args["algo"]) for run in runs if run.model.is_file())
    return [*(["--gym-packages", *modules] if modules else []), *(["--trust"] if trust else [])]


def open_zip(path: Path, algo: str, env_id: str, packages: Sequence[str] = (), trust: bool = False) -> TrainedModel:
    """Return a model outside a run folder, with the algorithm, environment and packages that the user names."""
    require_env(env_id, packages)
    return TrainedModel(path, algo, env_id, parse({"n_timesteps": 1}, KNOWN_ALGORITHMS[algo], str(path)), trust=trust)
